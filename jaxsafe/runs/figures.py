"""Figures of a run, drawn from its own log files."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from matplotlib.figure import Figure

from jaxsafe.environment import Environment, length_unit
from jaxsafe.plot.curves import AXES, evaluation_rows, training_curves
from jaxsafe.plot.figures import Episodes, Rows, speed_distance, trajectories
from jaxsafe.plot.interventions import interventions, most_altered
from jaxsafe.plot.learning import learning_curves
from jaxsafe.plot.style import keep_away_distances, kept_out, save, to_bytes
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.storage.files import read_rows
from jaxsafe.storage.forms import (
    ANYTHING,
    COUNT,
    FLAG,
    NUMBER,
    NUMBER_OR_NULL,
    OTHERS,
    TEXT,
    check,
    numbers,
)
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.log import headline, read_progress
from jaxsafe.train.host.results import facts


class Figures(dict[str, Figure]):
    """Figures by name. A notebook shows them one below the other."""

    def __repr__(self) -> str:
        return f"Figures: {', '.join(self)}"

    def _repr_html_(self) -> str:
        images = (base64.b64encode(to_bytes(figure)).decode() for figure in self.values())
        return "<br>".join(f'<img src="data:image/png;base64,{image}">' for image in images)


def draw_all(
    run: Path,
    x: Literal["steps", "wall"] = "steps",
    form: str = "png",
    panels: Sequence[str] = (),
    width: float | None = None,
) -> list[Path]:
    """Draw every figure for which the run has data into `<run>/figures/`.

    Args:
        run: the run directory.
        x: the horizontal axis of training curves: steps, or wall time.
        form: the format of the figures: png, pdf or svg.
        panels: the columns of the progress log that the training curves show. If there are none,
            they show all.
        width: the width of each figure in inches.

    Returns:
        The paths of the figures.

    Raises:
        ConfigError: the run has no progress log, or the log has no values of a column of `panels`.
    """
    figures = draw(run, x, panels, width)
    directory = run / "figures"
    # If there are no figures yet, all of them appear at once or none does.
    new = directory if directory.exists() else directory.with_name("figures.part")
    # A command that was killed may have left this directory.
    shutil.rmtree(directory.with_name("figures.part"), ignore_errors=True)
    paths = [save(figure, new / f"{name}.{form}") for name, figure in figures.items()]
    if new != directory:
        new.rename(directory)
    return [directory / path.name for path in paths]


def draw(
    run: Path, x: str = "steps", panels: Sequence[str] = (), width: float | None = None
) -> Figures:
    """Return every figure for which the run has data, by name.

    Args:
        run: the run directory.
        x: the horizontal axis of training curves: `steps` or `wall`.
        panels: the columns of the progress log that the training curves show. If there are none,
            they show all.
        width: the width of each figure in inches.

    Raises:
        ConfigError: `x` is something else, or the run has no progress log, or the log has no values
            of a column of `panels`.
    """
    if x not in AXES:
        raise ConfigError(f"x: unknown axis {show(x)}{choices_text(x, AXES)}")
    rows = progress(run)
    config, env, name = run_directory.read(run, "run")
    seeds = len({row["seed"] for row in rows})
    title = headline({**facts(config, env, name), "seeds": seeds})
    curves = training_curves(
        rows, x, title, evaluations=evaluations(run, rows), panels=panels, width=width
    )
    figures = Figures({f"training_{x}": curves})
    learning = learning_curves(rows, x, title, width)
    if learning is not None:
        figures[f"learning_{x}"] = learning
    others = [platform.name for platform in env.platforms if platform.name != env.agent]
    names = [*others[:1], env.agent]
    episodes = _episodes(run / "episodes.jsonl", names, partial(_row_form, env, names))
    if episodes:
        figures["trajectories"] = trajectories(
            episodes,
            title,
            unit=length_unit(env),
            regions=env.regions,
            forbidden=kept_out(env),
            keep_away=keep_away_distances(env),
            width=width,
        )
        if {"docking_distance", "speed", "velocity_limit"} <= episodes[0][1][0]["status"].keys():
            figures["speed_distance"] = speed_distance(episodes, title, width)
        if "rta" in episodes[-1][1][0]:
            figures["interventions"] = interventions(most_altered(episodes), env, title, width)
    return figures


def progress(run: Path) -> list[dict[str, Any]]:
    """Return the rows of the progress log of a run.

    Raises:
        ConfigError: the log has no rows.
    """
    rows = read_progress(run)
    if not rows:
        raise ConfigError(f"run: {run} has no rows in progress.jsonl yet; nothing to draw")
    return rows


def evaluations(run: Path, progress: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the means of the evaluations during the training of a run.

    Args:
        run: the run directory.
        progress: the rows of its progress log.

    Raises:
        ConfigError: a row of the log of evaluations is broken.
    """
    form = {
        **dict.fromkeys(("step", "seed", "length"), COUNT),
        **dict.fromkeys(("final", "success"), FLAG),
        "return": NUMBER_OR_NULL,
    }
    log = read_rows(run / "eval.jsonl", form)
    optional = ("delta_v", "control_effort", "violating_steps", "interventions")
    logged = {name: NUMBER_OR_NULL for name in optional if any(name in row for row in log)}
    for number, row in enumerate(log, start=1):
        check(row, logged, f"{run / 'eval.jsonl'}, row {number}")
    return evaluation_rows(log, progress)


