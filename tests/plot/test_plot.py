import json
import re
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.image import imread
from matplotlib.patches import Circle

import jaxsafe
from jaxsafe.commands.plot import main
from jaxsafe.envs import TASKS
from jaxsafe.metrics import bootstrap_interval
from jaxsafe.plot.compare import compare_curves, seed_curves
from jaxsafe.plot.curves import EVALUATIONS, FEW, TRAINING, evaluation_rows, training_curves
from jaxsafe.plot.figures import speed_distance, trajectories
from jaxsafe.plot.learning import learning_curves
from jaxsafe.plot.profiles import performance_profiles
from jaxsafe.plot.style import (
    FAR,
    GREEN,
    GREY,
    ORANGE,
    centre_patch,
    kept_out,
    margin_unit,
    region_patch,
    save,
)
from jaxsafe.processors.constraint import KeepIn, KeepOut
from jaxsafe.processors.status import InRegion
from jaxsafe.processors.terminal import Holds
from jaxsafe.runs.figures import _episodes, draw, draw_all
from jaxsafe.schema import yaml12
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.regions import Box, Cone, HalfSpace, Sphere
from jaxsafe.storage.files import read_csv, read_rows, write_rows
from jaxsafe.train.ppo import DIAGNOSTICS


def rows(num_updates: int = 50, num_seeds: int = 5) -> list[dict]:
    """Return rows of a progress log. Ten episodes end in each update, the first in the fourth."""
    rng = np.random.default_rng(0)
    curves = np.cumsum(rng.random((num_updates, num_seeds)), axis=0) / num_updates
    names = ("success_rate", "return", "length", "delta_v", "violating_steps")
    return [
        {
            "seed": 7 + i,
            "step": 100 * (j + 1),
            "wall_s": 0.5 * j,
            "episodes": max(0, 10 * (j - 2)),
            **dict.fromkeys(names, None if j < 3 else float(curves[j, i])),
        }
        for j in range(num_updates)
        for i in range(num_seeds)
    ]


def evaluated(num_seeds: int = 5, steps: tuple[int, ...] = (0, 1000, 3000, 5000)) -> list[dict]:
    """Return rows of a log of evaluations, with two episodes of each seed at each step."""
    return [
        {
            "step": step,
            "seed": 7 + seed,
            "final": False,
            "success": episode == 0,
            "return": step + seed + episode,
            "length": 10,
            "violating_steps": 4 * episode,
        }
        for step in steps
        for seed in range(num_seeds)
        for episode in range(2)
    ]


def entries(figure: Any) -> list[str]:
    """Return the texts of the legend, which is below the panels or in a spare one."""
    legends = [*figure.legends, *(panel.get_legend() for panel in figure.axes)]
    return [text.get_text() for legend in legends if legend for text in legend.get_texts()]


def title(figure: Any) -> str:
    """Return the title of a figure in one line."""
    return " ".join(figure.get_suptitle().split())


def long(panel: Any, line: str = "-") -> list[Any]:
    """Return the lines of a panel with several points and this line style."""
    return [
        drawn
        for drawn in panel.lines
        if len(drawn.get_xdata()) > 1
        and drawn.get_linestyle() == line
        and drawn.get_color() != GREY
    ]


def test_curves_show_each_seed_their_mean_and_its_interval() -> None:
    figure = training_curves(rows(), "steps", "title")
    panel = figure.axes[0]
    assert panel.get_xlabel() == "environment steps per seed [k]"
    assert panel.get_ylabel() == "success rate [%]"
    # No episode has finished in the first three updates.
    values = np.array([row["success_rate"] or np.nan for row in rows()]).reshape(50, 5)[3:]
    *seeds, mean = long(panel)
    assert len(seeds) == 5
    # The mean is dotted until 20 episodes have ended.
    [few] = long(panel, ":")
    np.testing.assert_allclose(few.get_xdata(), [0.4, 0.5])
    np.testing.assert_allclose(mean.get_xdata(), np.arange(5, 51) / 10)
    np.testing.assert_allclose(mean.get_ydata(), 100 * values.mean(axis=1)[1:])
    shaded = panel.collections[0].get_paths()[0].vertices
    assert shaded[:, 1].max() == pytest.approx(100 * bootstrap_interval(values)[1].max())
    assert entries(figure) == [TRAINING, FEW, "each seed", "95 % interval of the mean"]
    assert {panel.get_xlim()[0] for panel in figure.axes if panel.axison} == {0.0}


def test_evaluations_are_the_main_curve_and_begin_at_step_0() -> None:
    log = evaluation_rows(evaluated(), rows())
    figure = training_curves(rows(), "steps", "title", log)
    panel = figure.axes[1]
    assert panel.get_ylabel() == "return"
    [main] = [line for line in long(panel) if line.get_marker() == "o"]
    np.testing.assert_allclose(main.get_xdata(), [0.0, 1.0, 3.0, 5.0])
    np.testing.assert_allclose(main.get_ydata(), np.array([0, 1000, 3000, 5000]) + 2.5)
    assert len(panel.collections) == 1  # the interval of the main curve
    assert entries(figure)[:3] == [EVALUATIONS, TRAINING, FEW]
    # Too few evaluations make no curve. They are points.
    two = evaluation_rows(evaluated(steps=(0, 5000)), rows())
    panel = training_curves(rows(), "steps", "title", two).axes[1]
    [points] = [line for line in panel.lines if line.get_marker() == "o"]
    assert points.get_linestyle() == "None"


