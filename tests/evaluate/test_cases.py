"""Evaluations from chosen starts."""

import csv
import itertools
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe.commands.evaluate import main
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.environment import Environment
from jaxsafe.evaluate.cases import column_names, columns_of, load_cases, reset_to_cases
from jaxsafe.evaluate.evaluator import Evaluator, episode_rows, metrics_per_seed
from jaxsafe.rollout import reset_batch
from jaxsafe.schema.errors import ConfigError

CONFIGS = Path(__file__).parents[2] / "configs" / "cases"


@jax.tree_util.register_static
class Idle:
    """A policy that never pushes."""

    def policy(self, env: Any, params: Any, deterministic: Any) -> Any:
        return lambda key, observation: jnp.zeros((*observation.shape[:-1], 2))


def write(path: Path, columns: dict[str, np.ndarray]) -> str:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    return str(path)


def short_docking() -> Environment:
    return jaxsafe.make("docking2d", {"terminal.timeout.limit": 3.0})


def test_each_case_is_the_start_of_an_episode_in_order(tmp_path: Path) -> None:
    env = short_docking()
    position = np.stack([np.linspace(100.0, 150.0, 130), np.zeros(130)], axis=-1)
    columns = dict(zip(("deputy.position.x", "deputy.position.y"), position.T, strict=True))
    columns |= {"deputy.velocity.x": np.zeros(130), "deputy.velocity.y": np.zeros(130)}
    cases = load_cases(env, write(tmp_path / "line.csv", columns))
    assert cases.size == 130
    evaluator = Evaluator(SeedMapper(1), env, Idle(), cases)
    sums = evaluator.run({"none": np.zeros(1)}, cases.size, seed=0, deterministic=True)
    assert sums.length.shape == (1, 130)
    recorded = [
        states.sim.platforms["deputy"].position[0] for states, _ in evaluator.episodes({}, 130, 0)
    ]
    np.testing.assert_allclose(recorded, position, rtol=1e-6)
    states, _ = evaluator.episode({}, 117, seed=0, deterministic=True)
    np.testing.assert_allclose(states.sim.platforms["deputy"].position[0], position[117], rtol=1e-6)


def test_the_cost_of_each_constraint_is_a_metric_by_its_name() -> None:
    # A step may violate both limits, and then costs 1 in all.
    env = jaxsafe.make(
        str(CONFIGS.parent / "custom_env.yaml"),
        {"terminal.timeout.limit": 20.0, "deputy.start.velocity.share": [0.0, 4.0]},
    )
    evaluator = Evaluator(SeedMapper(1), env, Idle())
    sums = evaluator.run({"none": np.zeros(1)}, 30, seed=0, deterministic=True)
    computed = {name: value for name, [value] in metrics_per_seed(env, sums).items()}
    flown = [timestep.costs for _, timestep in evaluator.episodes({}, 30, 0)]
    names = [constraint.name for constraint in env.constraints]
    rows = episode_rows(env, sums, first_seed=0)
    by_name = []
    for name in names:
        of_episodes = [costs[name][1:].sum() for costs in flown]
        assert [row[f"episode_cost/{name}"] for row in rows] == pytest.approx(of_episodes)
        by_name.append(computed[f"episode_cost/{name}"])
        assert by_name[-1] == pytest.approx(np.mean(of_episodes))
    assert len({*by_name}) == len(names) == 3
    assert computed["episode_cost"] < sum(by_name)
    assert computed["episode_cost"] == pytest.approx(max(by_name))


