"""The page of the baselines: tables, figures and curves from the result files of the runs.

The text of the page is in `page.md`. A place like `$efficiency` in it stands for the rows of a
table, or for a word or a list.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from baselines.measures import failed_seeds, finished, samples_per_second, steps_to, wall_to
from baselines.plan import CERTIFIED_STARTS, FILM, KINDS, SHIPPED, WITH_RTA, WITHOUT_RTA, best_seed
from baselines.record import Record
from jaxsafe.envs import TASKS
from jaxsafe.metrics import ENOUGH_EPISODES, stratified_iqm, with_interval
from jaxsafe.plot.compare import compare_curves, seed_curves
from jaxsafe.plot.style import save
from jaxsafe.storage.files import write_text
from jaxsafe.train.host.results import known, least
from jaxsafe.train.recent_episodes import SIZE as WINDOW

DIRECTORY = "baselines"
"""The directory beside the page that holds records, curves, figures and films."""

TEMPLATE = Path(__file__).with_name("page.md")

PICTURES = "## Pictures"
"""The section that has its text once for each task."""

Rows = list[list[str]]


class Report:
    """The records of all items, and the page that they make."""

    def __init__(self, records: Sequence[Record]) -> None:
        """Take at least one record."""
        self.records = sorted(records, key=lambda record: [*TASKS].index(record.item.task))
        self.own = [(record.item, record.results) for record in self.records]
        self.further = [
            (record, name, results)
            for record in self.records
            for name, results in record.evaluations.items()
        ]
        self.episodes = {
            record.item.name: record.options["training"]["episodes"] for record in records
        }
        self.kinds = [kind for kind in KINDS if any(record.item.kind == kind for record in records)]
        self.tasks = [task for task in TASKS if any(record.item.task == task for record in records)]

    def write(self, out: Path) -> Path:
        """Write `baselines.md`. Write figures of training into the directory of the records."""
        files = out / DIRECTORY
        for task in self.tasks:
            curves = {
                record.item.kind: record.curves
                for record in self.records
                if record.item.task == task
            }
            failed = {
                item.kind: failed_seeds(results) for item, results in self.own if item.task == task
            }
            steps = TASKS[task].paper_steps
            mark = None if steps is None else ("the paper's 80 %", steps)
            save(compare_curves(curves, task, mark=mark), files / f"{task}_training.png")
            save(seed_curves(curves, task, failed), files / f"{task}_seeds.png")
        page = out / "baselines.md"
        write_text(page, self.text(files))
        return page

    def text(self, files: Path) -> str:
        """Return the page as Markdown.

        A section without rows is left out, and so are figures that are not in `files`.
        """
        results = self.records[0].results
        words = {
            "origins": "\n".join(self._origins()),
            "kinds": "\n".join(f"- **{kind}**: {KINDS[kind].about}" for kind in self.kinds),
            "first_seed": str(results["seed"]),
            "last_seed": str(results["seed"] + results["seeds"] - 1),
            "episodes": f"{max(self.episodes.values()):,}",
            "enough": str(ENOUGH_EPISODES),
            "window": str(WINDOW),
            "curves": self._curves(files),
            "commands": "\n".join(self._commands()),
        }
        tables = {
            "efficiency": self._efficiency(),
            "wall": self._wall(),
            "final": self._final(),
            "docking": self._docking(),
            "safety": self._safety(),
            "rta": self._rta(),
            "starts": self._starts(),
            "best": self._best(),
            "together": self._together(),
        }
        rows = {name: _markdown(table) for name, table in tables.items()}
        sections = re.split(r"\n\n(?=## )", TEMPLATE.read_text(encoding="utf-8").rstrip())
        parts = []
        for section in sections:
            places = Template(section).get_identifiers()
            if any(not tables.get(place, True) for place in places):
                continue
            if section.startswith(PICTURES):
                parts.append(self._pictures(section, files, words))
            else:
                parts.append(Template(section).substitute(words | rows))
        return "\n\n".join(parts) + "\n"

    def _origins(self) -> list[str]:
        """Return a line for each command, commit and set of versions that made some records."""
        names: dict[tuple[str, str], list[str]] = {}
        for record in self.records:
            versions = dict(record.results["versions"])
            device = versions.pop("device")
            processor = versions.pop("processor", None)
            where = f" on commit {record.commit}" if record.commit else ""
            made_by = ", ".join(f"{name} {version}" for name, version in versions.items())
            made_by += f"; {device}{f' ({processor})' if processor else ''}, float32"
            names.setdefault((f"`{record.command}`{where}", made_by), []).append(record.item.name)
        return [
            f"- {origin}: {', '.join(items)} ({versions})"
            for (origin, versions), items in names.items()
        ]

    def _efficiency(self) -> Rows:
        rows = []
        for record in self.records:
            item = record.item
            results = record.results
            efficiency = results["interaction_efficiency"]
            steps = efficiency["timesteps"]
            per_seed = efficiency["per_seed"]
            paper = TASKS[item.task].paper_steps
            strict = steps_to(0.8, record.curves, WINDOW)
            rows.append(
                [
                    item.task,
                    item.kind,
                    f"{paper:,}",
                    f"{steps:,}" if steps else "never",
                    f"{paper / steps:.1f}" if steps else "–",
                    f"{finished(record.curves, steps):,.0f}" if steps else "–",
                    f"{strict:,}" if strict else "never",
                    f"{sum(reached is not None for reached in per_seed)} of {len(per_seed)}",
                    f"{results['steps']:,}",
                    f"{results['wall_s']:.0f}",
                    f"{results['compile_s']:.0f}",
                ]
            )
        return rows

    def _wall(self) -> Rows:
        rows = []
        for record in self.records:
            if record.item.kind in ("shortest_time", "many_envs"):
                reached = wall_to(0.95, record.curves)
                pace = samples_per_second(record.curves)
                results = record.results
                rows.append(
                    [
                        record.item.task,
                        record.item.kind,
                        f"{results['steps']:,}",
                        f"{reached:.1f}" if reached is not None else "never",
                        f"{results['wall_s']:.1f}",
                        f"{results['compile_s']:.1f}",
                        f"{pace:,.0f}" if pace is not None else "unknown",
                    ]
                )
        return rows

    def _final(self) -> Rows:
        rows = []
        for item, results in self.own:
            evaluation = results["evaluation"]
            rates = [evaluation[way]["success_rate"] for way in ("stochastic", "deterministic")]
            rows.append(
                [
                    item.task,
                    item.kind,
                    *(_percent(rate) for rate in rates),
                    _share(least(rates), 1),
                    ", ".join(map(str, failed_seeds(results))) or "none",
                    *(
                        _number(evaluation["deterministic"][name])
                        for name in ("average_return", "episode_length")
                    ),
                ]
            )
        return rows

    def _docking(self) -> Rows:
        return [
            [
                item.task,
                item.kind,
                way,
                _percent(metrics["episode_safety_violation_rate"]),
                _number(metrics["control_usage_l1"]),
                _number(metrics["control_usage"]),
                _number(metrics["episode_length"]),
            ]
            for item, results in self.own
            if item.task.startswith("docking")
            for way, metrics in results["evaluation"].items()
        ]

    def _safety(self) -> Rows:
        rows = []
        for item, results in self.own:
            cost = results["training_cost"]
            starts = self.episodes[item.name]
            for way, metrics in results["evaluation"].items():
                rows.append(
                    [
                        item.task,
                        item.kind,
                        way,
                        _rate(metrics["safety_violation_rate"], starts, results["seeds"]),
                        _percent(metrics["episode_safety_violation_rate"]),
                        *(
                            _share(metrics[f"episode_violation_severity_{name}"]["mean"], 1)
                            for name in ("mean", "max")
                        ),
                        _number(cost, 0) if way == "stochastic" else "",
                    ]
                )
        return rows

    def _rta(self) -> Rows:
        rows = []
        for record, name, further in self.further:
            if name not in (WITH_RTA, WITHOUT_RTA):
                continue
            flown = ("without", "with") if name == WITH_RTA else ("with", "without")
            item = record.item
            own = record.results
            trained = "with, no punishment" if item.kind == "rta_no_punishment" else flown[0]
            narrowed = any(word in item.words for word in CERTIFIED_STARTS.get(item.task, ()))
            starts = "narrowed" if narrowed else "the task's"
            for label, results in zip(flown, (own, further), strict=True):
                metrics = results["evaluation"]["stochastic"]
                rows.append(
                    [
                        item.task,
                        trained,
                        label,
                        starts,
                        _percent(metrics["success_rate"]),
                        _rate(
                            metrics["safety_violation_rate"],
                            self.episodes[item.name],
                            results["seeds"],
                        ),
                        _percent(metrics["intervention_rate"]),
                        _number(own["training_cost"], 0) if results is own else "",
                    ]
                )
        return rows

    def _starts(self) -> Rows:
        rows = []
        for record, name, results in self.further:
            if name in (WITH_RTA, WITHOUT_RTA, SHIPPED):
                continue
            evaluation = results["evaluation"]
            metrics = evaluation["deterministic"]
            rows.append(
                [
                    record.item.task,
                    name,
                    *(_percent(evaluation[way]["success_rate"]) for way in evaluation),
                    _percent(metrics["safety_violation_rate"]),
                    _percent(metrics["episode_safety_violation_rate"]),
                    _share(metrics["episode_violation_severity_max"]["mean"], 1),
                    _number(metrics["average_return"]),
                    _number(metrics["control_usage_l1"]),
                    _number(metrics["episode_length"], 1),
                ]
            )
        return rows

    def _best(self) -> Rows:
        rows = []
        for record, name, results in self.further:
            if name != SHIPPED:
                continue
            drawn = results["evaluation"]["stochastic"]
            mode = results["evaluation"]["deterministic"]
            docks = record.item.task.startswith("docking")
            rows.append(
                [
                    record.item.task,
                    str(best_seed(record.results)),
                    *(_share(metrics["success_rate"]["mean"]) for metrics in (drawn, mode)),
                    _share(mode["episode_safety_violation_rate"]["mean"]),
                    known(mode["control_usage_l1"]["mean"], ".2f") if docks else "–",
                    *(
                        known(mode[metric]["mean"], ".1f")
                        for metric in ("average_return", "episode_length")
                    ),
                ]
            )
        return rows

    def _together(self) -> Rows:
        rows = []
        for kind in self.kinds:
            for way in ("stochastic", "deterministic"):
                scores = [
                    results["evaluation"][way]["success_rate"]["per_seed"]
                    for item, results in self.own
                    if item.kind == kind
                ]
                score = stratified_iqm(scores)
                rows.append([kind, way, _percent({"mean": score["iqm"], "ci95": score["ci95"]})])
        return rows

    def _pictures(self, section: str, files: Path, words: Mapping[str, str]) -> str:
        """Return the section of pictures. A task has those pictures that are in `files`."""
        title, *paragraphs = section.split("\n\n")
        lines = [title]
        for task in self.tasks:
            shown = True
            for paragraph in paragraphs:
                text = Template(paragraph).substitute(words, task=task, files=files.name)
                picture = re.fullmatch(r"!\[.*\]\((.*)\)", text)
                # A caption follows its picture, and both are there or neither is.
                if picture:
                    shown = (files.parent / picture[1]).exists()
                if shown:
                    lines.append(text)
        return "\n\n".join(lines)

    def _curves(self, files: Path) -> str:
        return ", ".join(f"[{item.name}]({files.name}/{item.name}.csv)" for item, _ in self.own)

    def _commands(self) -> list[str]:
        """Return the commands behind the tables, as a user would type them."""
        lines = []
        for item, results in self.own:
            run = Path("runs", item.name)
            lines.append(f"python -m jaxsafe.train {shlex.join(item.words)} out={run}")
            count = self.episodes[item.name]
            for name, options in item.evaluations.items():
                best = run / "policy" / f"seed_{best_seed(results)}.npz"
                command = f"python -m jaxsafe.evaluate run={best if name == SHIPPED else run}"
                lines.append(f"{command} episodes={count} {shlex.join(options)}")
                if name == SHIPPED:
                    lines.append(f"{command} {shlex.join(FILM)}")
        return lines


def _markdown(rows: Rows) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _share(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f} %"


def _percent(metric: Mapping[str, Any]) -> str:
    if metric["mean"] is None:
        return "–"
    interval = metric["ci95"] and [100.0 * bound for bound in metric["ci95"]]
    return f"{with_interval(100.0 * metric['mean'], interval, '.2f')} %"


def _number(metric: Mapping[str, Any], digits: int = 2) -> str:
    if metric["mean"] is None:
        return "–"
    return with_interval(metric["mean"], metric["ci95"], f",.{digits}f")


def _rate(metric: Mapping[str, Any], starts: int, seeds: int) -> str:
    """Return a share of episodes. A zero has the bound that it proves.

    The bound is one of starts, because all seeds have the same.
    """
    return (
        _percent(metric)
        if metric["mean"] != 0
        else f"0 of {starts * seeds:,} (< {300 / starts:.2g} %)"
    )
