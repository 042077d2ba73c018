"""What is known of each item: files beside the page, so that a report can be made in parts and at different times."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxsafe.config import yaml
from jaxsafe.report.plan import Item
from jaxsafe.report.run import FILM_FILE, answers, options_of
from jaxsafe.train.files import finite, read_json, read_rows, write_csv, write_json

CURVES = ("wall_s", "success_rate", "return", "length", "delta_v", "violating_share", "cost", "episodes")

Results = dict[str, Any]


class Record(NamedTuple):
    """An item that was carried out."""

    item: Item
    command: str  # of the report that carried it out
    commit: str | None  # of the checkout that it was trained in
    options: dict[str, Any]  # every one
    results: Results
    evaluations: dict[str, Results]  # the further ones, by name
    curves: list[dict[str, Any]]  # rows of the progress log


def keep(item: Item, run: Path, files: Path, command: str) -> None:
    """Write what the page needs of a run, its pictures too, into the directory beside the page."""
    for figure in ("trajectories", "speed_distance") if item.kind == "features" else ():
        if (run / "figures" / f"{figure}.png").exists():
            _copy(run / "figures" / f"{figure}.png", files / f"{item.task}_{figure}.png")
    if (run / "film" / FILM_FILE).exists():
        _copy(run / "film" / FILM_FILE, files / f"{item.task}.gif")
    rows = read_rows(run / "progress.jsonl")
    write_csv(files / f"{item.name}.csv", [{name: row.get(name) for name in ("seed", "step", *CURVES)} for row in rows])
    evaluations = {name: item.evaluation_directory(run, name) / "results.json" for name in item.evaluations}
    record = {
        "command": command,
        "commit": yaml.read(run / "config.yaml").get("commit"),
        "words": item.words,
        "options": options_of(item),
        "results": read_json(run / "results.json"),
        "evaluations": {name: read_json(path) for name, path in evaluations.items()},
    }
    write_json(files / f"{item.name}.json", record)


def kept(items: Iterable[Item], files: Path) -> tuple[list[Record], list[str]]:
    """The records there are of these items, and a line for each that is of other options than the item has today."""
    records, old = [], []
    for item in items:
        path = files / f"{item.name}.json"
        if not path.exists():
            continue
        found = read_json(path)
        if found["options"] != json.loads(json.dumps(finite(options_of(item)))):
            old.append(f"{path}: was made with other options and is left out; report it again")
            continue
        with open(path.with_suffix(".csv"), encoding="utf-8", newline="") as file:
            curves = [_numbers(row) for row in csv.DictReader(file)]
        values = {name: found[name] for name in ("command", "commit", "options", "results")}
        evaluations = found["evaluations"]
        current = {name: one for name, one in evaluations.items() if answers(item.evaluations.get(name, []), one)}
        old += [
            f"{path}: its evaluation {name!r} was made with other options and is left out; report it again"
            for name in evaluations.keys() - current.keys()
        ]
        records.append(Record(item=item, curves=curves, evaluations=current, **values))
    return records, old


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, target)


def _numbers(row: Mapping[str, str]) -> dict[str, Any]:
    return {name: float(text) if text else None for name, text in row.items()} | {
        name: int(row[name]) for name in ("seed", "step")
    }