def test_drawn_numbers_are_columns_too(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d", {"randomize": {"deputy.mass": [8.0, 16.0]}})
    assert column_names(env)[-1] == "deputy.mass"
    states, timestep = reset_batch(env, jax.random.key(1), 5)
    file = write(tmp_path / "drawn.csv", columns_of(env, states))
    again, same = reset_to_cases(env, load_cases(env, file), jax.random.key(2))
    np.testing.assert_array_equal(again.parameters["deputy.mass"], states.parameters["deputy.mass"])
    np.testing.assert_array_equal(same.observation, timestep.observation)


@pytest.mark.parametrize(
    "task",
    ["docking2d", *(thorough(task) for task in jaxsafe.TASKS if task != "docking2d")],
)
def test_the_cases_of_a_task_are_its_own_starts_and_a_grid(task: str) -> None:
    env = jaxsafe.make(task)
    cases = load_cases(env, str(CONFIGS / f"{task}.csv"))
    starts, first = reset_batch(env, jax.random.key(0), 1000)
    random = reset_to_cases(env, cases.part(0, 1000), jax.random.key(0))[1]
    np.testing.assert_allclose(random.observation, first.observation, rtol=1e-4, atol=1e-3)
    states, grid = reset_to_cases(env, cases.part(1000, cases.size - 1000), jax.random.key(0))
    assert not np.any(grid.done)
    assert not np.any(grid.cost)
    own, extreme = columns_of(env, starts), columns_of(env, states)
    for name in column_names(env):
        spread = np.ptp(own[name])
        assert np.min(extreme[name]) <= np.min(own[name]) + 0.05 * spread
        # The last quarter turn is three quarters of the way.
        assert np.max(extreme[name]) >= np.max(own[name]) - 0.26 * spread


def grid_columns(task: str) -> dict[str, np.ndarray]:
    """Return the starts of a file after the random ones, by column."""
    with (CONFIGS / f"{task}.csv").open(newline="") as file:
        names, *rows = csv.reader(file)
    return dict(zip(names, np.array(rows[1000:], float).T, strict=True))


@pytest.mark.parametrize(
    ("task", "corners"), [("docking2d", 40), ("docking3d", 12), ("docking2d_oriented", 160)]
)
def test_the_grid_of_docking_has_every_corner_and_then_the_middle(task: str, corners: int) -> None:
    grid = np.stack([*grid_columns(task).values()], axis=-1)
    space = task == "docking3d"
    # In space the extremes of the polar angle are the poles.
    directions = [(0, 0, 1), (0, 0, -1)] if space else [(1, 0), (0, 1), (-1, 0), (0, -1)]
    attitudes = [(turn * np.pi,) for turn in (-1.0, -0.5, 0.0, 0.5)] if "oriented" in task else [()]
    expected = []
    for distance, towards, attitude in itertools.product((100.0, 150.0), directions, attitudes):
        limit = 0.2 + 2 * 0.001027 * distance
        velocities = [np.zeros(len(towards)), *(limit * np.array(directions))]
        expected += [[*(distance * np.array(towards)), *v, *attitude] for v in velocities]
    assert len(expected) == corners
    tolerance = (
        [0.5] * len(directions[0]) + [2e-3] * len(directions[0]) + [1e-3] * len(attitudes[0])
    )
    for row, corner in zip(grid[:corners], np.array(expected), strict=True):
        assert np.any(np.all(np.abs(grid[:corners] - corner) < tolerance, axis=-1)), corner
        assert np.any(np.all(np.abs(expected - row) < tolerance, axis=-1)), row
    assert corners < len(grid) <= 256
    middle = np.linalg.norm(grid[corners:, : len(directions[0])], axis=-1)
    assert np.any(np.abs(middle - 125.0) < 0.5)


@pytest.mark.parametrize("task", ["rejoin2d", "rejoin3d"])
def test_the_grid_of_rejoin_has_all_pairs_of_extremes_equally_often(task: str) -> None:
    grid = grid_columns(task)
    apart = [grid.pop(f"wingman.position.{axis}") - grid[f"lead.position.{axis}"] for axis in "xy"]
    drawn = {**grid, "distance": np.hypot(*apart), "azimuth": np.arctan2(*apart[::-1]) % 6.28}
    # The values are those of two numbers, or of four quarter turns.
    levels = {
        name: np.round((values - values.min()) / np.ptp(values) * 3.0)
        for name, values in drawn.items()
    }
    for one, other in itertools.combinations(levels, 2):
        pairs = np.unique(np.stack([levels[one], levels[other]]), axis=1, return_counts=True)[1]
        sizes = [4 if name.endswith(("heading", "azimuth")) else 2 for name in (one, other)]
        assert pairs.tolist() == [256 // math.prod(sizes)] * math.prod(sizes), (one, other)


def test_a_yaml_file_and_python_give_what_a_csv_file_gives(tmp_path: Path) -> None:
    env = short_docking()
    columns = {name: np.array([80.0, 90.0]) for name in column_names(env)[:2]}
    columns |= {name: np.zeros(2) for name in column_names(env)[2:]}
    table = write(tmp_path / "two.csv", columns)
    mapping = tmp_path / "two.yaml"
    mapping.write_text("".join(f"{name}: {column.tolist()}\n" for name, column in columns.items()))
    rows = [
        jaxsafe.evaluate(env, Idle().policy(0, 0, 0), cases=file) for file in (table, str(mapping))
    ]
    assert rows[0] == rows[1]
    assert rows[0]["episode_length"] == 4.0  # the first step after the limit


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("deputy.position.x,deputy.position.y\n1,2\n", "deputy.velocity is missing"),
        ("deputy.velocity.x\n1\n", "expected all of deputy.velocity.x, deputy.velocity.y, or none"),
        ("deputy.mass\n1\n", "unknown column 'deputy.mass'. Did you mean 'deputy.position.y'"),
        (
            "deputy.positon.x,deputy.position.y\n1,2\n",
            "unknown column 'deputy.positon.x'. Did you mean 'deputy.position.x'",
        ),
        (
            "deputy.position.x\nnan\n",
            "case 0: deputy.position.x: expected a finite number, found nan",
        ),
        ("deputy.position.x\n", "expected columns of one length of at least 1"),
    ],
)
def test_what_are_no_starts_is_refused_in_one_line(
    content: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "wrong.csv"
    file.write_text(content)
    with pytest.raises(ConfigError, match=message) as caught:
        load_cases(short_docking(), str(file))
    assert str(caught.value).startswith(f"cases: {file}: ")
    assert "\n" not in str(caught.value)


def test_the_command_flies_from_the_cases(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = jaxsafe.load_policy(whole / "policy" / "seed_0.npz").env
    states, _ = reset_batch(env, jax.random.key(4), 3)
    file = write(tmp_path / "three.csv", columns_of(env, states))
    out = tmp_path / "out"
    assert main([f"run={whole}", f"cases={file}", f"out={out}"]) == 0
    results = json.loads((out / "results.json").read_text())
    assert (results["cases"], results["episodes"]) == (file, 3)
    assert len((out / "eval.jsonl").read_text().splitlines()) == 2 * 3 * 3
    for wrong in (["cases=docking9"], [f"cases={file}", "episodes=3"]):
        with pytest.raises(ConfigError, match="cases"):
            main([f"run={whole}", *wrong])