def test_an_evaluation_is_the_mean_of_its_episodes() -> None:
    log = [*evaluated(), {**evaluated()[0], "final": True}]
    first, *_ = evaluation_rows(log, rows())
    assert first == {
        "seed": 7,
        "step": 0,
        "wall_s": 0.0,
        "episodes": 2,
        "success_rate": 0.5,
        "return": 0.5,
        "length": 10.0,
        "delta_v": None,
        "control_effort": None,
        "episode_cost": 2.0,
        "violating_share": 0.2,
        "intervention_share": None,
    }


def test_a_share_of_an_evaluation_is_the_mean_of_the_shares_of_its_episodes() -> None:
    """Episodes count alike here, however long they are. Of all 100 steps 20 % violate."""
    counts = ((10, 5, 1), (90, 15, 45))
    log = [
        {**row, "length": length, "violating_steps": violating, "interventions": interventions}
        for row, (length, violating, interventions) in zip(evaluated(1, (0,)), counts, strict=True)
    ]
    [mean] = evaluation_rows(log, rows(num_seeds=1))
    assert mean["violating_share"] == pytest.approx((5 / 10 + 15 / 90) / 2)
    assert mean["intervention_share"] == pytest.approx((1 / 10 + 45 / 90) / 2)


@pytest.mark.parametrize("num_seeds", [1, 4])
def test_fewer_than_five_seeds_are_drawn_alone(num_seeds: int) -> None:
    log = evaluation_rows(evaluated(num_seeds), rows(num_seeds=num_seeds))
    figure = training_curves(rows(num_seeds=num_seeds), "steps", "title", log)
    panel = figure.axes[1]
    main = [line for line in long(panel) if line.get_marker() == "o"]
    assert len({line.get_color() for line in main}) == len(main) == num_seeds
    assert not panel.collections  # no interval
    seeds = [f"seed {7 + seed}" for seed in range(num_seeds)] if num_seeds > 1 else []
    assert entries(figure) == [*seeds, EVALUATIONS, TRAINING, FEW]


def test_long_trainings_count_millions_of_steps() -> None:
    log = [{**row, "step": 100 * row["step"]} for row in rows()]
    panel = training_curves(log, "steps", "title").axes[0]
    assert panel.get_xlabel() == "environment steps per seed [M]"
    assert panel.get_xlim()[1] == pytest.approx(0.5, rel=0.03)


def test_panels_are_those_that_are_asked_for_or_have_values() -> None:
    figure = training_curves(rows(), "steps", "title", panels=["delta_v", "return"])
    assert [panel.get_ylabel() for panel in figure.axes] == ["Δv per episode [m/s]", "return"]
    with pytest.raises(
        ConfigError, match=r"panels: no values of episode_cost here; choose from su"
    ):
        training_curves(rows(), "steps", "title", panels=["episode_cost"])


@pytest.mark.parametrize(("width", "columns"), [(3.5, 1), (7.0, 2)])
def test_a_figure_is_as_wide_as_asked(width: float, columns: int) -> None:
    figure = training_curves(rows(), "steps", "title", width=width)
    assert figure.get_figwidth() == width
    figure.draw_without_rendering()
    assert len({round(panel.get_position().x0, 2) for panel in figure.axes}) == columns


def test_a_run_in_which_no_episode_ended_has_a_figure_that_says_so() -> None:
    [panel] = training_curves(rows(num_updates=3), "steps", "title").axes
    assert panel.texts[0].get_text() == "no episode has ended yet"


def test_curves_over_wall_time_use_the_clock() -> None:
    panel = training_curves(rows(), "wall", "title").axes[1]
    assert panel.get_xlabel() == "wall time [s]"
    assert panel.get_xlim()[1] == pytest.approx(24.5, rel=0.03)


def episode(step: int, dimension: int) -> tuple[int, list[dict]]:
    path = np.linspace(np.full(dimension, 80.0), np.zeros(dimension), 20)
    status = [
        {
            "docking_distance": float(np.linalg.norm(p)),
            "speed": 0.2,
            "velocity_limit": 0.2 + 0.002 * float(np.linalg.norm(p)),
        }
        for p in path
    ]
    platforms = [
        {"chief": {"position": [0.0] * dimension}, "deputy": {"position": list(p)}} for p in path
    ]
    return step, [{"status": s, "platforms": p} for s, p in zip(status, platforms, strict=True)]


@pytest.mark.parametrize(("dimension", "views"), [(2, 1), (3, 3)])
def test_trajectories_show_one_start_during_training_and_all_after_it_in_each_view(
    dimension: int, views: int
) -> None:
    other = episode(200, dimension)
    for row in other[1]:
        row["platforms"]["deputy"]["position"][0] *= -1.0
    figure = trajectories(
        [episode(0, dimension), episode(100, dimension), episode(200, dimension), other],
        "title",
        "m",
    )
    axes = [panel for panel in figure.axes if panel.get_xlabel() == "x [m]"]
    assert len(axes) == 2 * views
    titled = [panel for panel in axes if panel.get_title()]
    assert [panel.get_title() for panel in titled] == [
        "one start, during training",
        "after training",
    ]
    spatial = [panel for panel in axes if hasattr(panel, "get_zlabel")]
    assert [panel.get_zlabel() for panel in spatial] == ["z [m]"] * 2 * (dimension == 3)
    flat = [panel for panel in axes if panel.get_ylabel() == "y [m]" and panel not in spatial]
    during, after = ([line for line in panel.lines if len(line.get_xdata()) > 1] for panel in flat)
    assert (len(during), len(after)) == (3, 2)
    np.testing.assert_allclose(during[0].get_xdata(), np.linspace(80.0, 0.0, 20))
    np.testing.assert_allclose(after[1].get_xdata(), np.linspace(-80.0, 0.0, 20))
    assert len({line.get_color() for line in during}) == 3
    figure.draw_without_rendering()