def _episodes(
    path: Path, names: Sequence[str], form: Callable[[Rows], Any] | None = None
) -> Episodes:
    """Return the logged episodes, each with the training step of its policy.

    If final episodes are logged at a step, other episodes at the same step are left out, so that
    the end of the training appears only once.

    Args:
        path: the path of the log.
        names: the names of the platforms to keep in the rows.
        form: a function of all rows that returns what each row must look like.

    Raises:
        ConfigError: a row lacks what the figures show, or has something else there.
    """
    grouped: dict[tuple[int, bool, int], Rows] = {}
    rows = read_rows(path)
    row_form = form(rows) if form else ANYTHING
    for number, row in enumerate(rows, start=1):
        check(row, row_form, f"{path}, row {number}")
        row["platforms"] = {name: row["platforms"][name] for name in names}
        grouped.setdefault((row["step"], row["final"], row["episode"]), []).append(row)
    ended = {step for step, final, _ in grouped if final}
    return [
        (step, rows) for (step, final, _), rows in grouped.items() if final or step not in ended
    ]


def _row_form(env: Environment, names: Sequence[str], rows: Rows) -> dict[str, Any]:
    """Return what a row of an episode log must look like.

    Older logs lack some fields. If one row has such a field, all rows must have it.

    Args:
        env: the environment of the run.
        names: the names of the platforms that are drawn. Only the first needs a heading.
        rows: all rows of the log.
    """
    sizes = {platform.name: platform.dimension for platform in env.platforms}
    position = {"position": numbers(max(sizes.values()))}
    headed = any(
        "heading" in vars(platform.shapes())
        for platform in env.platforms
        if platform.name == names[0]
    )
    form: dict[str, Any] = {
        "step": COUNT,
        "final": FLAG,
        "episode": COUNT,
        "platforms": {
            name: position | ({"heading": NUMBER_OR_NULL} if headed and name == names[0] else {})
            for name in names
        },
        "status": {},
    }
    keys = {key for row in rows for key in row}
    shown = {"docking_distance", "speed", "velocity_limit"}
    if any(
        isinstance(row.get("status"), Mapping) and shown <= row["status"].keys() for row in rows
    ):
        form["status"] = dict.fromkeys(sorted(shown), NUMBER_OR_NULL)
    if "regions" in keys:
        form["regions"] = {OTHERS: position}
    if "rta" in keys:
        actuators = dict.fromkeys(env.action_names, NUMBER_OR_NULL)
        form |= {
            "t": NUMBER,
            "control_desired": actuators,
            "control_actual": actuators,
            "margins": {constraint.name: NUMBER_OR_NULL for constraint in env.constraints},
            "rta": {"intervening": FLAG, "predicted_margin": NUMBER_OR_NULL},
            "outcome": TEXT,
        }
    return form
