import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough
from matplotlib.contour import ContourSet
from matplotlib.image import imread

import jaxsafe
from jaxsafe.commands import safe_set as command
from jaxsafe.config import describe
from jaxsafe.environment import control_unit
from jaxsafe.plot import safe_set
from jaxsafe.plot.interventions import interventions, most_altered
from jaxsafe.rta.cascade import Cascade, Stage
from jaxsafe.runs.figures import draw_all
from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError


def episode(env: jaxsafe.Environment, altered: tuple[int, ...]) -> list[dict]:
    """Return a log of eight steps, some of them altered.

    In an altered step the control that acts is half of the desired one.
    """
    names = env.action_names
    rows = []
    for k in range(9):
        asked = dict.fromkeys(names, 0.02 * k)
        rows.append(
            {
                "t": float(k),
                "control_desired": asked,
                "control_actual": {
                    name: value / (2.0 if k in altered else 1.0) for name, value in asked.items()
                },
                "margins": {constraint.name: 1.0 - 0.1 * k for constraint in env.constraints},
                "rta": {"intervening": k in altered, "predicted_margin": 0.9 - 0.1 * k},
                "outcome": "success" if k == 8 else "running",
            }
        )
    return rows


def labels(figure: object) -> list[str]:
    return [panel.get_ylabel().replace("\n", " ") for panel in figure.axes]  # type: ignore[attr-defined]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("docking2d", ["thrust x [N]", "thrust y [N]", "h of velocity limit [m/s]"]),
        thorough(
            "docking2d_oriented",
            ["thrust [N]", "attitude acceleration [rad/s²]", "h of velocity limit [m/s]"],
        ),
        thorough(
            "rejoin2d", ["heading rate [rad/s]", "acceleration [ft/s²]", "h of collision [ft]"]
        ),
    ],
)
def test_interventions_have_a_panel_for_each_control_and_constraint(
    task: str, expected: list[str]
) -> None:
    env = jaxsafe.make(task, rta="default")
    figure = interventions(episode(env, (3, 4, 7)), env, "title")
    assert labels(figure) == expected
    assert figure.axes[-1].get_xlabel() == "time [s]"
    assert "altered on 38 % of the steps, ended with success" in figure.get_suptitle()


def test_interventions_show_what_was_asked_for_and_what_acted() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    figure = interventions(episode(env, (3, 4, 7)), env, "title")
    panel = figure.axes[0]
    steps = {patch.get_label(): patch.get_data() for patch in panel.patches}  # type: ignore[attr-defined]
    # The start has no control.
    np.testing.assert_allclose(steps["desired"].values, 0.02 * np.arange(1, 9))
    np.testing.assert_allclose(steps["actual"].values[[1, 2, 3, 4]], [0.04, 0.03, 0.04, 0.10])
    np.testing.assert_allclose(steps["actual"].edges, np.arange(9))
    spans = [path.get_extents().intervalx for path in panel.collections[0].get_paths()]
    np.testing.assert_allclose(spans, [[2, 4], [6, 7]])  # row k is about the step from k − 1 to k
    assert [line.get_ydata()[0] for line in panel.lines] == [-1.0, 1.0]  # type: ignore[index]
    h, predicted, zero = figure.axes[-1].lines
    np.testing.assert_allclose(h.get_ydata(), 1.0 - 0.1 * np.arange(9))
    np.testing.assert_allclose(predicted.get_ydata(), 0.9 - 0.1 * np.arange(9))
    assert list(zero.get_ydata()) == [0.0, 0.0]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "altered",
        "desired",
        "actual",
        "h",
        "h, predicted",
    ]


def test_a_prediction_about_something_else_has_a_panel_of_its_own() -> None:
    env = jaxsafe.make("rejoin2d", rta="released")
    figure = interventions(episode(env, ()), env, "title")
    assert labels(figure)[-2:] == ["h of collision [ft]", "predicted margin"]
    assert len(figure.axes[-2].lines) == 2  # h and the line at zero


def test_a_null_of_the_log_leaves_a_gap() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    rows = episode(env, (2,))
    rows[5]["margins"]["velocity_limit"] = None
    line = interventions(rows, env, "title").axes[-1].lines[0]
    assert np.isnan(np.asarray(line.get_ydata(), float)).sum() == 1


def test_the_episode_that_was_altered_most_is_shown() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    first, none, most, few = (episode(env, altered) for altered in ((1, 2, 3), (), (4, 5), (6,)))
    assert most_altered([(100, first), (200, none), (200, most), (200, few)]) is most


def test_units_of_controls_come_from_their_names() -> None:
    assert control_unit("acceleration", "m") == "m/s²"
    assert control_unit("flight_path_angle_rate", "ft") == "rad/s"
    assert control_unit("flaps", "ft") is None