def test_the_ends_of_the_paths_have_a_panel_where_a_region_is_small_beside_them() -> None:
    env = jaxsafe.make("docking2d")
    step, rows = episode(100, 2)
    for row in rows:
        row["regions"] = {"docking_region": {"position": [0.0, 0.0]}}
    figure = trajectories([(step, rows)], "title", "m", env.regions)
    assert [panel.get_title() for panel in figure.axes[:3]] == [
        "one start, during training",
        "after training",
        "their ends",
    ]
    assert figure.axes[2].get_xlim() == pytest.approx((-1.5, 1.5))
    unfinished = trajectories([(step, [{**row, "final": False} for row in rows])], "title", "m")
    assert unfinished.axes[1].get_title() == "after 100 steps"


def test_a_platform_alone_is_drawn_where_it_is_and_a_training_that_diverged_leaves_gaps() -> None:
    alone = [
        {"platforms": {"deputy": {"position": [3.0 - k, 4.0]}}, "status": {}} for k in range(4)
    ]
    figure = trajectories([(0, alone)], "title", "m")
    path = next(line for line in figure.axes[0].lines if len(line.get_xdata()) > 1)
    np.testing.assert_allclose(path.get_xydata()[0], [3.0, 4.0])
    assert figure.axes[0].get_xlim()[1] > 3.0
    step, rows = episode(100, 2)
    for row in rows[5:]:
        row["platforms"]["deputy"]["position"] = [None, None]
        row["status"] = dict.fromkeys(row["status"])
    # the colour bar is an axis too
    assert len(trajectories([(step, rows)], "title", "m").axes) == 3
    assert speed_distance([(step, rows)], "title").axes[0].get_xlim()[1] > 113.0
    rests = [{"platforms": {name: {"position": [0.0, 0.0]} for name in ("chief", "deputy")}}] * 3
    assert trajectories([(0, rests)], "title", "m").axes[0].get_xlim() == (-1.0, 1.0)


def test_early_policies_that_go_far_away_do_not_set_the_scale() -> None:
    far = episode(0, 2)
    for k, row in enumerate(far[1]):
        row["platforms"]["deputy"]["position"] = [80.0 + 100.0 * k, 80.0]
        row["status"] |= {"docking_distance": 113.0 + 100.0 * k, "speed": 5.0}
    panel = trajectories([far, episode(100, 2)], "title", "m").axes[0]
    assert panel.get_xlim() == panel.get_ylim() == pytest.approx((-128.0, 128.0))
    panel = speed_distance([far, episode(100, 2)], "title").axes[0]
    assert panel.get_xlim()[1] < 150.0
    assert panel.get_ylim()[1] < 1.0


def test_paths_are_seen_from_the_lead_along_its_heading_with_the_region_that_it_carries() -> None:
    env = jaxsafe.make("rejoin2d")
    # The lead flies a turn. The wingman keeps 300 ft behind and 100 ft aside of it.
    heading = np.linspace(0.0, 2.0, 30)
    lead = 1e4 * np.stack([np.sin(heading), 1.0 - np.cos(heading)], axis=1)
    ahead = np.stack([np.cos(heading), np.sin(heading)], 1)
    aside = np.stack([-np.sin(heading), np.cos(heading)], 1)
    rows = [
        {
            "platforms": {
                "lead": {"position": list(p), "heading": h},
                "wingman": {"position": list(p - 300 * a + 100 * b)},
            },
            "regions": {"rejoin_region": {"position": list(p - 250 * a + 433 * b)}},
        }
        for p, h, a, b in zip(lead, heading, ahead, aside, strict=True)
    ]
    panel = trajectories([(100, rows)], "title", "ft", env.regions).axes[0]
    behind, path = (line for line in panel.lines if len(line.get_xdata()) > 1)
    np.testing.assert_allclose(path.get_xydata(), np.tile([-300.0, 100.0], (30, 1)), atol=1e-6)
    # Where the lead came from is seen from where it is at the end.
    from_end = lead - lead[-1]
    expected = np.stack([from_end @ ahead[-1], from_end @ aside[-1]], axis=1)
    np.testing.assert_allclose(behind.get_xydata(), expected, atol=1e-6)
    assert behind.get_label() == "path of the lead"
    (region,) = panel.patches
    assert isinstance(region, Circle)
    np.testing.assert_allclose(region.center, [-250.0, 433.0], atol=1e-6)
    assert region.radius == float(env.regions[0].radius)
    assert panel.get_xlabel() == "ahead of the lead [ft]"
    assert panel.get_ylabel() == "left of the lead [ft]"

    # A region that stays in place has none on this map.
    zone = Sphere(name="zone", on=None, radius=10.0)
    for row in rows:
        row["regions"]["zone"] = {"position": [0.0, 0.0]}
    panel = trajectories([(100, rows)], "title", "ft", [*env.regions, zone]).axes[0]
    assert [patch.get_label() for patch in panel.patches] == ["rejoin_region"]


