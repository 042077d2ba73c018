"""The files and the table of a sweep."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsafe.config.arguments import Arguments
from jaxsafe.evaluate.evaluator import EVALUATION_KINDS
from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.storage.files import append_rows, keep_rows, write_csv, write_json, write_text
from jaxsafe.storage.forms import COUNT, NULL, OTHERS, SHARE, TEXT, Kind, check, numbers
from jaxsafe.storage.provenance import versions
from jaxsafe.storage.text_table import columns
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.results import percent, told_diverged
from jaxsafe.tune.settings import Setting

Rows = dict[int, dict[str, Any]]
"""The results of settings, by the index of the setting in the sweep."""

MAX_ROWS = 20
"""The largest number of settings in the printed table."""

NO_VALUE = {"80 % after": "never"}
"""What a column of the table shows if there is no value. Other columns show a dash."""

MAX_LABEL = 36
"""The largest number of characters of a setting's values in the legend of the figure.

If they are longer, the legend has only the number of the setting.
"""


def create(out: str | None, request: Mapping[str, Any], first: Setting) -> Path:
    """Make the directory of a sweep, and write `sweep.yaml`.

    The file holds what was asked for, the first setting in full, and versions.

    Args:
        out: the directory. None makes one under `runs`.
        request: the options that the user gave.
        first: the first setting of the sweep.

    Returns:
        The directory.
    """
    source = request["env"] if "env" in request else request["like"]
    path = run_directory.make(out, Path("runs"), f"tune_{Path(str(source)).stem}")
    whole = run_directory.described(first.config, first.env)
    write_text(
        path / "sweep.yaml",
        yaml12.write({"request": dict(request), "first": whole, "versions": versions()}),
    )
    return path


def read_request(path: Path) -> Arguments:
    """Return the options with which a sweep was begun.

    Args:
        path: the directory of the sweep.

    Raises:
        ConfigError: there is no sweep in this directory.
    """
    if not (path / "sweep.yaml").is_file():
        raise ConfigError(f"resume: no sweep in {str(path)!r} (a directory with sweep.yaml)")
    request = _content(path)["request"]
    for name in request:
        check(name, TEXT, f"{path / 'sweep.yaml'}: request")
    return Arguments(dict(request))


def refuse_other(path: Path, first: Setting) -> None:
    """Refuse to resume a sweep if its recipe or environment has changed.

    Results of another recipe or environment must not stand in one table with those there are.

    Args:
        path: the directory of the sweep.
        first: the first setting, as it is now.

    Raises:
        ConfigError: the recipe or the environment has changed since the sweep was begun.
    """
    now = yaml12.write(run_directory.described(first.config, first.env))
    if _content(path)["first"] != yaml12.parse(now, "first"):
        raise ConfigError(
            f"resume: the recipe or the environment of {path} has changed since it was begun;"
            " start it again from the beginning"
        )


def _content(path: Path) -> dict[str, Any]:
    content = yaml12.read(path / "sweep.yaml")
    check(content, {"request": {}, "first": {}}, str(path / "sweep.yaml"))
    return content


def read(path: Path, settings: Sequence[Setting]) -> Rows:
    """Return the results so far. A last line that was cut short by a kill is removed from the file.

    Args:
        path: the directory of the sweep.
        settings: the settings of the sweep.

    Raises:
        ConfigError: a line is broken, or does not belong to one of these settings.
    """
    file = path / "settings.jsonl"
    rows: Rows = {}
    for number, row in enumerate(keep_rows(file, lambda _: True, {"setting": COUNT}), start=1):
        index = row.pop("setting")
        place = f"{file}, row {number}"
        if index >= len(settings) or index in rows:
            raise ConfigError(
                f"{place}: setting: expected one of the {len(settings)} settings, each once,"
                f" found {index}"
            )
        check(row, _form(settings[index]), place)
        check(
            row.get("diverged", []), [{"seed": COUNT, "step": COUNT | NULL}], f"{place}: diverged"
        )
        check(
            row.get("given_up", {"after_steps": 0}),
            {"after_steps": COUNT, OTHERS: COUNT},
            f"{place}: given_up",
        )
        for name, value in settings[index].changes.items():
            if row.get(name) != json.loads(json.dumps(value)):
                raise ConfigError(
                    f"{place}: {name}: expected {show(value)} in setting {index},"
                    f" found {show(row.get(name))}"
                )
        rows[index] = row
    return rows


def _form(setting: Setting) -> dict[str, Any]:
    """Return the form that the results of a setting must have, as far as they are read."""
    seeds, updates = setting.config.seeds, setting.config.num_updates
    rate, curve = numbers(seeds, SHARE | NULL), numbers(updates, SHARE | NULL)
    metrics = {
        "success_rate": rate,
        "episode_safety_violation_rate": rate,
        "episode_length": numbers(seeds),
    }
    return {
        "interaction_efficiency": {
            "timesteps": COUNT | NULL,
            "per_seed": numbers(seeds, COUNT | NULL),
        },
        "training_success": rate,
        "evaluation": dict.fromkeys(EVALUATION_KINDS, metrics),
        "curve": {
            "steps": numbers(updates, COUNT),
            "success_rate": Kind(
                f"{seeds} lists of length {updates}, each a share",
                lambda value: (
                    isinstance(value, list) and len(value) == seeds and all(map(curve.fits, value))
                ),
            ),
        },
    }


def add(path: Path, rows: Mapping[int, dict[str, Any]]) -> None:
    """Append results to the file of the sweep, so that a killed sweep can go on after them.

    Args:
        path: the directory of the sweep.
        rows: the results, by the index of the setting.
    """
    append_rows(path / "settings.jsonl", ({"setting": index, **row} for index, row in rows.items()))


def finish(path: Path, rows: Rows, swept: Sequence[str], rank: str) -> str:
    """Write `results.json`, `results.csv` and the figure of a sweep.

    Args:
        path: the directory of the sweep.
        rows: the results of all settings.
        swept: names of the options that the sweep varies.
        rank: what the settings are ranked by: `steps`, `success` or `deterministic`.

    Returns:
        The table to print, with the best setting first.
    """
    from jaxsafe.plot.sweep import sweep_curves

    order = sorted(rows, key=lambda index: (_key(rows[index], rank), index))
    flat = [{"setting": index, **_flat(rows[index], swept)} for index in order]
    # A setting with a seed that has diverged has more columns than others.
    names = dict.fromkeys(name for cells in flat for name in cells)
    flat = [{name: cells.get(name) for name in names} for cells in flat]
    write_json(
        path / "results.json",
        {"rank": rank, "settings": [{"setting": i, **rows[i]} for i in order]},
    )
    write_csv(path / "results.csv", flat)
    figure = sweep_curves(path, [(_label(i, rows[i], swept), rows[i]["curve"]) for i in order])
    lines = _table(flat[:MAX_ROWS])
    if len(flat) > MAX_ROWS:
        lines.append(f"… and {len(flat) - MAX_ROWS} more")
    lines += [
        f"setting {index}: {_given_up(rows[index])}" for index in order if "given_up" in rows[index]
    ]
    lines += [f"setting {index}: {text}" for index in order for text in told_diverged(rows[index])]
    return "\n".join([*lines, f"results in {path / 'results.csv'}, figure {figure}"])


def line(index: int, row: dict[str, Any], swept: Sequence[str]) -> str:
    """Return a line that sums up a setting that is finished.

    Args:
        index: the index of the setting.
        row: the results of the setting.
        swept: names of the options that the sweep varies.
    """
    facts = _flat(row, swept)
    values = ", ".join(f"{name} {facts[name]}" for name in swept)
    reached = _cell(facts["80 % after"], NO_VALUE["80 % after"])
    after = f"80 % after {reached}, then {percent(facts['stochastic'], 1)}"
    return f"setting {index}: {values}: {'; '.join([after, *told_diverged(row)])}"


def _given_up(row: dict[str, Any]) -> str:
    """Return a text about the evaluation episodes of a setting that had not ended."""
    counts = dict(row["given_up"])
    steps = counts.pop("after_steps")
    return (
        f"{sum(counts.values()):,} episodes still running after {steps:,} steps,"
        " given up and counted as failures"
    )


def _key(row: dict[str, Any], rank: str) -> tuple[float, ...]:
    """Return the key by which settings are sorted. Small is good.

    Settings come in the order of the number of their seeds that diverged. Among equals the chosen
    quantity decides, and then the other quantities.

    Args:
        row: the results of the setting.
        rank: the chosen quantity: `steps`, `success` or `deterministic`.
    """
    steps = row["interaction_efficiency"]["timesteps"] or float("inf")
    stochastic, deterministic = (
        -(_mean(row, kind, "success_rate") or 0.0) for kind in EVALUATION_KINDS
    )
    area = -float(np.mean(np.nan_to_num(np.array(row["curve"]["success_rate"], float))))
    quantities = {
        "steps": (steps, area, stochastic),
        "success": (stochastic, deterministic, steps),
        "deterministic": (deterministic, stochastic, steps),
    }
    return len(row.get("diverged", ())), *quantities[rank]


def _flat(row: dict[str, Any], swept: Sequence[str]) -> dict[str, Any]:
    """Return the cells of a setting in the table, by column."""
    reached = row["interaction_efficiency"]["per_seed"]
    rates = _known(row, "stochastic", "success_rate")
    return {
        **{
            name: json.dumps(row[name]) if isinstance(row[name], (list, dict)) else row[name]
            for name in swept
        },
        "80 % after": row["interaction_efficiency"]["timesteps"],
        "seeds at 80 %": f"{sum(step is not None for step in reached)}/{len(reached)}",
        "training": round(
            float(np.mean(np.nan_to_num(np.array(row["training_success"], float)))), 4
        ),
        "stochastic": _mean(row, "stochastic", "success_rate", 4),
        "worst": round(min(rates), 4) if rates else None,
        "deterministic": _mean(row, "deterministic", "success_rate", 4),
        "length": _mean(row, "deterministic", "episode_length", 1),
        # Without safety constraints there is no such rate.
        **(
            {"violating": _mean(row, "deterministic", "episode_safety_violation_rate", 5)}
            if _known(row, "deterministic", "episode_safety_violation_rate")
            else {}
        ),
        **({"diverged": len(row["diverged"])} if "diverged" in row else {}),
    }


def _mean(row: dict[str, Any], kind: str, metric: str, digits: int | None = None) -> float | None:
    """Return the average of a metric over the seeds that have it, or None if none has.

    Args:
        row: the results of the setting.
        kind: the kind of evaluation, `stochastic` or `deterministic`.
        metric: the name of the metric.
        digits: number of decimals to which the average is rounded. None does not round.
    """
    values = _known(row, kind, metric)
    mean = float(np.mean(values)) if values else None
    return mean if mean is None or digits is None else round(mean, digits)


def _known(row: dict[str, Any], kind: str, metric: str) -> list[float]:
    return [value for value in row["evaluation"][kind][metric] if value is not None]


def _label(index: int, row: dict[str, Any], swept: Sequence[str]) -> str:
    """Return the entry of a setting in the legend: its number, and its values where they fit."""
    values = ", ".join(f"{'.'.join(name.split('.')[-2:])} {row[name]}" for name in swept)
    return f"{index}: {values}" if len(values) <= MAX_LABEL else f"setting {index}"


def _table(rows: Sequence[dict[str, Any]]) -> list[str]:
    cells = ([_cell(value, NO_VALUE.get(name, "–")) for name, value in row.items()] for row in rows)
    return columns([[*rows[0]], *cells])


def _cell(value: Any, none: str) -> str:
    return none if value is None else f"{value:,}" if isinstance(value, int) else str(value)
