"""The page of the baselines: tables, figures and curves from the result files of the runs."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsafe.config import yaml
from jaxsafe.metrics import stratified_iqm
from jaxsafe.plot.compare import compare_curves
from jaxsafe.plot.style import save
from jaxsafe.report.plan import KINDS, PAPER_STEPS, WITH_RTA, WITHOUT_RTA, Item
from jaxsafe.report.run import FILM
from jaxsafe.train.files import read_json, read_rows, write_csv, write_text

POINTS = 100
"""Rows of each seed in the published curves."""

CURVES = ("success_rate", "return", "length", "delta_v", "violating_steps", "cost", "episodes")

Results = dict[str, Any]


class Report:
    """All items of a plan with their results, and the page that they make."""

    def __init__(self, items: Mapping[Item, Path], command: str, commit: str | None) -> None:
        """Read the results of every run."""
        self.runs, self.command, self.commit = dict(items), command, commit
        self.results: dict[Item, Results] = {item: read_json(run / "results.json") for item, run in items.items()}
        self.others: dict[tuple[Item, str], Results] = {
            (item, name): read_json(item.evaluation_directory(run, name) / "results.json")
            for item, run in items.items()
            for name in item.evaluations
        }
        self.rows = {item: read_rows(run / "progress.jsonl") for item, run in items.items()}
        self.episodes = yaml.read(next(iter(items.values())) / "config.yaml")["training"]["episodes"]
        self.kinds = list(dict.fromkeys(item.kind for item in items))
        self.tasks = list(dict.fromkeys(item.task for item in items))

    def write(self, out: Path) -> Path:
        """Write `baselines.md` and beside it the directory `baselines` with figures, films and curves."""
        files = out / "baselines"
        for item, run in self.runs.items():
            write_csv(files / f"{item.name}.csv", _thinned(self.rows[item]))
            for figure in ("trajectories", "speed_distance") if item.kind == "features" else ():
                if (run / "figures" / f"{figure}.png").exists():
                    shutil.copy(run / "figures" / f"{figure}.png", files / f"{item.task}_{figure}.png")
            if (run / "film" / FILM).exists():
                shutil.copy(run / "film" / FILM, files / f"{item.task}.gif")
        for task in self.tasks:
            rows = {item.kind: rows for item, rows in self.rows.items() if item.task == task}
            save(compare_curves(rows, task), files / f"{task}_training.png")
        page = out / "baselines.md"
        write_text(page, self.text(files))
        return page

    def text(self, files: Path) -> str:
        """The page as Markdown; figures that are not in `files` are left out."""
        parts = [
            self._head(), self._efficiency(), self._final(), self._docking(), self._safety(), self._rta(), self._starts(),
            self._together(), self._pictures(files), self._settings(),
        ]  # fmt: skip
        return "\n\n".join(part for part in parts if part) + "\n"

    def _head(self) -> str:
        one = next(iter(self.results.values()))
        versions = ", ".join(f"{name} {version}" for name, version in one["versions"].items() if name != "device")
        return "\n".join([
            "# Baselines",
            "",
            f"<!-- Written by `{self.command}`. -->",
            f"Written by `{self.command}`: every number and picture below comes from that command"
            + (f" on commit {self.commit[:12]}" if self.commit else "") + ".",
            f"Versions: {versions}; {one['versions']['device']}, float32.",
            "",
            "Each task is trained in these ways, by PPO:",
            "",
            *(f"- **{kind}**: {KINDS[kind].about}" for kind in self.kinds),
            "",
            f"Seeds {one['seed']} to {one['seed'] + one['seeds'] - 1} of every training; all recipes were found on other"
            f" seeds (100 and above). Evaluations are of {self.episodes:,} episodes a seed from starts that no training"
            " chose, the same for all policies, with sampled actions (stochastic) and with the policy's mode"
            " (deterministic)."
            " In brackets: 95 % percentile-bootstrap intervals over seeds.",
        ])  # fmt: skip

    def _efficiency(self) -> str:
        rows = []
        for item, found in self.results.items():
            steps, per_seed = (found["interaction_efficiency"][name] for name in ("timesteps", "per_seed"))
            paper = PAPER_STEPS[item.task]
            rows.append([
                item.task, item.kind, f"{paper:,}", f"{steps:,}" if steps else "never",
                f"{paper / steps:.1f}" if steps else "–", f"{sum(one is not None for one in per_seed)} of {len(per_seed)}",
                f"{found['steps']:,}", f"{found['wall_s']:.0f}", f"{found['compile_s']:.0f}",
            ])  # fmt: skip
        return _section(
            "Interaction efficiency",
            "Environment steps per seed until 80 % of the last 100 training episodes succeeded, on the average over seeds:"
            " Table 2 of the paper, by its definition; an episode that the recipe truncates counts as a failed one. The"
            " wall time is that of the whole command for all seeds: imports, compilation, training, evaluation.",
            ["task", "", "paper", "here", "paper / here", "seeds at 80 %", "steps", "wall [s]", "of it compiling [s]"],
            rows,
        )

    def _final(self) -> str:
        rows = []
        for item, found in self.results.items():
            evaluation = found["evaluation"]
            each = [evaluation[kind]["success_rate"] for kind in ("stochastic", "deterministic")]
            failed = sum(min(pair) < 0.95 for pair in zip(*(one["per_seed"] for one in each), strict=True))
            rows.append([
                item.task, item.kind, *(_percent(one) for one in each),
                f"{100 * min(min(one['per_seed']) for one in each):.1f} %", str(failed) if failed else "none",
                *(_number(evaluation["deterministic"][name]) for name in ("average_return", "episode_length")),
            ])  # fmt: skip
        return _section(
            "After training",
            "Success rate, the worst seed's, how many seeds failed (below 95 %, stochastic or deterministic), and the"
            " return and length [s] of deterministic episodes. Averages are over all seeds, those that failed included.",
            ["task", "", "success, stochastic", "success, deterministic", "worst seed", "failed seeds", "return", "length"],
            rows,
        )

    def _docking(self) -> str:
        rows = [
            [item.task, item.kind, kind, _percent(one["episode_safety_violation_rate"]), _number(one["control_usage_l1"]),
             _number(one["control_usage"]), _number(one["episode_length"])]
            for item, found in self.results.items() if item.task.startswith("docking")
            for kind, one in found["evaluation"].items()
        ]  # fmt: skip
        return (
            _section(
                "Quality of docking",
                "Share of steps above the speed limit, Δv [m/s] in both norms, length [s]. Flying at the limit all the way"
                " takes 400 s from 125 m.",
                ["task", "", "", "violating steps", "Δv, L1", "Δv, L2", "length"],
                rows,
            )
            if rows
            else ""
        )

    def _safety(self) -> str:
        rows = []
        for item, found in self.results.items():
            cost = found["training_cost"]
            for kind, one in found["evaluation"].items():
                rows.append([
                    item.task, item.kind, kind, _rate(one["safety_violation_rate"], self.episodes * found["seeds"]),
                    _percent(one["episode_safety_violation_rate"]),
                    *(f"{100 * one[f'episode_violation_severity_{name}']['mean']:.1f} %" for name in ("mean", "max")),
                    _number(cost, 0) if kind == "stochastic" else "",
                ])  # fmt: skip
        return _section(
            "Safety",
            "Episodes with a violation (beside a zero its 95 % upper bound by the rule of three), violating steps,"
            " severity: the excess as a share of the limit, mean over violating steps and maximum over episodes, averaged"
            " over seeds; and how many steps of the whole training violated a constraint, per seed.",
            ["task", "", "", "episodes with a violation", "violating steps", "severity, mean", "maximum", "training cost"],
            rows,
        )

    def _rta(self) -> str:
        rows = []
        for (item, name), found in self.others.items():
            if name not in (WITH_RTA, WITHOUT_RTA):
                continue
            trained, flown = ("without", "with") if name == WITH_RTA else ("with", "without")
            own = self.results[item]
            for label, results in ((trained, own), (flown, found)):
                one = results["evaluation"]["stochastic"]
                share = one["intervention_rate"]
                rows.append([
                    item.task, trained, label, _percent(one["success_rate"]),
                    _rate(one["safety_violation_rate"], self.episodes * results["seeds"]),
                    _percent(share) if share["mean"] is not None else "–",
                    _number(own["training_cost"], 0) if label == trained else "",
                ])  # fmt: skip
        return (
            _section(
                "Run time assurance",
                "Policies trained without and with the filter, flown without and with it (stochastic). The training cost"
                " counts the violating steps of the whole training, per seed.",
                [
                    "task",
                    "trained",
                    "flown",
                    "success",
                    "episodes with a violation",
                    "steps with an intervention",
                    "training cost",
                ],
                rows,
            )
            if rows
            else ""
        )

    def _starts(self) -> str:
        rows = [
            [item.task, name, *(_percent(found["evaluation"][kind]["success_rate"]) for kind in found["evaluation"]),
             *(_percent(found["evaluation"]["deterministic"][metric])
               for metric in ("safety_violation_rate", "episode_safety_violation_rate")),
             _number(found["evaluation"]["deterministic"]["episode_length"])]
            for (item, name), found in self.others.items() if name not in (WITH_RTA, WITHOUT_RTA)
        ]  # fmt: skip
        return (
            _section(
                "Starts outside training",
                "The same policies (`features`) from farther away than they ever started. From 10 km the way at the speed"
                " limit takes 2 256 s, more than the timeout, which is 6 000 s there.",
                [
                    "task",
                    "start",
                    "success, stochastic",
                    "deterministic",
                    "episodes with a violation",
                    "violating steps",
                    "length",
                ],
                rows,
            )
            if rows
            else ""
        )

    def _together(self) -> str:
        rows = []
        for kind in self.kinds:
            for way in ("stochastic", "deterministic"):
                scores = [
                    found["evaluation"][way]["success_rate"]["per_seed"]
                    for item, found in self.results.items()
                    if item.kind == kind
                ]
                both = stratified_iqm(scores)
                low, high = both["ci95"]
                rows.append([kind, way, f"{100 * both['iqm']:.2f} [{100 * low:.2f}, {100 * high:.2f}] %"])
        return _section(
            "All tasks together",
            "Interquartile mean of the success rates of all seeds of all tasks; 95 % intervals of a stratified bootstrap.",
            ["", "", "IQM"],
            rows,
        )

    def _pictures(self, files: Path) -> str:
        lines = ["## Pictures", ""]
        for task in self.tasks:
            lines += [f"### {task}", ""]
            for file, caption in (
                (f"{task}_training.png", f"training of {task}"),
                (f"{task}_trajectories.png", "paths of deterministic episodes, from early in training (purple) to its end"),
                (f"{task}_speed_distance.png", "speed against distance of the same episodes, and the limit"),
                (f"{task}.gif", f"a deterministic episode of {task}"),
            ):
                if (files / file).exists():
                    lines += [f"![{caption}]({files.name}/{file})", ""]
        return "\n".join(lines).rstrip()

    def _settings(self) -> str:
        lines = [
            "## To repeat and to reuse", "",
            "Curves of every seed, thinned to 100 rows each:"
            " " + ", ".join(f"[{item.name}](baselines/{item.name}.csv)" for item in self.runs) + ".",
            "Hyperparameters stand in `configs/`. The commands behind the tables, also one by one:", "", "```",
        ]  # fmt: skip
        for item in self.runs:
            lines.append(f"python -m jaxsafe.train {' '.join(item.words)} out=runs/{item.name}")
            lines += [
                f"python -m jaxsafe.evaluate run=runs/{item.name} {' '.join(options)}"
                for options in item.evaluations.values()
            ]
        return "\n".join([*lines, "```"])


def _section(title: str, text: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"## {title}", "", text, "", f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def _percent(metric: Mapping[str, Any]) -> str:
    low, high = metric["ci95"]
    return f"{100 * metric['mean']:.2f} [{100 * low:.2f}, {100 * high:.2f}] %"


def _number(metric: Mapping[str, Any], digits: int = 2) -> str:
    low, high = metric["ci95"]
    return f"{metric['mean']:,.{digits}f} [{low:,.{digits}f}, {high:,.{digits}f}]"


def _rate(metric: Mapping[str, Any], episodes: int) -> str:
    """A share of episodes; a zero with the bound that it proves."""
    return _percent(metric) if metric["mean"] else f"0 of {episodes:,} (< {300 / episodes:.2g} %)"


def _thinned(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    steps = sorted({row["step"] for row in rows})
    kept = {steps[round(i * (len(steps) - 1) / max(POINTS - 1, 1))] for i in range(POINTS)} if steps else set()
    return [{name: row[name] for name in ("seed", "step", *CURVES)} for row in rows if row["step"] in kept]
