"""The page of the baselines: tables, figures and curves from the result files of the runs."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
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
"""Beside the page: records, curves, figures and films."""


class Report:
    """The records of all items, and the page that they make."""

    def __init__(self, records: Sequence[Record]) -> None:
        """Of at least one record."""
        self.records = sorted(records, key=lambda record: [*TASKS].index(record.item.task))
        self.own = [(record.item, record.results) for record in self.records]
        self.further = [
            (record, name, found)
            for record in self.records
            for name, found in record.evaluations.items()
        ]
        self.episodes = {
            record.item.name: record.options["training"]["episodes"] for record in records
        }
        self.kinds = [kind for kind in KINDS if any(record.item.kind == kind for record in records)]
        self.tasks = [task for task in TASKS if any(record.item.task == task for record in records)]

    def write(self, out: Path) -> Path:
        """Write `baselines.md`, and the figures of training into the directory beside it where the records are."""
        files = out / DIRECTORY
        for task in self.tasks:
            curves = {
                record.item.kind: record.curves
                for record in self.records
                if record.item.task == task
            }
            failed = {
                item.kind: failed_seeds(found) for item, found in self.own if item.task == task
            }
            steps = TASKS[task].paper_steps
            mark = None if steps is None else ("the paper's 80 %", steps)
            save(compare_curves(curves, task, mark=mark), files / f"{task}_training.png")
            save(seed_curves(curves, task, failed), files / f"{task}_seeds.png")
        page = out / "baselines.md"
        write_text(page, self.text(files))
        return page

    def text(self, files: Path) -> str:
        """The page as Markdown; figures that are not in `files` are left out."""
        parts = [
            self._head(), self._efficiency(), self._wall(), self._final(), self._docking(), self._safety(), self._rta(),
            self._starts(), self._best(), self._together(), self._pictures(files), self._settings(),
        ]  # fmt: skip
        return "\n\n".join(part for part in parts if part) + "\n"

    def _head(self) -> str:
        one = self.records[0].results
        return "\n".join([
            "# Baselines",
            "",
            "Every number and picture below comes from a command, and so does this page:",
            "",
            *self._origins(),
            "",
            "Each task is trained in these ways, by PPO:",
            "",
            *(f"- **{kind}**: {KINDS[kind].about}" for kind in self.kinds),
            "",
            f"Seeds {one['seed']} to {one['seed'] + one['seeds'] - 1} of every training; all recipes were found on other"
            " seeds (100 and above). Where one of these seeds failed in a report, some recipes were sought anew, again on"
            " other seeds: the wish to seek has seen these seeds, the numbers found have not. Once one of these seeds"
            " decided: the lanes of oriented docking went back from `ppo.noise_decay` 1.5, which had done well on six other"
            " seeds, to 1.0."
            f" Evaluations are of {max(self.episodes.values()):,} episodes a seed, if nothing else is said, from starts"
            " that no training chose, the same for all policies of a task and way, with sampled actions (stochastic) and"
            " with the policy's mode (deterministic)."
            " In brackets: 95 % percentile-bootstrap intervals over seeds."
            " Another processor rounds otherwise, and then every training ends elsewhere.",
            "",
            "The paper's names (Section 5) of what the tables show: violating steps are its episode safety violation rate,"
            " episodes with a violation its safety violation rate, severity its episode violation severity, Δv in the L2"
            " norm its control usage, steps with an intervention its intervention rate. In the tables all steps of all"
            " episodes count alike; in the curves of training every episode counts alike (`violating_share`)."
            " Every metric under its own name is in the JSON beside each table's curves.",
        ])  # fmt: skip

    def _origins(self) -> list[str]:
        """A line for each command, commit and set of versions that some of the records come from."""
        found: dict[tuple[str, str], list[str]] = {}
        for record in self.records:
            versions = dict(record.results["versions"])
            device, processor = versions.pop("device"), versions.pop("processor", None)
            where = f" on commit {record.commit}" if record.commit else ""
            made_by = ", ".join(f"{name} {version}" for name, version in versions.items())
            made_by += f"; {device}{f' ({processor})' if processor else ''}, float32"
            found.setdefault((f"`{record.command}`{where}", made_by), []).append(record.item.name)
        return [
            f"- {origin}: {', '.join(names)} ({versions})"
            for (origin, versions), names in found.items()
        ]

    def _efficiency(self) -> str:
        rows = []
        for record in self.records:
            item, found = record.item, record.results
            steps, per_seed = (
                found["interaction_efficiency"][name] for name in ("timesteps", "per_seed")
            )
            paper, strict = TASKS[item.task].paper_steps, steps_to(0.8, record.curves, WINDOW)
            rows.append([
                item.task, item.kind, f"{paper:,}", f"{steps:,}" if steps else "never",
                f"{paper / steps:.1f}" if steps else "–",
                f"{finished(record.curves, steps):,.0f}" if steps else "–",
                f"{strict:,}" if strict else "never",
                f"{sum(one is not None for one in per_seed)} of {len(per_seed)}",
                f"{found['steps']:,}", f"{found['wall_s']:.0f}", f"{found['compile_s']:.0f}",
            ])  # fmt: skip
        return _section(
            "Interaction efficiency",
            "Environment steps per seed until 80 % of the last 100 training episodes succeeded, or of all so far if fewer,"
            f" at least {ENOUGH_EPISODES}, on the average over seeds: Table 2 of the paper, whose measure is the average"
            " success. Beside it how many episodes a seed had finished by then, on the average: those still running do not"
            " count, and where episodes are long those that succeed may be the first to end. So the next column has the"
            f" steps until it is 80 % of {WINDOW} episodes of every seed. An episode that the recipe truncates counts"
            " as a failed one. The wall time is that of the whole command for all seeds: imports, compilation, training,"
            " evaluation; compiling is the wait for the training program.",
            f"task | way | paper | here | paper / here | episodes | of {WINDOW} episodes | seeds at 80 % | trained for"
            " | wall [s] | compiling [s]",
            rows,
        )

    def _wall(self) -> str:
        rows = []
        for record in self.records:
            if record.item.kind in ("quick", "lanes"):
                reached, pace, found = (
                    wall_to(0.95, record.curves),
                    samples_per_second(record.curves),
                    record.results,
                )
                rows.append([
                    record.item.task, record.item.kind, f"{found['steps']:,}",
                    f"{reached:.1f}" if reached is not None else "never", f"{found['wall_s']:.1f}",
                    f"{found['compile_s']:.1f}", f"{pace:,.0f}" if pace is not None else "unknown",
                ])  # fmt: skip
        return (
            _section(
                "Wall time",
                "The shortest recipes and those with the most environments, all seeds at once: seconds from the start of"
                " the command until 95 % of the last 100 training episodes succeeded, on the average over seeds, and until"
                " its end; the wait for the training program; and environment steps a second of all seeds together from the"
                " first update to the last, with their updates and the evaluations between them.",
                "task | way | trained for | to 95 % [s] | whole command [s] | compiling [s] | samples/s",
                rows,
            )
            if rows
            else ""
        )

    def _final(self) -> str:
        rows = []
        for item, found in self.own:
            evaluation = found["evaluation"]
            each = [evaluation[kind]["success_rate"] for kind in ("stochastic", "deterministic")]
            rows.append([
                item.task, item.kind, *(_percent(one) for one in each),
                _share(least(each), 1),
                ", ".join(map(str, failed_seeds(found))) or "none",
                *(_number(evaluation["deterministic"][name]) for name in ("average_return", "episode_length")),
            ])  # fmt: skip
        return _section(
            "After training",
            "Success rate, the worst seed's, which seeds failed (below 95 %, stochastic or deterministic), and the"
            " return and length [s] of deterministic episodes. Averages are over all seeds, those that failed included.",
            "task | way | success, stochastic | success, deterministic | worst seed | failed seeds | return | length",
            rows,
        )

    def _docking(self) -> str:
        rows = [
            [item.task, item.kind, kind, _percent(one["episode_safety_violation_rate"]), _number(one["control_usage_l1"]),
             _number(one["control_usage"]), _number(one["episode_length"])]
            for item, found in self.own if item.task.startswith("docking")
            for kind, one in found["evaluation"].items()
        ]  # fmt: skip
        return (
            _section(
                "Quality of docking",
                "Share of steps above the speed limit, Δv [m/s] in both norms, length [s]. Flying at the limit all the way"
                " takes 400 s from 125 m.",
                "task | way | actions | violating steps | Δv, L1 | Δv, L2 | length",
                rows,
            )
            if rows
            else ""
        )

    def _safety(self) -> str:
        rows = []
        for item, found in self.own:
            cost, starts = found["training_cost"], self.episodes[item.name]
            for kind, one in found["evaluation"].items():
                rows.append([
                    item.task, item.kind, kind, _rate(one["safety_violation_rate"], starts, found["seeds"]),
                    _percent(one["episode_safety_violation_rate"]),
                    *(_share(one[f"episode_violation_severity_{name}"]["mean"], 1) for name in ("mean", "max")),
                    _number(cost, 0) if kind == "stochastic" else "",
                ])  # fmt: skip
        return _section(
            "Safety",
            "Episodes with a violation (beside a zero its 95 % upper bound by the rule of three; all seeds have the same"
            " starts, so it counts them once), violating steps, severity: the excess as a share of the limit, mean over"
            " violating steps and maximum over episodes, averaged over seeds, 0 for a seed without a violation; and how"
            " many steps of the training violated a constraint, per seed.",
            "task | way | actions | episodes with a violation | violating steps | severity, mean | maximum | training cost",
            rows,
        )

    def _rta(self) -> str:
        rows = []
        for record, name, found in self.further:
            if name not in (WITH_RTA, WITHOUT_RTA):
                continue
            flown = ("without", "with") if name == WITH_RTA else ("with", "without")
            item, own = record.item, record.results
            trained = "with, unpunished" if item.kind == "unpunished" else flown[0]
            narrowed = any(word in item.words for word in CERTIFIED_STARTS.get(item.task, ()))
            starts = "narrowed" if narrowed else "the task's"
            for label, results in zip(flown, (own, found), strict=True):
                one = results["evaluation"]["stochastic"]
                share = one["intervention_rate"]
                rows.append([
                    item.task, trained, label, starts, _percent(one["success_rate"]),
                    _rate(one["safety_violation_rate"], self.episodes[item.name], results["seeds"]),
                    _percent(share),
                    _number(own["training_cost"], 0) if results is own else "",
                ])  # fmt: skip
        return (
            _section(
                "Run time assurance",
                "Policies trained without and with the filter, flown without and with it (stochastic). Narrowed starts are"
                " those of the training, at up to 99 % of the speed limit: rows with other starts do not compare. The"
                " training cost counts the violating steps of the whole training, per seed.",
                "task | trained | flown | starts | success | episodes with a violation | steps with an intervention"
                " | training cost",
                rows,
            )
            if rows
            else ""
        )

    def _starts(self) -> str:
        rows = []
        for record, name, found in self.further:
            if name in (WITH_RTA, WITHOUT_RTA, SHIPPED):
                continue
            one = found["evaluation"]["deterministic"]
            rows.append([
                record.item.task, name,
                *(_percent(found["evaluation"][kind]["success_rate"]) for kind in found["evaluation"]),
                *(_percent(one[metric]) for metric in ("safety_violation_rate", "episode_safety_violation_rate")),
                _share(one["episode_violation_severity_max"]["mean"], 1),
                _number(one["average_return"]), _number(one["control_usage_l1"]), _number(one["episode_length"], 1),
            ])  # fmt: skip
        return (
            _section(
                "Starts outside training",
                "The same policies (`features`) from farther away than they ever started. From 10 km the way at the speed"
                " limit takes 2,257 s, more than the 2,000 s that docking2d and docking3d have, so there the timeout"
                " of all is 6,000 s, and so is the time that the success reward is scaled by. All columns but the first"
                " success rate are of deterministic episodes.",
                "task | start | success, stochastic | success, deterministic | episodes with a violation | violating steps"
                " | severity, maximum | return | Δv, L1 [m/s] | length [s]",
                rows,
            )
            if rows
            else ""
        )

    def _best(self) -> str:
        rows = []
        for record, name, found in self.further:
            if name != SHIPPED:
                continue
            drawn, mode = found["evaluation"]["stochastic"], found["evaluation"]["deterministic"]
            docks = record.item.task.startswith("docking")
            rows.append([
                record.item.task, str(best_seed(record.results)),
                *(_share(one["success_rate"]["mean"]) for one in (drawn, mode)),
                _share(mode["episode_safety_violation_rate"]["mean"]),
                known(mode["control_usage_l1"]["mean"], ".2f") if docks else "–",
                *(known(mode[metric]["mean"], ".1f") for metric in ("average_return", "episode_length")),
            ])  # fmt: skip
        return (
            _section(
                "The best policies",
                "One of each task's `features` policies: that whose deterministic episodes in the run's own evaluation"
                " succeeded most often, then violated least, then had the highest return; here flown from other starts"
                " (`seed=1`) than those it was chosen by. The package comes with those of its own report"
                ' (`run=pretrained/TASK`, `jaxsafe.load_policy("TASK")`); the films below show them.',
                "task | seed | success, stochastic | success, deterministic | violating steps | Δv, L1 [m/s] | return"
                " | length [s]",
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
                    for item, found in self.own
                    if item.kind == kind
                ]
                both = stratified_iqm(scores)
                rows.append([kind, way, _percent({"mean": both["iqm"], "ci95": both["ci95"]})])
        return _section(
            "All tasks together",
            "Interquartile mean of the success rates of all seeds of all tasks; 95 % intervals of a stratified bootstrap.",
            "way | actions | IQM",
            rows,
        )

    def _pictures(self, files: Path) -> str:
        lines = ["## Pictures", ""]
        for task in self.tasks:
            lines += [f"### {task}", ""]
            for file, caption in (
                (
                    f"{task}_training.png",
                    f"Training in each way, once every seed has finished {ENOUGH_EPISODES} episodes (where those are long,"
                    " much is learnt before that): mean and 95 % interval over seeds",
                ),
                (
                    f"{task}_seeds.png",
                    "Success in training of every seed; dashed those that failed after it",
                ),
                (
                    f"{task}_trajectories.png",
                    "Paths of deterministic episodes of the first seed (`features`): from one start while it was trained,"
                    " then from several, and their ends",
                ),
                (
                    f"{task}_speed_distance.png",
                    "Speed against distance in the same episodes, and the limit",
                ),
                (f"{task}.gif", "A deterministic episode of the best policy"),
            ):
                if (files / file).exists():
                    lines += [
                        f"![{task}: {caption.replace('`', '')}]({files.name}/{file})",
                        "",
                        f"*{caption}.*",
                        "",
                    ]
        return "\n".join(lines).rstrip()

    def _settings(self) -> str:
        lines = [
            "## To repeat and to reuse", "",
            "Curves of every seed, a row for each update, averages over the last 100 finished episodes: `step`, environment"
            " steps of the seed; `wall_s`, seconds of the run;"
            " `success_rate`; `return`; `length` [s]; `delta_v` [m/s], L2; `violating_share` of an episode's steps; `cost`,"
            " violating steps of the whole training so far; `episodes` finished so far:"
            " " + ", ".join(f"[{item.name}](baselines/{item.name}.csv)" for item, _ in self.own) + "; beside each, as"
            " JSON, every result of every seed.",
            "Hyperparameters stand in `configs/`. The commands behind the tables, also one by one:", "", "```",
        ]  # fmt: skip
        for item, found in self.own:
            run = Path("runs", item.name)
            lines.append(f"python -m jaxsafe.train {shlex.join(item.words)} out={run}")
            count = self.episodes[item.name]
            for name, options in item.evaluations.items():
                subject = (
                    run / "policy" / f"seed_{best_seed(found)}.npz" if name == SHIPPED else run
                )
                lines.append(
                    f"python -m jaxsafe.evaluate run={subject} episodes={count} {shlex.join(options)}"
                )
                if name == SHIPPED:
                    lines.append(f"python -m jaxsafe.evaluate run={subject} {shlex.join(FILM)}")
        return "\n".join([*lines, "```"])


def _section(title: str, text: str, heads: str, rows: Sequence[Sequence[str]]) -> str:
    lines = [f"## {title}", "", text, "", f"| {heads} |", "|" + "---|" * len(heads.split(" | "))]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


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
    """A share of episodes; a zero with the bound that it proves, of starts: all seeds have the same."""
    return (
        _percent(metric)
        if metric["mean"] != 0
        else f"0 of {starts * seeds:,} (< {300 / starts:.2g} %)"
    )
