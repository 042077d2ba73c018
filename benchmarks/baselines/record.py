"""Records of the items, which are files beside the first page.

Because of the records, a report can be made in parts and at different times.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from baselines.plan import Item
from baselines.run import FILM_FILE, answers, options_of, same_options
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import read_csv, read_json, write_bytes, write_csv, write_json
from jaxsafe.storage.forms import NULL, NUMBER_OR_NULL, OTHERS, TEXT, check
from jaxsafe.train.host.log import NEEDS, check_order, read_progress
from jaxsafe.train.host.results import check_results, read_results
from jaxsafe.train.host.run_config import read_content

CURVES = (
    "wall_s",
    "success_rate",
    "return",
    "length",
    "delta_v",
    "violating_share",
    "cost",
    "episodes",
)

Results = dict[str, Any]


class Record(NamedTuple):
    """An item that was carried out, with its results."""

    item: Item
    command: str  # the command of the report that carried it out
    commit: str | None  # the commit of the checkout that it was trained in
    options: dict[str, Any]  # every option of the training and the environment
    results: Results
    evaluations: dict[str, Results]  # the results of further evaluations, by name
    curves: list[dict[str, Any]]  # rows of the progress log


def keep(item: Item, run: Path, files: Path, command: str) -> None:
    """Write what the pages need of a run, with its pictures, into the directory beside them."""
    for figure in ("trajectories", "speed_distance") if item.kind == "engineered_features" else ():
        if (run / "figures" / f"{figure}.png").exists():
            _copy(run / "figures" / f"{figure}.png", files / f"{item.task}_{figure}.png")
    if (run / "film" / FILM_FILE).exists():
        _copy(run / "film" / FILM_FILE, files / f"{item.task}.gif")
    rows = read_progress(run)
    write_csv(
        files / f"{item.name}.csv",
        [{name: row.get(name) for name in ("seed", "step", *CURVES)} for row in rows],
    )
    evaluations = {
        name: item.evaluation_directory(run, name) / "results.json" for name in item.evaluations
    }
    record = {
        "command": command,
        "commit": read_content(run).get("commit"),
        "words": item.words,
        "options": options_of(item),
        "results": read_results(run / "results.json"),
        "evaluations": {name: read_json(path) for name, path in evaluations.items()},
    }
    write_json(files / f"{item.name}.json", record)


def kept(items: Iterable[Item], files: Path) -> tuple[list[Record], list[str]]:
    """Load the records of these items. Some are left out, with a warning for each.

    A record is left out if it was made with other options or is broken.
    """
    records = []
    left_out = []
    for item in items:
        path = files / f"{item.name}.json"
        if not path.exists():
            continue
        try:
            content = read_json(path, {"options": {}})
            if not same_options(item, content["options"], f"{path}: options."):
                left_out.append(
                    f"{path}: was made with other options and is left out; report it again"
                )
                continue
            record = _record(item, content, path)
        except ConfigError as error:
            left_out.append(f"{error}; it is left out, report it again")
            continue
        left_out += [
            (
                f"{path}: its evaluation {name!r} was made with other options and is left out;"
                " report it again"
            )
            for name in content["evaluations"].keys() - record.evaluations.keys()
        ]
        records.append(record)
    return records, left_out


def _record(item: Item, content: dict[str, Any], path: Path) -> Record:
    """Return the record of an item, with the evaluations that have today's options.

    Raises:
        ConfigError: something that the pages need is missing or has another form.
    """
    form = {"command": TEXT, "commit": TEXT | NULL, "evaluations": {OTHERS: {}}}
    check(content, form, str(path))
    check_results(content.get("results"), f"{path}: results", training=True)
    for name, results in content["evaluations"].items():
        check_results(results, f"{path}: evaluations.{name}", training=False)
    table = path.with_suffix(".csv")
    curves = read_csv(table, {**dict.fromkeys(CURVES, NUMBER_OR_NULL), **NEEDS})
    check_order(curves, table)
    if not curves:
        raise ConfigError(f"{table}: expected a row for every update, found none")
    values = {name: content[name] for name in ("command", "commit", "options", "results")}
    current = {
        name: results
        for name, results in content["evaluations"].items()
        if answers(item.evaluations.get(name, []), results)
    }
    return Record(item=item, curves=curves, evaluations=current, **values)


def _copy(source: Path, target: Path) -> None:
    write_bytes(target, source.read_bytes())
