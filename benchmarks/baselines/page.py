"""The pages of the baselines: tables, figures and curves from the result files of the runs.

The text of the pages is in `pages/`. A name like `$efficiency` in it stands for the rows of a
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
from baselines.plan import (
    CERTIFIED_STARTS,
    FILM,
    KINDS,
    SHIPPED,
    WITH_RTA,
    WITHOUT_RTA,
    Item,
    best_seed,
)
from baselines.record import Record
from jaxsafe.envs import TASKS
from jaxsafe.evaluate.evaluator import EVALUATION_KINDS
from jaxsafe.metrics import ENOUGH_EPISODES, stratified_iqm
from jaxsafe.plot.compare import compare_curves, seed_curves
from jaxsafe.plot.style import save
from jaxsafe.storage.files import read_json, write_text
from jaxsafe.storage.text_table import or_dash
from jaxsafe.train.host.results import least, mean_text
from jaxsafe.train.recent_episodes import SIZE as WINDOW

DIRECTORY = "baselines"
"""The directory beside the first page that holds records, curves, figures and films."""

TEMPLATES = Path(__file__).with_name("pages")

CONTROLLERS = Path(__file__).parents[1] / "results" / "controllers.json"
"""The results of `python benchmarks/controllers.py`."""

FIRST = "baselines.md"
"""The page that leads to all others."""

QUESTIONS = {
    "results/learning.md": "How many steps does it take to learn?",
    "results/quality.md": "How well do the policies fly, and how does it look?",
    "results/safety.md": "How often are constraints violated, with and without a filter?",
    "results/starts.md": "What happens from farther away than in training?",
    "results/wall_time.md": "How many seconds does it take?",
    "results/provenance.md": "Which commands, commits and seeds are behind the numbers?",
}
"""The question that each other page answers."""

NEEDS = {"results/starts.md": "starts"}
"""The table that a page needs. If the table has no rows, there is no such page."""

Rows = list[list[str]]


class Report:
    """The records of all items, and the pages that are made from them."""

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
        self.controllers = read_json(CONTROLLERS)
        self.kinds = [kind for kind in KINDS if any(record.item.kind == kind for record in records)]
        self.tasks = [task for task in TASKS if any(record.item.task == task for record in records)]

    def write(self, out: Path) -> Path:
        """Write the pages, and the figures of training into the directory of the records.

        Return the path of the first page.
        """
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
        for name, text in self.pages(files).items():
            write_text(out / name, text)
        return out / FIRST

    def pages(self, files: Path) -> dict[str, str]:
        """Return the pages as Markdown, by their paths beside the directory of the records.

        A section whose table has no rows is left out, and so are pictures that are not in `files`.
        """
        tables = {
            "summary": self._summary(),
            "controllers": self._controllers(),
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
        names = [name for name in QUESTIONS if tables.get(NEEDS.get(name, ""), True)]
        results = self.records[0].results
        words = {
            "origins": "\n".join(self._origins()),
            "kinds": "\n".join(f"- **{kind}**: {KINDS[kind].about}" for kind in self.kinds),
            "seeds": str(results["seeds"]),
            "first_seed": str(results["seed"]),
            "last_seed": str(results["seed"] + results["seeds"] - 1),
            "episodes": f"{max(self.episodes.values()):,}",
            "enough": str(ENOUGH_EPISODES),
            "window": str(WINDOW),
            "questions": "\n".join(
                f"| {QUESTIONS[name]} | [{_title(name)}]({name}) |" for name in names
            ),
            "toctree": "\n".join(name.removesuffix(".md") for name in names),
            "commands": "\n".join(self._commands()),
        }
        return {name: self._page(name, files, words, tables) for name in (FIRST, *names)}

    def _page(
        self, name: str, files: Path, words: Mapping[str, str], tables: Mapping[str, Rows]
    ) -> str:
        up = "../" * name.count("/")
        own = {"files": f"{up}{files.name}", "curves": self._curves(f"{up}{files.name}")}
        rows = {place: _markdown(table) for place, table in tables.items()}
        parts = []
        for section in re.split(r"\n\n(?=## )", _template(name)):
            places = Template(section).get_identifiers()
            if any(not tables.get(place, True) for place in places):
                continue
            if "task" in places:
                parts.append(self._pictures(section, files, {**words, **own}))
            else:
                parts.append(Template(section).substitute({**words, **own, **rows}))
        return "\n\n".join(parts) + "\n"

    def _origins(self) -> list[str]:
        """Return a line for each command, commit and set of versions, with the items it made."""
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

    def _summary(self) -> Rows:
        """Return the rows of the first table: one for each task, without and with a filter."""
        rows = []
        for task in self.tasks:
            by_kind = {item.kind: results for item, results in self.own if item.task == task}
            if "engineered_features" not in by_kind:
                continue
            pair = [by_kind["engineered_features"], by_kind.get("rta")]
            paper = TASKS[task].paper_steps
            columns = [_learnt, _succeeded, _violating_in_training, _violating]
            cells = [column(results) if results else "–" for column in columns for results in pair]
            rows.append([task, f"{paper:,}" if paper else "–", *cells])
        return rows

    def _of_task(self, task: str) -> list[tuple[Item, Mapping[str, Any]]]:
        """Return the items of a task with their results."""
        return [(item, results) for item, results in self.own if item.task == task]

    def _of_controllers(self, task: str) -> list[Mapping[str, Any]]:
        """Return the results of the classical controllers of a task, which fly without a filter."""
        return [
            row
            for row in self.controllers["rows"]
            if (row["task"], row["rta"]) == (task, "none") and row["policy"] != "ppo"
        ]

    def _bound(self, item: Item) -> Mapping[str, float]:
        """Return what is possible from the starts of an item's evaluation, or nothing.

        It is known for the environments of the report, and for some numbers of episodes.
        """
        changes = [word for word in item.words if word.startswith(("env.", "variant="))]
        bounds = self.controllers["report_bounds"].get(" ".join([item.task, *changes]), {})
        return bounds.get(str(self.episodes[item.name]), {})

    def _controllers(self) -> Rows:
        """Return a row for each classical controller of the tasks."""
        rows = []
        for task in self.tasks:
            bound = self.controllers["bounds"][task]
            for row in self._of_controllers(task):
                rates = [row[name] for name in ("success_rate", "episode_safety_violation_rate")]
                flown = [task, f"`{row['policy']}`", *(f"{100 * rate:.2f}" for rate in rates)]
                for name, form in (
                    ("average_return", ".2f"),
                    ("episode_length", ".0f"),
                    ("control_usage", ".2f"),
                ):
                    flown += [or_dash(row[name], form), _gap(name, row[name], bound)]
                rows.append(flown)
        return rows

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
                    f"{sum(reached is not None for reached in per_seed)}/{len(per_seed)}",
                    f"{results['steps']:,}",
                ]
            )
        return rows

    def _wall(self) -> Rows:
        rows = []
        for record in self.records:
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
        for task in self.tasks:
            for item, results in self._of_task(task):
                evaluation = results["evaluation"]
                rates = [evaluation[way]["success_rate"] for way in EVALUATION_KINDS]
                flown = [
                    task,
                    item.kind,
                    *(_percent(rate) for rate in rates),
                    _share(least(rates), 1),
                    ", ".join(map(str, failed_seeds(results))) or "none",
                ]
                for name in ("average_return", "episode_length"):
                    metric = evaluation["deterministic"][name]
                    flown += [_number(metric), _gap(name, metric["mean"], self._bound(item))]
                rows.append(flown)
            for row in self._of_controllers(task):
                flown = [task, f"`{row['policy']}`", "–", _share(row["success_rate"]), "–", "–"]
                for name in ("average_return", "episode_length"):
                    gap = _gap(name, row[name], self.controllers["bounds"][task])
                    flown += [f"{row[name]:.2f}", gap]
                rows.append(flown)
        return rows

    def _docking(self) -> Rows:
        rows = []
        for task in [task for task in self.tasks if task.startswith("docking")]:
            for item, results in self._of_task(task):
                for way, metrics in results["evaluation"].items():
                    usage = metrics["control_usage"]
                    rows.append(
                        [
                            task,
                            item.kind,
                            way,
                            _percent(metrics["episode_safety_violation_rate"]),
                            _number(metrics["control_usage_l1"]),
                            _number(usage),
                            _gap("control_usage", usage["mean"], self._bound(item)),
                            _number(metrics["episode_length"]),
                        ]
                    )
            for row in self._of_controllers(task):
                usage = row["control_usage"]
                rows.append(
                    [
                        task,
                        f"`{row['policy']}`",
                        "deterministic",
                        _share(row["episode_safety_violation_rate"]),
                        f"{row['control_usage_l1']:.2f}",
                        f"{usage:.2f}",
                        _gap("control_usage", usage, self.controllers["bounds"][task]),
                        f"{row['episode_length']:.2f}",
                    ]
                )
        return rows

    def _safety(self) -> Rows:
        rows = []
        for task in self.tasks:
            for item, results in self._of_task(task):
                cost = results["training_cost"]
                starts = self.episodes[item.name]
                for way, metrics in results["evaluation"].items():
                    rows.append(
                        [
                            task,
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
            for row in self._of_controllers(task):
                violating = {"mean": row["safety_violation_rate"], "ci95": None}
                severities = [row[f"episode_violation_severity_{name}"] for name in ("mean", "max")]
                rows.append(
                    [
                        task,
                        f"`{row['policy']}`",
                        "deterministic",
                        _rate(violating, self.controllers["episodes"], 1),
                        _share(row["episode_safety_violation_rate"]),
                        *(_share(severity, 1) for severity in severities),
                        "",
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
                    or_dash(mode["control_usage_l1"]["mean"], ".2f") if docks else "–",
                    *(
                        or_dash(mode[metric]["mean"], ".1f")
                        for metric in ("average_return", "episode_length")
                    ),
                ]
            )
        return rows

    def _together(self) -> Rows:
        rows = []
        for kind in self.kinds:
            for way in EVALUATION_KINDS:
                scores = [
                    results["evaluation"][way]["success_rate"]["per_seed"]
                    for item, results in self.own
                    if item.kind == kind
                ]
                score = stratified_iqm(scores)
                rows.append([kind, way, _percent({"mean": score["iqm"], "ci95": score["ci95"]})])
        return rows

    def _pictures(self, section: str, files: Path, words: Mapping[str, str]) -> str:
        """Return a section of pictures, which repeats its paragraphs for each task.

        A picture that is not in `files` is left out with its caption.
        """
        title, *paragraphs = section.split("\n\n")
        lines = [title]
        for task in self.tasks:
            shown = True
            for paragraph in paragraphs:
                text = Template(paragraph).substitute(words, task=task)
                picture = re.fullmatch(r"!\[.*\]\(.*/(.*)\)", text)
                # A caption follows its picture, and both are there or neither is.
                if picture:
                    shown = (files / picture[1]).exists()
                if shown or text.startswith("#"):
                    lines.append(text)
        return "\n\n".join(lines)

    def _curves(self, files: str) -> str:
        return ", ".join(f"[{item.name}]({files}/{item.name}.csv)" for item, _ in self.own)

    def _commands(self) -> list[str]:
        """Return the commands behind the tables, as a user would type them."""
        lines = []
        for item, results in self.own:
            run = Path("runs", item.name)
            lines.append(f"jaxsafe train {shlex.join(item.words)} out={run}")
            count = self.episodes[item.name]
            for name, options in item.evaluations.items():
                best = run / "policy" / f"seed_{best_seed(results)}.npz"
                command = f"jaxsafe evaluate run={best if name == SHIPPED else run}"
                lines.append(f"{command} episodes={count} {shlex.join(options)}")
                if name == SHIPPED:
                    lines.append(f"{command} {shlex.join(FILM)}")
        return lines


def _template(name: str) -> str:
    return (TEMPLATES / name).read_text(encoding="utf-8").rstrip()


def _title(name: str) -> str:
    return _template(name).partition("\n")[0].removeprefix("# ")


def _learnt(results: Mapping[str, Any]) -> str:
    steps = results["interaction_efficiency"]["timesteps"]
    return f"{steps:,}" if steps else "never"


def _succeeded(results: Mapping[str, Any]) -> str:
    return _both(results, "success_rate")


def _violating_in_training(results: Mapping[str, Any]) -> str:
    return or_dash(results["training_cost"]["mean"], ",.0f")


def _violating(results: Mapping[str, Any]) -> str:
    return _both(results, "episode_safety_violation_rate")


def _both(results: Mapping[str, Any], name: str) -> str:
    """Return a share in percent, with sampled actions and with the most probable ones."""
    metrics = results["evaluation"]
    shares = [metrics[actions][name]["mean"] for actions in EVALUATION_KINDS]
    return " / ".join("–" if share is None else f"{100 * share:.2f}" for share in shares)


GAPS = {
    "average_return": ("return", -1.0, ".3f"),
    "episode_length": ("length", 1.0, ".1f"),
    "control_usage": ("delta_v", 1.0, ".2f"),
}
"""The bound of a metric, the sign of a gap to it, and the format of the gap."""


def _gap(name: str, value: float | None, bounds: Mapping[str, float]) -> str:
    """Return how far a metric is from what is possible, or a dash."""
    bound, sign, form = GAPS[name]
    if value is None or bound not in bounds:
        return "–"
    return format(sign * (value - bounds[bound]), form)


def _markdown(rows: Rows) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _share(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f} %"


def _percent(metric: Mapping[str, Any]) -> str:
    if metric["mean"] is None:
        return "–"
    return f"{mean_text(metric, '.2f', 100.0)} %"


def _number(metric: Mapping[str, Any], digits: int = 2) -> str:
    if metric["mean"] is None:
        return "–"
    return mean_text(metric, f",.{digits}f")


def _rate(metric: Mapping[str, Any], starts: int, seeds: int) -> str:
    """Return a share of episodes. A zero is shown with the upper bound that it proves.

    The bound comes from the number of starts of one seed, because all seeds have the same starts.
    """
    return (
        _percent(metric)
        if metric["mean"] != 0
        else f"0 of {starts * seeds:,} (< {300 / starts:.2g} %)"
    )