def test_the_speed_limit_is_drawn_from_the_log() -> None:
    panel = speed_distance([episode(100, 2)], "title").axes[0]
    limit = next(line for line in panel.lines if line.get_label() == "speed limit")
    np.testing.assert_allclose(limit.get_ydata(), 0.2 + 0.002 * np.asarray(limit.get_xdata()))
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("distance to the chief [m]", "speed [m/s]")


def test_figures_come_from_the_log_files_alone(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    for name in ("config.yaml", "progress.jsonl", "episodes.jsonl"):
        shutil.copy(whole / name, run / name)
    assert main([f"run={run}", "x=wall"]) == 0
    drawn = {path.name for path in (run / "figures").iterdir()}
    curves = {"training_wall.png", "learning_wall.png"}
    assert drawn == {*curves, "trajectories.png", "speed_distance.png"}
    for name in curves:
        image = imread(run / "figures" / name)
        assert image.shape[0] > 300
        assert image[..., :3].std() > 0.05  # the picture is not blank


def test_the_title_of_a_figure_tells_what_the_run_is(whole: Path, tmp_path: Path) -> None:
    for name in ("config.yaml", "progress.jsonl"):
        shutil.copy(whole / name, tmp_path / name)
    told = "docking2d, preset engineered_features, ppo, rta none, 3 seeds"
    for name, figure in draw(tmp_path).items():
        assert told in title(figure), name


def test_the_title_of_a_comparison_tells_what_the_runs_share(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for run in ("one", "other"):
        (tmp_path / run).mkdir()
        for name in ("config.yaml", "progress.jsonl", "results.json"):
            shutil.copy(whole / name, tmp_path / run)
    titles = []

    def keep(figure: Any, path: Path) -> Path:
        titles.append(title(figure))
        return path

    monkeypatch.setattr("jaxsafe.plot.style.save", keep)
    out = tmp_path / "both.png"
    assert main([f"run=[{tmp_path / 'one'},{tmp_path / 'other'}]", f"out={out}"]) == 0
    assert len(titles) == 2
    told = "docking2d, preset engineered_features, ppo, rta none, 3 seeds"
    assert all(told in title for title in titles)


def diagnostics(num_seeds: int = 4) -> list[dict]:
    """Return rows of a log with diagnostics. The explained variance is unknown at first."""
    rng = np.random.default_rng(1)
    return [
        {**row, **{name: rng.random() for name in DIAGNOSTICS}, "gamma": 0.9}
        | ({"explained_variance": None} if row["step"] == 100 else {})
        for row in rows(num_seeds=num_seeds)
    ]


def test_what_is_learnt_is_drawn_as_the_median_and_the_range_of_the_seeds() -> None:
    log = diagnostics(num_seeds=5)
    figure = learning_curves(log, "steps", "title")
    assert figure is not None
    assert len([panel for panel in figure.axes if panel.axison]) == len(DIAGNOSTICS)
    panels = {panel.get_title(): panel for panel in figure.axes}
    for title, name, factor in (
        ("value loss", "value_loss", 1),
        ("clip fraction [%]", "clip_fraction", 100),
    ):
        values = factor * np.array([row[name] for row in log]).reshape(50, 5)
        (line,) = panels[title].lines
        np.testing.assert_allclose(line.get_ydata(), np.median(values, axis=1))
        np.testing.assert_allclose(line.get_xdata(), np.arange(1, 51) / 10)
        shaded = panels[title].collections[0].get_paths()[0].vertices
        assert {shaded[:, 1].min(), shaded[:, 1].max()} == {values.min(), values.max()}
    assert panels["value loss"].get_yscale() == "log"
    assert panels["explained variance"].lines[0].get_xdata()[0] == 0.2
    assert figure.get_supxlabel() == "environment steps per seed [k]"
    assert figure.get_suptitle() == "title\neach update, median and range of the seeds"


def test_what_fewer_than_five_seeds_learn_is_drawn_one_by_one() -> None:
    log = diagnostics(num_seeds=2)
    figure = learning_curves(log, "steps", "title")
    assert figure is not None
    panels = {panel.get_title(): panel for panel in figure.axes}
    values = np.array([row["entropy"] for row in log]).reshape(50, 2)
    drawn = [line.get_ydata() for line in panels["entropy [nat]"].lines]
    np.testing.assert_allclose(drawn, values.T)
    assert list(panels["entropy [nat]"].collections) == []  # no band
    assert entries(figure) == [f"seed {seed}" for seed in sorted({row["seed"] for row in log})]
    assert figure.get_suptitle() == "title\neach update, every seed"


@pytest.mark.parametrize("left_out", [(), ("cost_value_loss",)])
def test_every_title_of_what_is_learnt_fits_into_its_row(left_out: tuple[str, ...]) -> None:
    log = [row | dict.fromkeys(left_out) for row in diagnostics()]
    figure = learning_curves(log, "steps", "title")
    assert figure is not None
    figure.draw_without_rendering()
    titles = [panel.title for panel in figure.axes if panel.axison]
    extents = [title.get_window_extent() for title in titles]
    assert max(extent.x1 for extent in extents) <= figure.bbox.x1
    for left, right in pairwise(extents):
        assert left.x1 < right.x0 or right.x0 < left.x0  # beside it, or in the next row


def test_the_figure_of_what_is_learnt_has_what_the_log_has() -> None:
    without_cost = [
        {name: value for name, value in row.items() if name != "cost_value_loss"}
        for row in diagnostics(num_seeds=1)
    ]
    figure = learning_curves(without_cost, "wall", "title")
    assert figure is not None
    assert len([panel for panel in figure.axes if panel.axison]) == len(DIAGNOSTICS) - 1
    assert figure.get_supxlabel() == "wall time [s]"
    assert figure.get_suptitle() == "title\neach update, one seed"
    nothing = [row | dict.fromkeys(DIAGNOSTICS) for row in without_cost]
    assert learning_curves(nothing, "steps", "title") is None
    broken = [row | {"diverged": row["seed"] == 8} for row in diagnostics(num_seeds=6)]
    figure = learning_curves(broken, "steps", "title")
    assert figure is not None
    assert figure.get_suptitle().endswith("range of the seeds, without seed 8, which diverged")


def test_each_limited_constraint_has_a_panel_of_its_multiplier_and_of_its_cost() -> None:
    by_name = {"multiplier/velocity_limit": 0.5, "episode_cost/velocity_limit": 3.0}
    figure = learning_curves([row | by_name for row in diagnostics(5)], "steps", "title")
    assert figure is not None
    panels = {panel.get_title(): panel for panel in figure.axes}
    multiplier = panels["multiplier of\nvelocity_limit"]
    assert multiplier.get_yscale() == "log"
    np.testing.assert_array_equal(multiplier.lines[0].get_ydata(), 0.5)
    np.testing.assert_array_equal(
        panels["cost of an episode,\nvelocity_limit"].lines[0].get_ydata(), 3.0
    )


def test_a_run_of_an_older_version_is_drawn_without_what_is_learnt(
    whole: Path, tmp_path: Path
) -> None:
    assert learning_curves(rows(), "steps", "title") is None
    shutil.copy(whole / "config.yaml", tmp_path)
    log = read_rows(whole / "progress.jsonl")
    older = [{name: value for name, value in row.items() if name not in DIAGNOSTICS} for row in log]
    write_rows(tmp_path / "progress.jsonl", older)
    assert [path.name for path in draw_all(tmp_path)] == ["training_steps.png"]


@pytest.mark.thorough
def test_the_agent_is_drawn_whatever_it_and_the_others_are_called(
    whole: Path, tmp_path: Path
) -> None:
    """Logs have the platforms in alphabetical order."""
    for name in ("config.yaml", "progress.jsonl", "episodes.jsonl"):
        text = (whole / name).read_text()
        (tmp_path / name).write_text(
            re.sub(r"\bchief\b", "target", re.sub(r"\bdeputy\b", "chaser", text))
        )
    rows = [json.loads(line) for line in (tmp_path / "episodes.jsonl").read_text().splitlines()]
    # the target is the chief, the chaser the deputy
    assert [*rows[0]["platforms"]] == ["target", "chaser"]
    swapped = [
        {**row, "platforms": {name: row["platforms"][name] for name in ("chaser", "target")}}
        for row in rows
    ]
    (tmp_path / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in swapped))
    episodes = _episodes(tmp_path / "episodes.jsonl", ["target", "chaser"])
    figure = trajectories(episodes, "title", "m")
    expected = swapped[-1]["platforms"]["chaser"]["position"]
    ends = [line.get_xydata()[-1] for line in figure.axes[1].lines]
    assert min(np.abs(end - np.array(expected)).max() for end in ends) < 1e-3
    assert draw_all(tmp_path)


FORMULA = "$\\frac{$"
NASTY = [FORMULA, "_old", "$x$", r"\$a$", "a\x1b]0;b\x07c", "\udcff"]


@pytest.mark.parametrize("name", NASTY)
def test_names_are_drawn_letter_by_letter(name: str) -> None:
    figure = compare_curves({name: rows(), f"{name}2": rows()}, name, mark=(name, 1000.0))
    figure.draw_without_rendering()
    shown = entries(figure)
    assert len(shown) == 5  # two runs, the mark, and two of the training
    drawn = figure.axes[0].text(0.0, 0.0, shown[0])
    assert drawn._preprocess_math(shown[0])[1] is False  # pyright: ignore[reportAttributeAccessIssue]
    seen = drawn._preprocess_math(shown[0])[0]  # pyright: ignore[reportAttributeAccessIssue]
    assert seen.removeprefix("\u200b") == name.replace("\x1b", r"\x1b").replace(
        "\x07", r"\x07"
    ).replace("\udcff", "?")


def test_an_interval_is_drawn_and_named_only_where_there_are_seeds_enough() -> None:
    for count, interval in ((4, False), (5, True)):
        figure = training_curves(rows(num_seeds=count), "steps", "title")
        named = "95 % interval of the mean" in entries(figure)
        assert named == bool(figure.axes[0].collections) == interval
        figure = compare_curves({"one": rows(num_seeds=count)}, "docking2d")
        what = ": mean and 95 % interval over seeds" * interval
        assert figure.get_suptitle() == f"docking2d{what}"
        assert bool(figure.axes[0].collections) == interval
        assert len(long(figure.axes[0])) == (1 if interval else count)


def test_evaluations_are_the_main_curves_of_a_comparison() -> None:
    log = {"one": evaluation_rows(evaluated(), rows())}
    figure = compare_curves({"one": rows(), "other": rows()}, "title", evaluations=log)
    panel = figure.axes[1]
    training, main, other = long(panel)
    assert main.get_marker() == "o"
    assert main.get_color() == training.get_color() != other.get_color()
    assert main.get_linewidth() == other.get_linewidth() > training.get_linewidth()
    assert entries(figure) == ["one", "other", EVALUATIONS, TRAINING, FEW]


@pytest.mark.parametrize(
    ("region", "corners"),
    [
        (Box(name="r", on=None, size=(4.0, 2.0)), {(1, 0), (5, 0), (5, 2), (1, 2)}),
        (
            Cone(name="r", on=None, towards=(0.0, 3.0), half_angle=np.pi / 4, length=2.0),
            {(3, 1), (5, 3), (1, 3)},
        ),
        (
            HalfSpace(name="r", on=None, towards=(5.0, 0.0)),
            {(3, FAR + 1), (3, 1 - FAR), (FAR + 3, FAR + 1), (FAR + 3, 1 - FAR)},
        ),
        (Box(name="r", on="deputy", size=(4.0, 2.0), turns=True), {(3, 1)}),
    ],
)
def test_the_outline_of_a_region_has_its_corners_about_its_centre(
    region: Any, corners: set[tuple[float, float]]
) -> None:
    patch = region_patch(normalise(region), from_the_side=False)
    centre_patch(patch, np.array([3.0, 1.0]))
    assert {tuple(np.round(corner, 4)) for corner in patch.get_xy()} == corners
    still = region_patch(normalise(region), from_the_side=False, turned=True)
    assert not still.get_xy().any()


@pytest.mark.parametrize(("kind", "forbidden"), [(KeepOut, {"zone"}), (KeepIn, set())])
def test_a_region_to_stay_in_is_not_drawn_as_one_to_stay_out_of(
    kind: type[KeepOut], forbidden: set[str]
) -> None:
    env = jaxsafe.make("docking2d")
    zone = Sphere(name="zone", on="chief", radius=200.0)
    changes = {
        "regions": [*env.regions, zone],
        "status": [*env.status, InRegion(name="in_zone", of="deputy", region="zone")],
        "constraints": [*env.constraints, kind(name="zone", of="deputy", region="zone")],
        # A failure about the region says nothing about its side.
        "terminal": [*env.terminal, Holds(name="zone", status="in_zone")],
    }
    env = jaxsafe.override(env, changes)
    assert kept_out(env) == forbidden
    assert [margin_unit(one, "m") for one in env.constraints] == ["m/s", "m"]


def test_what_to_stay_out_of_is_not_drawn_like_the_goal() -> None:
    assert kept_out(jaxsafe.make(Path(__file__).parents[2] / "configs" / "custom_env.yaml")) == {
        "keep_out"
    }
    for task in TASKS:
        assert kept_out(jaxsafe.make(task)) == set()
    step, rows = episode(100, 2)
    for row in rows:
        row["regions"] = {"docking_region": {"position": [0.0, 0.0]}}
    env = jaxsafe.make("docking2d")
    for forbidden, colour, hatch in (((), GREEN, None), (("docking_region",), ORANGE, "////")):
        panel = trajectories([(step, rows)], "title", "m", env.regions, forbidden).axes[0]
        assert to_hex(panel.patches[0].get_facecolor()).upper() == colour
        assert panel.patches[0].get_hatch() == hatch


@pytest.mark.filterwarnings("error")
def test_only_regions_with_a_radius_have_a_close_up() -> None:
    step, rows = episode(100, 2)
    for row in rows:
        row["regions"] = {"region": {"position": [0.0, 0.0]}}
    round_one = normalise(Sphere(name="region", on="chief", radius=1e-3))
    cone = normalise(Cone(name="region", on="chief", towards=(1.0, 0.0), half_angle=0.5))
    titles = [
        {panel.get_title() for panel in trajectories([(step, rows)], "title", "m", [one]).axes}
        for one in (round_one, cone)
    ]
    assert "their ends" in titles[0]
    assert "their ends" not in titles[1]


@pytest.mark.thorough
@pytest.mark.parametrize("nasty", [FORMULA, "_$x"])
def test_a_run_whose_every_name_is_a_formula_is_drawn(
    whole: Path,
    tmp_path: Path,
    nasty: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The names are those of the environment, of its platforms and regions, and of the run."""

    def renamed(value: Any) -> Any:
        if isinstance(value, dict):
            return {renamed(key): renamed(item) for key, item in value.items()}
        if isinstance(value, list):
            return [renamed(item) for item in value]
        first, *rest = value.split(".") if isinstance(value, str) else [value]
        if first not in ("docking2d", "chief", "deputy", "docking_region"):
            return value
        return ".".join([f"{first}{nasty}", *rest])

    monkeypatch.chdir(tmp_path)
    run = tmp_path / nasty
    shutil.copytree(whole, run, ignore=shutil.ignore_patterns("figures"))
    content = yaml12.parse(
        (whole / "config.yaml").read_text().replace("features: docking2d", "features: x"), "x"
    )
    (run / "config.yaml").write_text(yaml12.write(renamed(content)))
    for log in ("episodes.jsonl", "progress.jsonl"):
        lines = (whole / log).read_text().splitlines()
        (run / log).write_text(
            "".join(json.dumps(renamed(json.loads(line))) + "\n" for line in lines)
        )
    shutil.copytree(run, tmp_path / "other")
    assert main([f"run={nasty}"]) == 0
    assert "trajectories.png" in capsys.readouterr().out
    assert main([f"run=['{nasty}',other]"]) == 0


@pytest.mark.parametrize("kind", ["png", "pdf", "svg"])
def test_a_figure_is_of_the_kind_that_its_name_says(kind: str, tmp_path: Path) -> None:
    path = save(training_curves(rows(2), "steps", "title"), tmp_path / f"x.{kind}")
    assert (
        path.read_bytes()[:5] in {"png": [b"\x89PNG\r"], "pdf": [b"%PDF-"], "svg": [b"<?xml"]}[kind]
    )
    with pytest.raises(ConfigError, match=r"out: cannot draw x\.docx; choose from "):
        save(training_curves(rows(2), "steps", "title"), tmp_path / "x.docx")


def test_a_run_without_rows_is_told_in_one_line(whole: Path, tmp_path: Path) -> None:
    shutil.copy(whole / "config.yaml", tmp_path / "config.yaml")
    with pytest.raises(ConfigError, match=r"has no rows in progress\.jsonl yet"):
        draw_all(tmp_path)
    (tmp_path / "progress.jsonl").write_text(
        json.dumps(rows(1)[0] | {"episodes": 0, "cost": 0}) + "\nbroken\n{}\n"
    )
    with pytest.raises(ConfigError, match=r"progress\.jsonl, line 2"):
        draw_all(tmp_path)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "episodes.jsonl",
            '"position": [',
            '"position": ["x", ',
            "row 1: platforms.chief.position: expected a list",
        ),
        (
            "episodes.jsonl",
            '"final": false',
            '"final": null',
            "row 1: final: expected true or false, found None",
        ),
        (
            "episodes.jsonl",
            '"speed"',
            '"sped"',
            "row 1: status.speed: expected a number or null, found nothing",
        ),
        (
            "progress.jsonl",
            '"return": null',
            '"return": "x"',
            "line 1: not a row of this log: return: expected",
        ),
        ("progress.jsonl", '"step": 64', '"step": 65', "progress.jsonl, row "),
        (
            "results.json",
            '"mean": 0.0',
            '"mean": -1',
            "expected a number from 0 to 1 or null, found -1",
        ),
        (
            "results.json",
            '"wall_s"',
            '"wall"',
            "results.json: wall_s: expected a number ≥ 0, found nothing",
        ),
    ],
)
def test_what_is_drawn_or_told_is_checked_first(
    whole: Path, tmp_path: Path, name: str, old: str, new: str, message: str
) -> None:
    for run in ("one", "other"):
        (tmp_path / run).mkdir()
        for file in ("config.yaml", "progress.jsonl", "episodes.jsonl", "results.json"):
            shutil.copy(whole / file, tmp_path / run)
    path = tmp_path / "one" / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    runs = (
        f"[{tmp_path / 'one'},{tmp_path / 'other'}]"
        if name == "results.json"
        else str(tmp_path / "one")
    )
    with pytest.raises(ConfigError) as caught:
        main([f"run={runs}"])
    assert message in str(caught.value)


def test_several_runs_in_one_figure_with_a_table(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("ppo", "limited"):
        shutil.copytree(whole, name)
    assert main(["run=[ppo,limited]", "x=wall", "out=both.png"]) == 0
    heads, first, second, *written = capsys.readouterr().out.splitlines()
    assert "success, stochastic" in heads
    assert "violating steps in training" in heads
    assert [(line.split()[0], *line.split()[-2:]) for line in (first, second)] == [
        ("ppo", "ppo", "none"),
        ("limited", "ppo", "none"),
    ]
    assert written == ["both.png", "both_profiles.png", "both.csv", "both.tex"]
    for name in written[:2]:
        assert imread(name).shape[2] == 4
    results = json.loads((whole / "results.json").read_text())
    success = results["evaluation"]["stochastic"]["success_rate"]
    row, _ = read_csv(Path("both.csv"))
    assert (row["run"], row["algorithm"], row["seeds"]) == ("ppo", "ppo", 3)
    low, high = success["ci95"]
    assert row["stochastic/success_rate/mean"] == pytest.approx(success["mean"])
    assert row["stochastic/success_rate/low"] == pytest.approx(low)
    assert row["stochastic/success_rate/high"] == pytest.approx(high)
    (tmp_path / "limited" / "results.json").unlink()
    for runs, message in (
        ("[ppo]", "expected several directories of different names, found ppo"),
        ("[ppo,x/ppo]", "expected several directories of different names"),
        ("[ppo,limited]", "limited has no results.json; finish it with"),
        ("[ppo,none]", "no run in 'none'"),
        ("none*", r"run: no run fits 'none\*'"),
    ):
        with pytest.raises(ConfigError, match=message):
            main([f"run={runs}"])
    for words, message in (
        (["run=ppo", "out=x.png"], "out: means nothing but for several runs"),
        (["run=ppo", "labels=[x]"], "labels: means nothing but for several runs"),
        (["run=[ppo,limited]", "labels=[x]"], "labels: expected one for each of 2 runs"),
        (["run=[ppo,limited]", "labels=[x,x]"], "labels: expected different ones, found x, x"),
        (["run=ppo", "width=1"], "width: expected a number of inches from 2 to 40, found 1"),
        (["run=ppo", "width=wide"], "width: expected a number of inches"),
        (["run=ppo", "panels=[reward]"], "panels: unknown panel 'reward'. Did you mean 'return'"),
        (["run=ppo", "panels=[intervention_share]"], "panels: no values of intervention_share"),
        (["run=ppo", "format=bmp"], "format: unknown format 'bmp'; choose from png, pdf, svg"),
    ):
        with pytest.raises(ConfigError, match=message):
            main(words)


def test_a_pattern_that_one_run_fits_draws_that_run(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(whole, Path("runs") / "only", ignore=shutil.ignore_patterns("figures"))
    assert main(["run=runs/*", "format=svg", "panels=[return]"]) == 0
    assert (tmp_path / "runs" / "only" / "figures" / "training_steps.svg").exists()
    with pytest.raises(ConfigError, match="out: means nothing but for several runs"):
        main(["run=runs/*", "out=both.png"])


@pytest.mark.thorough
def test_a_pattern_stands_for_runs_and_labels_name_them(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        shutil.copytree(whole, Path("runs") / name)
    Path("runs/notes.txt").write_text("no run")
    words = [
        "run=runs/*",
        "labels=[50 % _off_,other]",
        "panels=[return]",
        "format=pdf",
        "width=3.5",
    ]
    assert main(words) == 0
    written = ["comparison.pdf", "comparison_profiles.pdf", "comparison.csv", "comparison.tex"]
    *_, first, _ = capsys.readouterr().out.split("comparison.pdf")[0].splitlines()
    assert first.startswith("50 % _off_")
    assert sorted(path.name for path in tmp_path.glob("comparison*")) == sorted(written)
    assert r"50 \% \_off\_ & " in Path("comparison.tex").read_text()
    with pytest.raises(ConfigError, match=r"format: found svg, but out=x\.pdf says pdf"):
        main(["run=runs/*", "out=x.pdf", "format=svg"])
    assert main(["run=runs/a", "format=svg", "panels=[return]"]) == 0
    assert {path.suffix for path in Path("runs/a/figures").glob("t*.svg")} == {".svg"}


def test_a_profile_is_the_share_of_seeds_above_each_score() -> None:
    panels = {"success rate τ [%]": {"one": [50.0, 60.0, 90.0, 100.0, 100.0], "few": [70.0]}}
    figure = performance_profiles(panels, "title", None)
    panel = figure.axes[0]
    one, few = panel.lines
    share = np.interp([55.0, 80.0, 95.0], one.get_xdata(), one.get_ydata())
    np.testing.assert_allclose(share, [80.0, 60.0, 40.0])
    assert set(few.get_ydata()) == {0.0, 100.0}
    assert len(panel.collections) == 1  # one seed has no interval
    assert entries(figure) == ["one", "few"]


def test_comparison_is_logarithmic_only_where_runs_differ_much_in_length():
    def rows(steps):
        quantities = dict.fromkeys(("success_rate", "return", "length"), 0.5)
        return [
            {"step": step, "wall_s": step / 1e4, "seed": 0, "episodes": 9, **quantities}
            for step in (1000, steps)
        ]

    for steps, mark, scale in (
        (5_000, None, "linear"),
        (50_000, None, "log"),
        (5_000, ("far", 50_000.0), "log"),
    ):
        figure = compare_curves({"one": rows(2_000), "other": rows(steps)}, "docking2d", mark=mark)
        assert {panel.get_xscale() for panel in figure.axes} == {scale}


def test_curves_of_a_comparison_are_dotted_until_every_seed_has_finished_enough_episodes() -> None:
    # each update finishes 10 more episodes
    log = rows()
    panel = compare_curves({"one": log}, "docking2d", mark=("the paper's 80 %", 3000.0)).axes[0]
    [curve] = long(panel)
    [few] = long(panel, ":")
    assert (few.get_xdata()[0], curve.get_xdata()[0]) == (0.4, 0.5)
    never = [{**row, "episodes": row["episodes"] // 50} for row in log]
    panel = compare_curves({"one": never}, "docking2d", mark=("the paper's 80 %", 3000.0)).axes[0]
    assert not long(panel)
    assert len(long(panel, ":")) == 1
    (mark,) = [line for line in panel.lines if line.get_marker() == "*"]
    assert mark.get_xydata().tolist() == [[3.0, 80.0]]


def test_every_seed_has_its_line_and_those_that_failed_are_named() -> None:
    failing = [
        {**row, "success_rate": 0.3} if row["seed"] == 8 else {**row, "success_rate": 0.9}
        for row in rows(500)
    ]
    figure = seed_curves(
        {"one": failing, "other": rows(500)}, "docking2d", {"one": [8], "other": []}
    )
    seeds = {row["seed"] for row in failing}
    assert [len(panel.lines) for panel in figure.axes] == [
        len(seeds) + 1
    ] * 2  # one more: the 80 % line
    assert [panel.get_title() for panel in figure.axes] == [
        "one: seed 8 failed",
        "other: no seed failed",
    ]
    dashed = [line for line in figure.axes[0].lines if line.get_linestyle() == "--"]
    assert len(dashed) == 1
    np.testing.assert_allclose(dashed[0].get_ydata(), 30.0)