@pytest.mark.thorough
def test_only_a_run_with_a_filter_draws_interventions(whole: Path, tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d", rta="default")
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(whole / "progress.jsonl", run)
    content = {
        "env": "docking2d",
        "training": {"preset": "engineered_features"},
        "environment": describe(env),
    }
    (run / "config.yaml").write_text(yaml12.write(content))
    common = {
        "step": 1280,
        "final": True,
        "episode": 0,
        "platforms": {"chief": {"position": [0.0, 0.0]}, "deputy": {"position": [9.0, 0.0]}},
        "status": {"docking_distance": 9.0, "speed": 0.1, "velocity_limit": 0.2},
    }
    (run / "episodes.jsonl").write_text(
        "".join(json.dumps(common | row) + "\n" for row in episode(env, (3,)))
    )
    draw_all(run)
    curves = {"training_steps.png", "learning_steps.png"}
    names = {*curves, "trajectories.png", "speed_distance.png"}
    assert {path.name for path in (run / "figures").iterdir()} == {*names, "interventions.png"}
    assert (
        imread(run / "figures" / "interventions.png")[..., :3].std() > 0.05
    )  # the picture is not blank


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("task", "rta"),
    [
        ("docking2d", "default"),
        thorough("docking3d", "implicit_simplex"),
        thorough("rejoin2d", "default"),
    ],
)
def test_what_is_drawn_as_certified_is_what_the_filter_certifies(task: str, rta: str) -> None:
    env = jaxsafe.make(task, rta=rta)
    plane = safe_set.planes(env)
    x = np.linspace(*plane.x_ends, 9)
    y = np.linspace(*plane.y_ends, 7)
    starts = jax.jit(lambda env, start: jaxsafe.reset_to(env, start)[1].info)
    for start in plane.panels.values():
        best, h = safe_set.survey(env, start, x, y)
        assert best.shape == h.shape == (7, 9)
        certified = np.asarray(best >= env.rta.margin)
        assert 0.1 < certified.mean() < 1.0
        assert (best <= h).all()
        for i, j in [(0, 0), (3, 8), (4, 2), (5, 3), (6, 8)]:
            info = starts(env, at(env, start, x[j], y[i]))
            assert bool(info.rta.certified) == certified[i, j]
            np.testing.assert_allclose(
                h[i, j],
                min(float(constraint) for constraint in info.margins.values()),
                rtol=1e-5,
                atol=1e-5,
            )


def at(env: jaxsafe.Environment, start: safe_set.Start, x: float, y: float) -> dict:
    """Return a start for `reset_to`. Fields that a plane leaves out are as at rest."""
    sim = safe_set.place(env, start(jnp.asarray(x), jnp.asarray(y)))
    return {name: vars(state) for name, state in sim.platforms.items()}


@pytest.mark.thorough
def test_without_a_horizon_the_safe_set_is_that_of_h() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    plane = safe_set.planes(env)
    distance = np.linspace(0.0, 150.0, 4)
    speed = np.linspace(0.0, 0.6, 5)
    for start in plane.panels.values():
        best, h = safe_set.survey(env, start, distance, speed)
        np.testing.assert_array_equal(best, h)
        np.testing.assert_allclose(h, 0.2 + 2.0 * 0.001027 * distance - speed[:, None], atol=1e-6)


@pytest.mark.thorough
def test_head_on_the_filter_keeps_farther_away_than_the_constraint() -> None:
    env = jaxsafe.make("rejoin2d", rta="default")
    head_on, _, overtaking = safe_set.planes(env).panels.values()
    for start, saved in [(head_on, False), (overtaking, True)]:
        best, h = safe_set.survey(env, start, np.array([600.0]), np.array([0.0]))
        assert h == 500.0
        assert (best >= env.rta.margin) == saved


@pytest.mark.parametrize("task", ["docking2d", thorough("rejoin2d")])
def test_the_safe_set_has_a_panel_for_each_plane(task: str) -> None:
    env = jaxsafe.make(task, {"rta.margin": 0.0} if task == "docking2d" else None, rta="default")
    required = float(env.rta.required_margin(env))
    # A speed limit needs a larger margin, for the time between samples.
    assert (required > float(env.rta.margin)) == (task == "docking2d")
    plane = safe_set.planes(env)
    figure = safe_set.draw(env, task, y=None if task == "docking2d" else (-300.0, 300.0), points=13)
    panels = [panel for panel in figure.axes if panel.get_title()]
    assert [panel.get_title() for panel in panels] == list(plane.panels)
    assert {panel.get_xlabel() for panel in panels} == {plane.x_label}
    assert (panels[0].get_ylabel(), figure.axes[-1].get_ylabel()) == (
        ("speed [m/s]", "H [m/s]") if task == "docking2d" else ("to its left [ft]", "H [ft]")
    )
    lines = [
        constraint for constraint in panels[0].collections if isinstance(constraint, ContourSet)
    ]
    assert [line.levels[0] for line in lines] == pytest.approx([0.0, required])


@pytest.mark.thorough
def test_the_command_writes_a_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(command, "enable_compilation_cache", lambda: None)
    words = [
        "env=docking2d",
        "x=[0,50]",
        "y=[0,0.4]",
        "points=5",
        "env.rta.margin=0.05",
        f"out={tmp_path / 'here.png'}",
    ]
    assert command.main(words) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "here.png")
    assert imread(tmp_path / "here.png").shape[0] > 300


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["rta=default"], "env: missing"),
        (
            ["env=docking2d", "rta=none"],
            "rta: expected a filter that certifies states, for instance default, found none",
        ),
        (
            ["env=rejoin2d", "rta=released"],
            "rta: expected a filter that certifies .* found collision_simplex",
        ),
        (
            ["env=docking2d", "x=[5,1]"],
            r"x: expected the ends of the axis, for instance 0,150, found \[5, 1\]",
        ),
        (["env=docking2d", "y=3"], "y: expected the ends of the axis"),
        (["env=docking2d", "points=1"], "points: expected a whole number ≥ 2, found 1"),
        (["env=docking2d", "pionts=9"], "pionts: unknown option. Did you mean 'points'"),
    ],
)
def test_bad_options_are_told_in_one_line(
    words: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "enable_compilation_cache", lambda: None)
    with pytest.raises(ConfigError, match=message):
        command.main(words)


def test_a_cascade_has_no_certificate_of_its_own() -> None:
    inner = jaxsafe.make("docking2d", rta="default").rta
    env = jaxsafe.make("docking2d", rta=Cascade(stages=(Stage(name="only", rta=inner),)))
    with pytest.raises(
        ConfigError, match=r"rta: expected a filter that certifies states, .* found cascade"
    ):
        safe_set.draw(env, "title")
