"""The tables of the pages, from the results of the benchmarks and of the report.

So the pages cannot drift from the results. Run `python benchmarks/tables.py` after a benchmark or a
report. Each table replaces the table in its page that has the same first row.
`tests/benchmarks/test_benchmarks.py` compares the committed pages with what this script would
write.
"""

from __future__ import annotations

import math
import re
import statistics
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from baselines.plan import WITHOUT_RTA

from jaxsafe.envs import TASKS
from jaxsafe.evaluate.evaluator import EVALUATION_KINDS
from jaxsafe.metrics import stratified_iqm, with_interval
from jaxsafe.runs.protocol import Submission, findings, read_submission
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import read_json, write_text
from jaxsafe.storage.text_table import or_dash
from jaxsafe.train.host.results import mean_text

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
STUDIES = ROOT / "examples" / "studies" / "results"
BASELINES = ROOT / "docs" / "baselines"
SUBMITTED = ROOT / "docs" / "submitted"

Results = Mapping[str, Any]
"""The content of a file of results."""

PENDULUM = "gymnax:Pendulum-v1"
ENVIRONMENTS = {
    **{task: task for task in TASKS},
    "docking3d:one_action": "docking3d, one action",
    "docking3d:no_reset": "docking3d, one action, no reset",
    "docking3d:usual_way": "docking3d, the usual way",
    PENDULUM: "gymnax Pendulum-v1",
    "gymnax:CartPole-v1": "gymnax CartPole-v1",
    f"{PENDULUM}:one_action": "gymnax Pendulum-v1, one action",
    "brax:inverted_pendulum": "Brax inverted pendulum, spring",
    "gymnasium:CartPole-v1": "Gymnasium CartPole-v1, NumPy",
    "envpool:CartPole-v1": "EnvPool CartPole-v1, one thread",
}
"""What the pages call a row of `environments.py`, by its name there."""

PENDULUM_BESIDE_RELEASED = 9.4e6
"""Steps a second of Pendulum-v1 in 4,096 environments where the released code was measured.

Ratios to the released code are as on that machine, because the code is not run again.
"""


class Facts(NamedTuple):
    """What the README says about a task besides its results."""

    goal: str
    never: str  # what the safety constraint forbids
    observation: int  # number of its elements
    actions: int  # number of actuators


_REJOIN = "hold formation for 20 s"
_APART = "within 100 ft of the lead"
_DOCK = "within 0.5 m of the chief"
_SLOW = "above the speed limit"
FACTS = {
    "rejoin2d": Facts(goal=_REJOIN, never=_APART, observation=12, actions=2),
    "rejoin3d": Facts(goal=_REJOIN, never=_APART, observation=18, actions=3),
    "docking2d": Facts(goal=_DOCK, never=_SLOW, observation=6, actions=2),
    "docking3d": Facts(goal=_DOCK, never=_SLOW, observation=8, actions=3),
    "docking2d_oriented": Facts(goal=_DOCK, never=_SLOW, observation=9, actions=2),
}
"""Facts by task."""

PPO = {
    "jaxsafe": "jaxsafe, one seed",
    "jaxsafe, ten seeds": "jaxsafe, ten seeds",
    "jaxsafe, sorting": "jaxsafe, shuffled by sorting",
    "networks only": "its networks and Adam alone",
    "usual way": "[PPO written the usual way](../benchmarks/usual_ppo.py), as in PureJaxRL",
    "rejax": "rejax",
    "brax": "Brax",
    "sb3": "Stable-Baselines3",
}
"""What the pages call a row of `ppo.py`, by its name there."""

VARIANTS = {
    "sorting shuffle": "shuffled by sorting",
    "whole gradients": "gradients of whole minibatches",
    "two devices a seed": "two devices share each seed",
}
"""What the pages call a variant of `learning.py`, by its name there."""

ADAPTERS = {
    "pure functions, called from Python": "pure functions, called from Python",
    "GymVectorEnv": "`GymVectorEnv`",
    "SafetyEnv": "`SafetyEnv`, a batch",
    "SB3VecEnv": "`SB3VecEnv`",
    "GymnaxEnv": "`GymnaxEnv`, mapped",
    "BraxEnv": "`BraxEnv` in `wrap`",
    "GymEnv": "`GymEnv`",
    "SyncVectorEnv of GymEnv": "`SyncVectorEnv` of `GymEnv`",
    "Gymnasium CartPole, NumPy": "Gymnasium CartPole, NumPy",
    "EnvPool CartPole": "EnvPool CartPole",
}
"""What the pages call a row of `adapters.py`, by its name there."""

DOCKING_FIRST = sorted(TASKS, key=lambda task: task.startswith("rejoin"))
"""The tasks in the order of docs/safety."""

PARTS = (
    "whole",
    "import of JAX",
    "trace",
    "lower",
    "compile",
    "the rest",
    "XLA's passes",
    "emitters",
    "LLVM",
)
"""Columns of `startup_profile`."""

FILTERS = {
    "cbfpy, batched": "cbfpy 0.1.0, `vmap`",
    "run-time-assurance, one at a time": "run-time-assurance 1.18.6, one call at a time",
}
"""What the pages call a filter of another library, by its name in `rta.py`."""


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown. Empty cells are as short as they can be."""
    lines = [[*heads], *rows]
    text = ["|" + "|".join(f" {cell} " if cell else " " for cell in line) + "|" for line in lines]
    return "\n".join([text[0], "|" + "---|" * len(heads), *text[1:]])


def speed(_: Results) -> str:
    """Return the table of the steps a second of each task, and the seconds to learn it."""
    results = {
        name: read_json(RESULTS / f"{name}.json") for name in ("environments", "accelerator")
    }
    core = _steps(results["environments"])
    rows = results["accelerator"]["parts"]["environments"]["rows"]
    largest = max(row["environments"] for row in rows)
    gpu = {row["task"]: row["steps_per_s"] for row in rows if row["environments"] == largest}
    lines = []
    for task in TASKS:
        rates = [core[task, 4096], gpu[task]]
        seconds = [
            _record(task, kind)["results"]["wall_s"]
            for kind in ("engineered_features", "shortest_time")
        ]
        lines.append(
            [task, *(_three(rate / 1e6) for rate in rates), *(f"{value:.0f}" for value in seconds)]
        )
    heads = (
        "task | million steps/s, one core | one GPU | ten seeds, default recipe [s]"
        " | `preset=shortest_time` [s]"
    )
    return markdown(heads.split(" | "), lines)


def environments(results: Results) -> str:
    """Return the table of medians of million steps a second."""
    rates = _steps(results)
    sizes = sorted({size for _, size in rates})
    heads = ["million steps/s at … environments", *(f"{size:,}" for size in sizes)]
    shown = [name for name in ENVIRONMENTS if (name, sizes[0]) in rates]
    return markdown(
        heads,
        (
            [ENVIRONMENTS[name], *(_three(rates[name, size] / 1e6) for size in sizes)]
            for name in shown
        ),
    )


def dynamics(results: Results) -> str:
    """Return the table of million steps a second of each model, and of the task's own model."""
    own: dict[str, float] = {}
    rows = []
    for run in results["runs"]:
        rate = run["steps_per_s"]
        base = own.setdefault(run["task"], rate)
        rows.append([f"`{run['model']}`", run["task"], _three(rate / 1e6), f"{rate / base:.2f}"])
    heads = ["model", "task", f"million steps/s at {results['num_envs']:,} environments"]
    return markdown([*heads, "of the first model of the task"], rows)


def robustness(results: Results) -> str:
    """Return the table of what happens at each level of uncertainty, without and with a filter."""
    heads = (
        "task, uncertainty",
        "filter",
        "attacked: violating steps",
        "worst h [m/s, ft]",
        "policy: violating steps",
        "success",
        "Δv [m/s]",
        "share of full control",
        "steps altered",
        "switches per step",
        "change of control a step",
    )
    rows = []
    for row in sorted(results["rows"], key=lambda row: (row["task"], row["level"])):
        unfiltered = row["rta"] == "none"
        delta_v = row["control_usage"]
        rows.append(
            (
                f"{row['task']}, {row['level']:g} × bound",
                f"`{row['rta']}`",
                f"{row['attacked']:.1%}",
                f"{row['attacked_worst_margin']:.{4 if 'docking' in row['task'] else 1}f}",
                f"{row['episode_safety_violation_rate']:.2%}",
                f"{row['success_rate']:.1%}",
                "–" if delta_v is None else f"{delta_v:.2f}",
                f"{row['control_effort']:.1%}",
                "–" if unfiltered else f"{row['intervention_rate']:.1%}",
                "–" if unfiltered else f"{row['switches']:.3f}",
                f"{row['chatter']:.2%}",
            )
        )
    return markdown(heads, rows)


TRAINED_IN = {
    "perfect": "the perfect world",
    "uncertain": "the uncertain world",
    "robust": "the uncertain world, under `robust`",
}
"""What the pages call a way of `uncertain_training.py`, by its name there."""


def uncertain_training(results: Results) -> str:
    """Return the table of how policies fare in an uncertain world, by where they were trained."""
    heads = ("task", "trained in", "tested with", "success", "worst seed", "violating steps")
    rows = []
    for row in results["rows"]:
        metrics = row["metrics"]
        rows.append(
            (
                row["task"],
                TRAINED_IN[row["trained"]],
                "no filter" if row["rta"] == "none" else f"`{row['rta']}`",
                f"{_interval(metrics['success_rate'], 100.0, 1)} %",
                f"{100.0 * min(metrics['success_rate']['per_seed']):.1f} %",
                f"{_interval(metrics['episode_safety_violation_rate'], 100.0, 2)} %",
                _share(metrics["intervention_rate"]) if row["rta"] != "none" else "–",
                f"{_interval(metrics['control_effort'], 100.0, 1)} %",
            )
        )
    return markdown((*heads, "steps altered", "share of full control"), rows)


def datasets(results: Results) -> str:
    """Return the scores of data for offline learning by where they come from."""
    heads = ("task", "`kind`", "steps", "return", "length", "success", "violating steps")
    rows = [
        (
            row["task"],
            f"`{row['kind']}`",
            f"{row['steps']:,}",
            f"{row['mean_return']:.3f}",
            f"{row['mean_length']:,.1f}",
            f"{100.0 * row['success_rate']:.1f} %",
            f"{sum(row['mean_costs']):.3f}",
        )
        for row in results["rows"]
    ]
    return markdown(heads, rows)


CONSTRAINED = {
    "reward": "the reward alone",
    "penalty": "a fixed penalty of 0.05",
    "lagrangian": "PPO-Lagrangian",
    "pid_lagrangian": "PID-Lagrangian",
    "early_termination": "early termination",
}
"""What the pages call a way of `constraints.py`, by its name there."""


def constraints(results: Results) -> str:
    """Return the table of ways of training under a constraint that the reward does not know."""
    rows = []
    for row in results["rows"]:
        drawn, mode = (row["evaluation"][kind] for kind in EVALUATION_KINDS)
        successes = drawn["success_rate"]["per_seed"] + mode["success_rate"]["per_seed"]
        rows.append(
            (
                CONSTRAINED[row["way"]],
                _interval(drawn["success_rate"], 100.0, 1),
                f"{100.0 * mode['success_rate']['mean']:.1f}",
                f"{100.0 * min(successes):.1f}",
                _interval(drawn["episode_cost"], 1.0, 1),
                _interval(mode["episode_cost"], 1.0, 1),
                f"{mode['episode_length']['mean']:.0f}",
                f"{row['training_cost']['mean']:,.0f}",
            )
        )
    heads = (
        "docking2d without its penalty, trained by | success, stochastic [%] | deterministic"
        " | worst seed | violating steps per episode, stochastic | deterministic | length [s]"
        " | violating steps of the training"
    )
    return markdown(heads.split(" | "), rows)


def far_starts(results: Results) -> str:
    """Return the table of policies and controllers that dock or rejoin from far away."""
    rows = []
    for row in results["rows"]:
        mode = row["evaluation"]["deterministic"]
        drawn = row["evaluation"].get("stochastic")  # a controller has none
        used = mode["control_usage_l1"]["mean"]
        successes = [
            rate for kind in (mode, drawn) if kind for rate in kind["success_rate"]["per_seed"]
        ]
        rows.append(
            (
                row["task"],
                row["start"],
                row["policy"],
                _interval(drawn["success_rate"], 100.0, 2) if drawn else "–",
                _interval(mode["success_rate"], 100.0, 2),
                f"{100.0 * min(successes):.1f}" if drawn else "–",
                f"{100.0 * mode['episode_safety_violation_rate']['mean']:.2g}",
                _interval(mode["average_return"], 1.0, 2),
                f"{mode['return_gap']['mean']:.2f}",
                "–" if used is None else f"{used:.1f}",
                f"{mode['episode_length']['mean']:,.0f}",
            )
        )
    heads = (
        "task | from | policy | success, stochastic [%] | deterministic | worst seed"
        " | violating steps [%] | return | below the bound by | Δv, L1 [m/s] | length [s]"
    )
    return markdown(heads.split(" | "), rows)


def controllers(results: Results) -> str:
    """Return the table of controllers and packaged policies without a filter, and of bounds."""
    rows = []
    unfiltered = [row for row in results["rows"] if row["rta"] == "none"]
    for task in dict.fromkeys(row["task"] for row in unfiltered):
        of_task = [row for row in unfiltered if row["task"] == task]
        for row in of_task:
            paper = TASKS[task].paper_steps if row["policy"] == "ppo" else None
            rows.append([task, *_flown(row, f"{row['training_steps']:,}")])
            rows[-1].insert(3, f"{paper:,}" if paper else "–")
        bound = results["bounds"][task]
        least = f"≥ {bound['delta_v']:.2f}" if "delta_v" in bound else "–"
        best = [f"≤ {bound['return']:.3f}", f"≥ {bound['length']:.0f}", least]
        rows.append([task, "*bound*", *["–"] * 4, *best])
    heads = ["task", "policy", "steps of training", "80 % after, paper's Table 2", "success"]
    heads.append("violating steps")
    return markdown([*heads, "return", "length [s]", "Δv [m/s]"], rows)


def possible(results: Results) -> str:
    """Return the table of bounds, the best flights found, and how far policies are from them."""
    rows = []
    for row in results["rows"]:
        bound = row["bound"]
        flown = [("*best found*", row["best"])]
        flown += [
            ("PPO, packaged" if policy["policy"] == "ppo" else f"`{policy['policy']}`", policy)
            for policy in row["policies"]
        ]
        rows.append([row["task"], "*bound*", *_against(bound, bound)])
        rows += [[row["task"], name, *_against(values, bound)] for name, values in flown]
    heads = ["task", "policy", "return", "below the bound", "length [s]", "above the bound"]
    return markdown([*heads, "Δv [m/s]", "above"], rows)


def _against(values: Mapping[str, float], bound: Mapping[str, float]) -> list[str]:
    """Return the cells of return, length and Δv, each followed by the gap to its bound."""
    cells = []
    for name, form, sign in (
        ("return", ".3f", -1.0),
        ("length", ".1f", 1.0),
        ("delta_v", ".3f", 1.0),
    ):
        if name not in bound or not math.isfinite(values[name]):
            cells += ["–", "–"]
            continue
        gap = sign * (values[name] - bound[name])
        cells += [f"{values[name]:{form}}", "" if values is bound else f"{gap:{form}}"]
    return cells


def controllers_filtered(results: Results) -> str:
    """Return the table of how the same policies fly with the default filter."""
    rows = [
        [row["task"], *_flown(row, f"{row['intervention_rate']:.1%}")]
        for row in results["rows"]
        if row["rta"] == "default"
    ]
    heads = ["with `rta=default`", "policy", "steps altered", "success", "violating steps"]
    return markdown([*heads, "return", "length [s]", "Δv [m/s]"], rows)


def _flown(row: Mapping[str, Any], second: str) -> list[str]:
    """Return the cells of a policy. `second` is the second of them."""
    usage = row["control_usage"]
    return [
        "PPO, packaged" if row["policy"] == "ppo" else f"`{row['policy']}`",
        second,
        f"{row['success_rate']:.1%}",
        f"{row['episode_safety_violation_rate']:.2%}",
        f"{row['average_return']:.3f}",
        f"{row['episode_length']:.0f}",
        "–" if usage is None else f"{usage:.2f}",
    ]


def ppo(results: Results) -> str:
    """Return the table of medians of thousand samples a second."""
    rates = _samples(results)
    cores = sorted({count for _, count in rates})
    heads = ["thousand samples/s", *(f"{count} core{'s' * (count > 1)}" for count in cores)]
    shown = [name for name in PPO if (name, 1) in rates]
    return markdown(
        heads,
        (
            [
                PPO[name],
                *(f"{rates[name, n] / 1e3:.0f}" if (name, n) in rates else "–" for n in cores),
            ]
            for name in shown
        ),
    )


def hot_spots(results: Results) -> str:
    """Return the table of the functions that the time of a step goes into."""
    rows = []
    for row in results["rows"]:
        whole = row["profiled_us"]
        shown = {name: us for name, us in row["spent_us"].items() if us >= 0.03 * whole}
        shown["the rest"] = whole - sum(shown.values())
        for name, value in shown.items():
            code = name if " " in name or "." not in name else f"`{name}`"
            rows.append((row["task"], code, f"{100.0 * value / whole:.0f}"))
    return markdown(["task", "function", "share of a step [%]"], rows)


def startup_parts(results: Results) -> str:
    """Return the table of the seconds of each part, without a cache."""
    rows = []
    for row in results["rows"]:
        name = f"gymnax {row['name']}" if row["rta"] == "gymnax" else row["name"]
        cells = [f"{value:.2g}" for value in row["seconds"]]
        filtered = f", `rta={row['rta']}`" if row["rta"] not in ("none", "gymnax") else ""
        rows.append([name + filtered, *cells, *["–"] * (len(results["columns"]) - len(cells))])
    return markdown(["s", *results["columns"]], rows)


def startup_first(results: Results) -> str:
    """Return the table of medians of the seconds to the first result."""
    return markdown(
        ["s", "cold", "warm"],
        (
            [
                "`jaxsafe train`, update"
                if row["name"] == "jaxsafe train"
                else row["name"].replace(" ", ", "),
                *(f"{statistics.median(row[kind]):.2g}" for kind in ("cold", "warm")),
            ]
            for row in results["first"]
        ),
    )


def startup_profile(results: Results) -> str:
    """Return the table of medians of the seconds of each part of the time to the first result."""
    rows = []
    for row in results["profiles"]:
        for kind in ("cold", "warm"):
            medians = [statistics.median(seconds[part] for seconds in row[kind]) for part in PARTS]
            cells = [f"{value:.2g}" if value else "–" for value in medians]
            rows.append([f"{row['name'].removeprefix('jaxsafe ')}, {kind}", *cells])
    return markdown(["s", *(part.replace("compile", "compile, or read") for part in PARTS)], rows)


def five_tasks(results: Results) -> str:
    """Return the table of medians of the seconds until all tasks are learnt.

    The last column has the success of the task that succeeds least, in the evaluation at the end.
    """
    labels = {
        "one command": "one command, `env=all`",
        "stopped": "with `stop_at_success=0.95`",
        "five commands": "five commands",
    }
    rows = []
    for way, label in labels.items():
        least = [min(run[way]["success"].values()) for run in results["runs"]]
        columns = [[run[way][name] for run in results["runs"]] for name in ("learnt", "whole")]
        rows.append(
            [
                label,
                *(
                    "never" if None in values else f"{statistics.median(values):.0f}"
                    for values in columns
                ),
                f"{100 * statistics.median(least):.1f} %",
            ]
        )
    return markdown(
        ["s", "all learnt after", "whole, with evaluations and figures", "success, worst task"],
        rows,
    )


def learning(results: Results) -> str:
    """Return the table of variants of PPO, with means and 95 % intervals."""
    rows = []
    for row in results["runs"]:
        sampled, modes = (row["evaluation"][kind] for kind in EVALUATION_KINDS)
        worst = min(sampled["success_rate"]["per_seed"] + modes["success_rate"]["per_seed"])
        first = row["variant"] not in VARIANTS
        rows.append(
            [
                f"{row['task']}, as it is" if first else VARIANTS[row["variant"]],
                _until(row["steps_to_80"]) + " steps" * first,
                _interval(sampled["success_rate"], 100.0, 2),
                f"{100 * modes['success_rate']['mean']:.2f}",
                f"{worst:.1%}".replace("%", " %"),
                _interval(modes["episode_length"], 1.0, 1),
            ]
        )
    return markdown(
        [
            "",
            "80 % in training after",
            "success, stochastic [%]",
            "deterministic",
            "worst seed",
            "length [s]",
        ],
        rows,
    )


def scaling(results: Results) -> str:
    """Return the table of medians on one core and on all."""
    rates = _rates(results)
    cores = max(count for _, count in rates)
    rows = []
    for name in dict.fromkeys(name for name, _ in rates):
        single = rates[name, 1]
        all_ = rates[name, cores]
        cells = [
            f"{rate / 1e6:.1f} million" if "environment" in name else f"{rate / 1e3:,.0f},000"
            for rate in (single, all_)
        ]
        rows.append([_scaled(name), *cells, f"{all_ / single:.2f}"])
    return markdown([f"{results['task']}, per second", "1 core", f"{cores} cores", "ratio"], rows)


def projection(results: Results) -> str:
    """Return the table of what a thousand devices would do."""
    return markdown(
        ["1,000 devices", "seeds", "million samples/s", "of a perfect split"],
        (
            [
                f"{row['shared']} per seed",
                f"{row['seeds']:,}",
                f"{row['samples_per_s'] / 1e6:.3g}",
                f"{100 * row['efficiency']:.0f} %",
            ]
            for row in results["projection"]
        ),
    )


def memory(results: Results) -> str:
    """Return the table of memory. Columns that name no other unit are in MiB."""
    sizes = sorted({row["num_envs"] for row in results["runs"]})
    rows = []
    for task in dict.fromkeys(row["task"] for row in results["runs"]):
        own = [row for row in results["runs"] if row["task"] == task]
        cells = [f"{row['predicted'] / 2**20:.0f} / {row['measured'] / 2**20:.0f}" for row in own]
        rows.append([task, f"{own[0]['lane']:,} B", f"{own[0]['seed'] / 1024:.0f} KiB", *cells])
    heads = ["predicted / measured", "an environment", "a seed without them"]
    return markdown([*heads, *(f"{size:,} × {results['num_steps']}" for size in sizes)], rows)


def adapters(results: Results) -> str:
    """Return the table of medians of thousand steps a second through each adapter."""
    runs = results["runs"]
    rows = []
    for name, label in ADAPTERS.items():
        rates = [run["steps_per_s"].get(name) for run in runs]
        if any(rates):
            rows.append([label, *("–" if rate is None else _three(rate / 1e3) for rate in rates)])
    return markdown(["environments", *(f"{run['envs']:,}" for run in runs)], rows)


def filter_calls(results: Results) -> str:
    """Return the table of filter calls a second."""
    rates = {(row["filter"], row["task"]): row["calls_per_s"] for row in results["calls"]["rows"]}
    order = [
        "discrete_asif",
        "explicit_simplex",
        "implicit_simplex",
        "implicit_asif",
        "explicit_asif",
        "robust",
        "released",
        *FILTERS,
    ]
    rows = []
    for name in order:
        cells = [_scale(rates[name, task]) if (name, task) in rates else "" for task in TASKS]
        if any(cells):
            rows.append([FILTERS.get(name, f"`{name}`"), *cells])
    return markdown(["filter", *TASKS], rows)


def filter_reserve(results: Results) -> str:
    """Return the table of what is gained by predicting the backup controller in reserve first."""
    rows = results["reserve"]["rows"]
    return markdown(
        ["calls/s of rejoin3d's filter, from starts", *(row["start"] for row in rows)],
        [
            ["the backup in reserve first", *(_scale(row["calls_per_s"]) for row in rows)],
            ["all backups at every step", *(_scale(row["all_calls_per_s"]) for row in rows)],
            ["time, all backups = 1", *(f"{row['ratio']:.2f}" for row in rows)],
        ],
    )


def filter_changes(results: Results) -> str:
    """Return the table of altered random actions, a row for each filter and kind of actions."""
    rows = results["change"]["rows"]
    tasks = [*dict.fromkeys(row["task"] for row in rows)]
    cells: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        cells.setdefault((row["filter"], row["actions"]), []).extend(
            [
                f"{row['violating_steps']:,}",
                f"{row['intervention_rate']:.1%}",
                f"{row['mean_correction']:.3f}",
            ]
        )
    heads = [head for task in tasks for head in (f"{task}: violating", "altered", "‖Δu‖")]
    return markdown(
        ["filter", "actions", *heads],
        (
            ["" if actions == "bang_bang" else f"`{name}`", actions.replace("_", "-"), *shown]
            for (name, actions), shown in cells.items()
        ),
    )


def programs(results: Results) -> str:
    """Return the table of the quadratic program."""
    rows = results["qp"]["rows"]
    return markdown(
        ["variables", *(str(row["variables"]) for row in rows)],
        [
            ["solutions/s", *(_scale(row["solutions_per_s"]) for row in rows)],
            [
                "error, 99 of 100",
                *(f"{row['error_99_percent']:.0e}".replace("e-0", "e-") for row in rows),
            ],
        ],
    )


def filter_cost(results: Results) -> str:
    """Return the table of an update of PPO with a filter, beside one without."""
    filters: dict[str, list[tuple[str, float]]] = {}
    for row in results["training"]["rows"]:
        filters.setdefault(row["task"], []).append((row["filter"], row["ratio"]))
    names = [", ".join(f"`{name}`" for name, _ in row) for row in filters.values()]
    ratios = [", ".join(f"{ratio:.2f}" for _, ratio in row) for row in filters.values()]
    return markdown(
        ["", *filters], [["filter", *names], ["wall time, without a filter = 1", *ratios]]
    )


def attacks(_: Results) -> str:
    """Return the table of what all adversaries together achieved against each task's filter."""
    rows = []
    for task in DOCKING_FIRST:
        results = read_json(RESULTS / "attacks" / f"{task}.json")
        policies = results["policies"]
        violating = [row["violating_steps"] + row["violating_steps_inside"] for row in policies]
        rows.append(
            [
                task,
                str(len(policies)),
                f"{sum(row['steps'] for row in policies):,}",
                f"{sum(violating):,}",
                f"{min(row['worst_margin_inside'] for row in policies):.2g}",
            ]
        )
    heads = "task | adversaries | steps | violating, at samples or inside steps | least h"
    return markdown(heads.split(" | "), rows)


def bounded_attacks(_: Results) -> str:
    """Return the table of what all adversaries together achieved against `robust`, by level."""
    rows = []
    for task in DOCKING_FIRST:
        files = [RESULTS / "attacks" / f"{task}_{part}.json" for part in ("within", "beyond")]
        flights = [row for file in files if file.exists() for row in read_json(file)["policies"]]
        for level in sorted({row["level"] for row in flights}):
            of_level = [row for row in flights if row["level"] == level]
            steps = sum(row["steps"] for row in of_level)
            violating = sum(
                max(row["violating_steps"], row["violating_steps_inside"]) for row in of_level
            )
            certified = sum(row["violating_certified_steps"] for row in of_level)
            worst = min(of_level, key=lambda row: row["worst_margin_inside"])
            rows.append(
                (
                    f"{task}, {level:g} × bound",
                    str(len(of_level)),
                    f"{steps:,}",
                    f"{violating:,}",
                    f"{certified:,}",
                    f"{worst['worst_margin_inside']:.2g}",
                    f"`{worst['policy']}`",
                )
            )
    heads = "task, uncertainty | adversaries | steps | violating | certified and violating"
    return markdown([*heads.split(" | "), "least h", "of"], rows)


def adversaries(_: Results) -> str:
    """Return the table of what each adversary achieved against each task's filter."""
    rows = []
    for task in DOCKING_FIRST:
        results = read_json(RESULTS / "attacks" / f"{task}.json")
        for row in results["policies"]:
            rows.append(
                [
                    task,
                    row["policy"],
                    *(
                        f"{row[name]:,}"
                        for name in ("steps", "violating_steps", "violating_steps_inside")
                    ),
                    f"{row['worst_margin_inside']:.2g}",
                    f"{row['intervention_rate']:.1%}",
                    f"{row['mean_correction']:.3g}",
                ]
            )
    heads = (
        "task | policy | steps | violating, at samples | inside | least h inside | altered"
        " | mean ‖Δu‖"
    )
    return markdown(heads.split(" | "), rows)


def filtered_training(_: Results) -> str:
    """Return the table of policies that were trained without a filter and with one.

    They act by their most probable actions. The numbers are from the records of the report.
    """
    labels = {
        "engineered_features": "no filter",
        "rta": "`rta=default`",
        "rta_no_punishment": "no punishment",
    }
    rows = []
    for task in DOCKING_FIRST:
        for kind, label in labels.items():
            record = _record(task, kind)
            own = record["results"]
            mode = own["evaluation"]["deterministic"]
            rows.append(
                [
                    task if kind == "engineered_features" else "",
                    label,
                    _until(own["interaction_efficiency"]["timesteps"]),
                    f"{own['training_cost']['mean']:,.0f}",
                    f"{100 * mode['success_rate']['mean']:.4g}",
                    f"{100 * mode['episode_safety_violation_rate']['mean']:.3g}",
                    f"{mode['episode_length']['mean']:.0f}",
                ]
            )
            if kind == "engineered_features":
                rows[-1] += ["–"] * 3
                continue
            alone = record["evaluations"][WITHOUT_RTA]["evaluation"]["deterministic"]
            rows[-1] += [
                f"{100 * mode['intervention_rate']['mean']:.3g}",
                f"{100 * alone['success_rate']['mean']:.4g}",
                f"{100 * alone['episode_safety_violation_rate']['mean']:.3g}",
            ]
    heads = (
        "task | option | 80 % in training after | violations in training | success [%]"
        " | violating steps [%] | length [steps] | steps altered [%] | alone: success [%]"
        " | alone: violating steps [%]"
    )
    return markdown(heads.split(" | "), rows)


def studied_training(_: Results) -> str:
    """Return the table of the ways of training, over the seeds of both tasks."""
    rows = [
        [*_way(of_task[0]), *_studied_tests(of_task)]
        for of_task in zip(*_studied_rows(), strict=True)
    ]
    return markdown(["trained with", "and", *STUDIED_TESTS], rows)


def studied_training_tests(_: Results) -> str:
    """Return the table of the tests of each way of training, by task."""
    rows = [
        [row["task"], *_way(row), *_studied_tests([row])]
        for rows in _studied_rows()
        for row in rows
    ]
    return markdown(["task", "trained with", "and", *STUDIED_TESTS], rows)


def studied_training_means(_: Results) -> str:
    """Return the table of how each way of training went and how its policies fly, by task."""
    rows = []
    for row in [row for rows in _studied_rows() for row in rows]:
        own, alone = row["tests"]["with"], row["tests"]["without"]
        rows.append(
            [
                row["task"],
                *_way(row),
                _until(row["steps_to_80"]["timesteps"]),
                f"{row['training_cost']['mean']:,.0f}",
                f"{100 * own['intervention_rate']['mean']:.3g}",
                f"{own['episode_length']['mean']:.0f}",
                f"{alone['episode_length']['mean']:.0f}",
            ]
        )
    heads = (
        "task | trained with | and | 80 % in training after | violations in training"
        " | steps altered [%] | length [s] | alone: length [s]"
    )
    return markdown(heads.split(" | "), rows)


STUDIED_TESTS = (
    "success [%]",
    "violating steps [%]",
    "alone: success [%]",
    "alone: violating steps [%]",
)
"""Columns of `_studied_tests`."""


def _studied_rows() -> list[list[Results]]:
    """Return the rows of the study of filters in training for each task, in the same order."""
    tasks = ("docking2d", "docking3d")
    return [read_json(STUDIES / f"training_with_rta_{task}.json")["rows"] for task in tasks]


def _way(row: Results) -> list[str]:
    """Return the filter and the treatment of a way of training."""
    return [f"`{row['filter']}`" if row["filter"] != "none" else "none", row["treatment"]]


def _studied_tests(rows: Sequence[Results]) -> list[str]:
    """Return interquartile means over the seeds of some rows, with and without the filter.

    The bootstrap of their intervals has a stratum for each row.
    """
    cells = []
    for tested in ("with", "without"):
        for metric in ("success_rate", "episode_safety_violation_rate"):
            score = stratified_iqm([row["tests"][tested][metric]["per_seed"] for row in rows])
            interval = [100 * bound for bound in score["ci95"]]
            cells.append(with_interval(100 * score["iqm"], interval, ".3g"))
    return cells


def studied_filters(_: Results) -> str:
    """Return the table of the published study of filters, with a row for each training and test.

    A cell has the result from random starts and, after a stroke, that from the ten test points. Δv
    is from the test points only.
    """
    rows = []
    for row in read_json(STUDIES / "published_docking.json")["rows"]:
        first = (
            row["configuration"],
            _until(row["steps_to_80"]["timesteps"]),
            f"{row['training_cost']['mean']:,.0f}",
        )
        for key in ("with", "without"):
            flown = (row["tests"][key], row["test_points"][key])
            cells = (
                ("success_rate", 100, ".4g"),
                ("episode_safety_violation_rate", 100, ".3g"),
                ("episode_length", 1, ",.0f"),
            )
            rows.append(
                (
                    *(first if key == "with" else ("", "", "")),
                    row["tested_with"] if key == "with" else "none",
                    *(
                        " / ".join(f"{unit * one[metric]['mean']:{form}}" for one in flown)
                        for metric, unit, form in cells
                    ),
                    f"{row['test_points'][key]['control_usage_l1']['mean']:.3g}",
                )
            )
    heads = (
        "trained with | 80 % in training after | violations in training | filter in the test"
        " | success [%] | violating steps [%] | length [s] | Δv, L1 [m/s]"
    )
    return markdown(heads.split(" | "), rows)


def readme_tasks(_: Results) -> str:
    """Return the table of the tasks, with their results from the records of the report.

    Success and violations after training are those of deterministic policies. Violating steps of
    training are counted for each seed.
    """
    rows = []
    for task, facts in FACTS.items():
        alone, filtered = (
            _record(task, kind)["results"] for kind in ("engineered_features", "rta")
        )
        after = [run["evaluation"]["deterministic"] for run in (alone, filtered)]
        rows.append(
            [
                f'[<img src="docs/baselines/{task}.gif" width="150" alt=""><br>{task}]'
                f"(docs/tasks/{task}.md)",
                facts.goal,
                facts.never,
                f"{facts.observation} / {facts.actions}",
                f"{_until(alone['interaction_efficiency']['timesteps'])}"
                f" ({TASKS[task].paper_steps:,})",
                f"{100 * after[0]['success_rate']['mean']:.1f} %",
                " → ".join(f"{run['training_cost']['mean']:,.0f}" for run in (alone, filtered)),
                " → ".join(_share(run["episode_safety_violation_rate"]) for run in after),
            ]
        )
    heads = (
        "task | goal | never | observation / actions | 80 % after (paper) | success"
        " | violating steps | afterwards"
    )
    return markdown(heads.split(" | "), rows)


def reported(_: Results) -> str:
    """Return the table of published and submitted results: the paper's, ours, and those of others.

    Raises:
        ConfigError: a submission cannot be read, lacks something, or has another name.
    """
    submitted: dict[str, list[list[str]]] = {task: [] for task in TASKS}
    for directory in sorted(path for path in SUBMITTED.glob("*") if path.is_dir()):
        task, submission = _submitted(directory)
        who = directory.name.removesuffix(f"-{task}")
        file = submission.file.relative_to(SUBMITTED.parent)
        submitted[task].append(_reported(who, submission, f"[{directory.name}]({file})"))
    rows = []
    for task in TASKS:
        rows.append([task, "the paper", "–", f"{TASKS[task].paper_steps:,}", "–", "–", "Table 2"])
        for kind, who in (("engineered_features", "jaxsafe, PPO"), ("rta", "jaxsafe, PPO, filter")):
            file = BASELINES / f"{task}-{kind}.json"
            link = f"[{file.stem}]({file.relative_to(BASELINES.parent)})"
            rows.append([task, *_reported(who, read_submission(str(file)), link)])
        rows += [[task, *cells] for cells in submitted[task]]
    heads = (
        "task | who | seeds | 80 % success after | success [%] | violating steps of the training"
        " | file"
    )
    return markdown(heads.split(" | "), rows)


def _submitted(directory: Path) -> tuple[str, Submission]:
    """Return the task and the results of `docs/submitted/NAME-TASK`.

    Raises:
        ConfigError: they cannot be read, lack something, or the directory has another name.
    """
    submission = read_submission(str(directory))
    task = submission.task
    if task not in TASKS or not directory.name.endswith(f"-{task}"):
        raise ConfigError(
            f"{directory}: expected a directory NAME-TASK with results of one of "
            f"{', '.join(TASKS)}, found those of {task}"
        )
    lacking = [finding.what for finding in findings(submission) if not finding.reported]
    if lacking:
        raise ConfigError(f"{directory}: lacks {', '.join(lacking)}; see jaxsafe check")
    return task, submission


def _reported(who: str, submission: Submission, link: str) -> list[str]:
    """Return the cells of a result after that of its task."""
    results = submission.results
    success = [
        results["evaluation"].get(kind, {}).get("success_rate", {}).get("mean")
        for kind in EVALUATION_KINDS
    ]
    efficiency = results.get("interaction_efficiency")
    return [
        who,
        "–" if submission.untrained else str(results["seeds"]),
        "–" if efficiency is None else _until(efficiency["timesteps"]),
        " / ".join(or_dash(rate and 100 * rate, ".2f") for rate in success),
        or_dash(submission.training_cost, ",.0f"),
        link,
    ]


def goals(_: Results) -> str:
    """Return the table of ratios that were aimed for, and of those that four results reach.

    The goals were set before any of the code was written. Bold ratios miss their goal.
    """
    names = ("environments", "ppo", "scaling", "startup")
    results = {name: read_json(RESULTS / f"{name}.json") for name in names}
    steps = _steps(results["environments"])
    samples = _samples(results["ppo"])
    scaled = _rates(results["scaling"])
    many = sorted({size for _, size in steps})[1:]
    all_ = max(count for _, count in samples)
    slow, fast = sorted(results["environments"]["released_steps_per_s"])
    first = {
        row["name"]: {kind: statistics.median(row[kind]) for kind in ("cold", "warm")}
        for row in results["startup"]["first"]
    }

    def pendulum(names: Iterable[str], goal: float, way: str = "") -> str:
        return _reached(
            [
                steps[name + way, size] / steps[PENDULUM + way, size]
                for name in names
                for size in many
            ],
            goal,
        )

    def released(names: Iterable[str], goal: float) -> str:
        there = PENDULUM_BESIDE_RELEASED / steps[PENDULUM, 4096]
        rates = [there * steps[name, size] for name in names for size in many]
        ratios = [[rate / figure for rate in rates] for figure in (fast, slow)]
        return "; ".join(_reached(values, goal) for values in ratios)

    def started(what: str, peer: str, kind: str, goal: float) -> str:
        return _reached([first[f"jaxsafe {what}"][kind] / first[peer][kind]], goal, most=True)

    single, ten = (
        {n: samples[name, n] for n in (1, all_)} for name in ("jaxsafe", "jaxsafe, ten seeds")
    )
    environment = next(name for name, _ in scaled if "environment" in name)
    cores = scaled[environment, max(count for _, count in scaled)] / scaled[environment, 1]
    outside = 1 - single[1] / samples["networks only", 1]
    rows = [
        (
            "docking3d / Pendulum-v1, environment steps, one core, 1,024 to 16,384",
            "≥ 3",
            "≥ 5",
            pendulum(["docking3d"], 3),
        ),
        ("the same, one action", "≥ 6", "≥ 10", pendulum(["docking3d"], 6, ":one_action")),
        ("every task / Pendulum-v1", "≥ 0.5", "≥ 1", pendulum(TASKS, 0.5)),
        (
            "docking3d / released code, its faster figure; its slower",
            "≥ 10,000",
            "≥ 30,000",
            released(["docking3d"], 10_000),
        ),
        ("every task / released code, the same", "≥ 2,000", "≥ 5,000", released(TASKS, 2_000)),
        ("environment steps, all cores / one", "≥ 1.6", "≥ 1.9", _reached([cores], 1.6)),
        (
            "PPO samples, jaxsafe / rejax, all cores",
            "≥ 1.5",
            "≥ 2.5",
            _reached([single[all_] / samples["rejax", all_]], 1.5),
        ),
        (
            "PPO, all cores / one, one seed",
            "≥ 1.3",
            "≥ 1.8",
            _reached([single[all_] / single[1]], 1.3),
        ),
        (
            "ten seeds on all cores / one on one, time",
            "≤ 6.5",
            "≤ 5.3",
            _reached([10 * single[1] / ten[all_]], 6.5, most=True),
        ),
        (
            "PPO outside networks and Adam, share of time",
            "≤ 0.15",
            "≤ 0.08",
            _reached([outside], 0.15, most=True),
        ),
        (
            "import and first step / gymnax, compiled before",
            "≤ 0.6",
            "≤ 0.4",
            started("step", "gymnax step", "warm", 0.6),
        ),
        (
            "import and first update / rejax, compiled before",
            "≤ 0.4",
            "≤ 0.25",
            started("update", "rejax update", "warm", 0.4),
        ),
        (
            "the same, nothing compiled before",
            "≤ 0.8",
            "≤ 0.55",
            started("update", "rejax update", "cold", 0.8),
        ),
        (
            "`jaxsafe train` to its first update / rejax, compiled before",
            "≤ 0.4",
            "≤ 0.25",
            started("train", "rejax update", "warm", 0.4),
        ),
        (
            "the same, nothing compiled before",
            "≤ 0.8",
            "≤ 0.55",
            started("train", "rejax update", "cold", 0.8),
        ),
    ]
    return markdown(["ratio", "goal", "more", "reached"], rows)


def accelerator_tables(results: Results) -> list[str]:
    """Return all tables of `accelerator.py` that have rows."""
    makers = {
        "numbers": accelerator_numbers,
        "environments": accelerator_environments,
        "ppo": accelerator_ppo,
        "learning": accelerator_learning,
        "filters": accelerator_filters,
    }
    return [
        make(results) for part, make in makers.items() if results["parts"].get(part, {}).get("rows")
    ]


def accelerator_numbers(results: Results) -> str:
    """Return the table of how many tests passed."""
    counts = next((row for row in results["parts"]["numbers"]["rows"] if "test" not in row), {})
    kinds = ("passed", "failed", "error", "skipped")
    cells = [str(counts.get(kind, 0)) for kind in kinds]
    return markdown(["tests of numbers on the accelerator", *kinds], [[results["device"], *cells]])


def accelerator_environments(results: Results) -> str:
    """Return the table of medians of million steps a second.

    Compile time and memory are those of the largest batch.
    """
    rows = results["parts"]["environments"]["rows"]
    sizes = sorted({row["environments"] for row in rows})
    rates = {(row["task"], row["environments"]): _three(row["steps_per_s"] / 1e6) for row in rows}
    lines = []
    for task in sorted({row["task"] for row in rows}, key=list(ENVIRONMENTS).index):
        largest = max(
            (row for row in rows if row["task"] == task), key=lambda row: row["environments"]
        )
        cells = [rates.get((task, size), "–") for size in sizes]
        lines.append([ENVIRONMENTS[task], *cells, *_program(largest)])
    heads = [
        "million steps/s on the accelerator at … environments",
        *(f"{size:,}" for size in sizes),
    ]
    return markdown([*heads, *PROGRAM], lines)


def accelerator_ppo(results: Results) -> str:
    """Return the table of medians of million samples a second.

    Compile time and memory are those of the first column.
    """
    rows = results["parts"]["ppo"]["rows"]
    columns = [*dict.fromkeys((row["environments"], row["seeds"]) for row in rows)]
    lines = []
    for peer in dict.fromkeys(row["peer"] for row in rows):
        of_peer = {(row["environments"], row["seeds"]): row for row in rows if row["peer"] == peer}
        cells = [
            _three(of_peer[column]["samples_per_s"] / 1e6) if column in of_peer else "–"
            for column in columns
        ]
        lines.append([peer, *cells, *_program(next(iter(of_peer.values())))])
    heads = [f"{seeds} seed{'s' * (seeds > 1)} × {size:,}" for size, seeds in columns]
    return markdown(
        ["million samples/s on the accelerator, seeds × environments", *heads, *PROGRAM], lines
    )


def accelerator_learning(results: Results) -> str:
    """Return the table of seconds until the average over seeds reached the level.

    It also has how many seeds were there by then.
    """
    lines = []
    for row in results["parts"]["learning"]["rows"]:
        reached = [seconds for seconds in row["each_seed"] if seconds is not None]
        lines.append(
            [
                row["task"],
                f"{row['seeds']} × {row['environments']:,}",
                f"{row['seconds']:.2g}" if row["reached"] else f"not in {row['seconds']:.0f}",
                f"{row['steps']:,}",
                f"{_three(row['samples_per_s'] / 1e6)}",
                f"{len(reached)}",
                *_program(row),
            ]
        )
    heads = [
        "95 % in training on the accelerator",
        "seeds × environments",
        "s",
        "steps per seed",
        "million samples/s",
    ]
    return markdown([*heads, "seeds at 95 % by then", *PROGRAM], lines)


def accelerator_filters(results: Results) -> str:
    """Return the table of medians of filter calls a second."""
    rows = results["parts"]["filters"]["rows"]
    lines = [
        [
            row["task"],
            f"`{row['filter']}`",
            *(_scale(rate) for rate in row["calls_per_s"].values()),
            *_program(row),
        ]
        for row in rows
    ]
    heads = [f"{int(batch):,} states" for batch in rows[0]["calls_per_s"]]
    return markdown(["filter calls/s on the accelerator", "filter", *heads, *PROGRAM], lines)


def accelerator_goals(results: Results) -> str:
    """Return the table of what was aimed for on one GPU and what is reached.

    Bold numbers miss their goal.
    """
    parts = {name: part["rows"] for name, part in results["parts"].items()}
    largest = max(row["environments"] for row in parts["environments"])
    rates = {
        row["task"]: row["steps_per_s"] / 1e6
        for row in parts["environments"]
        if row["environments"] == largest
    }
    samples = {
        (row["peer"], row["environments"], row["seeds"]): row["samples_per_s"]
        for row in parts["ppo"]
    }
    ratios = [
        rate / samples["rejax", *of] for (peer, *of), rate in samples.items() if peer == "jaxsafe"
    ]
    seconds = sum(row["seconds"] for row in parts["learning"])
    rows = [
        (
            f"every task, {largest:,} environments, million steps/s",
            "≥ 500",
            _reached([rates[task] for task in TASKS], 500.0),
        ),
        (
            f"docking3d, {largest:,} environments, million steps/s",
            "≥ 2,000",
            _reached([rates["docking3d"]], 2000.0),
        ),
        ("PPO samples, jaxsafe / rejax", "≥ 3", _reached(ratios, 3.0)),
        (
            "five tasks × ten seeds to 95 %, one after the other, s",
            "≤ 60",
            _reached([seconds], 60.0, most=True),
        ),
    ]
    return markdown(["goal on the accelerator", "aimed for", "reached"], rows)


PROGRAM = ("compile [s]", "memory [MiB]")
"""Columns of `_program`."""


def _program(row: Results) -> list[str]:
    """Return the seconds that a program took to compile, and its memory for intermediate results.

    Other programs compiled at the same time.
    """
    memory = row["temporary_bytes"]
    return [f"{row['compile_s']:.2g}", "–" if memory is None else f"{memory / 2**20:.0f}"]


PROOF_HEADS = ("result", "proved", "boxes bounded", "seconds", "check [s]")
"""The last columns of the tables of proofs."""


def _proof_cells(row: Results) -> list[str]:
    """Return the cells below `PROOF_HEADS`."""
    return [
        row["result"],
        f"{row['proved']:.1%}",
        f"{row['bounded']:,}",
        f"{row['seconds']:.1f}",
        "" if row["check_seconds"] is None else f"{row['check_seconds']:.1f}",
    ]


def verification(results: Results) -> str:
    """Return the table of what was proved from a box of starts, and how long it took."""

    def policy(row: Results) -> str:
        name = f"`{row['policy']}`" if row["policy"].startswith("pretrained/") else row["policy"]
        return name if row["mass"] == 12.0 else f"{name}, {row['mass']:g} kg"

    rows = (
        [
            policy(row),
            "{:g} to {:g}".format(*row["box"]["position"]),
            f"±{row['box']['velocity'][1]:g}",
            row.get("property", "safe"),
            str(row["steps"]),
            row["arithmetic"],
            *_proof_cells(row),
        ]
        for row in results["rows"].values()
        if row["box"].keys() == {"position", "velocity"}
    )
    heads = "policy | positions [m] | velocities [m/s] | property | steps | arithmetic"
    return markdown([*heads.split(" | "), *PROOF_HEADS], rows)


def verification_turning(results: Results) -> str:
    """Return the table of what was proved of craft that turn."""

    def widths(row: Results, aircraft: bool) -> str:
        units = {"position": "m", "velocity": "m/s", "attitude": "rad", "attitude_rate": "rad/s"}
        if aircraft:
            units = {"position": "ft", "heading": "rad", "speed": "ft/s"}
        texts = []
        for name, unit in units.items():
            ends = row["box"][name]
            low, high = ends[0] if isinstance(ends[0], list) else ends
            texts.append(f"{high - low:.3g} {unit}")
        return ", ".join(texts)

    lines = []
    for row in results["rows"].values():
        if row["box"].keys() != {"position", "velocity"}:
            aircraft = "heading" in row["box"]
            distance = math.hypot(*(0.5 * (low + high) for low, high in row["box"]["position"]))
            lines.append(
                [
                    f"`{row['policy']}`",
                    f"{distance:,.0f} {'ft' if aircraft else 'm'}",
                    widths(row, aircraft),
                    str(row["steps"]),
                    *_proof_cells(row),
                ]
            )
    heads = "policy | distance | widths of the box | steps"
    return markdown([*heads.split(" | "), *PROOF_HEADS], lines)


def verification_starts(results: Results) -> str:
    """Return the table of boxes around random starts, and for how long they keep the limit."""
    horizons = sorted(
        {int(horizon) for row in results["starts"].values() for horizon in row["safe"]}
    )
    rows = (
        [
            f"`{row['policy']}`",
            f"{row['widths'][0]:g} m, {row['widths'][1]:g} m/s",
            str(row["boxes"]),
            *(
                f"{row['safe'][str(horizon)]:.0%}" if str(horizon) in row["safe"] else ""
                for horizon in horizons
            ),
            f"{row['boxes_to_fill']:.1e}",
        ]
        for row in results["starts"].values()
    )
    heads = ["policy", "widths of the box", "boxes", *(f"{horizon} s" for horizon in horizons)]
    return markdown([*heads, "boxes that fill all starts"], rows)


def verification_tubes(results: Results) -> str:
    """Return the table of boxes that were bounded over many steps in one piece."""
    rows = (
        [
            f"{math.hypot(*row['centre'][:2]):.0f} m",
            f"{row['widths'][0]:g} m, {row['widths'][1]:g} m/s",
            f"{row['safe_steps']} of {row['steps']} s",
            "–" if row["docked_after"] is None else f"after {row['docked_after']} s",
        ]
        for rows in results["tubes"].values()
        for row in rows
    )
    heads = "distance | widths of the box | safe for | all docked"
    return markdown(heads.split(" | "), rows)


TABLES: Sequence[tuple[str, Callable[[Results], str], str]] = (
    ("", speed, "docs/performance.md"),
    ("environments", environments, "docs/performance.md"),
    ("dynamics", dynamics, "docs/dynamics.md"),
    ("ppo", ppo, "docs/performance.md"),
    ("startup", startup_parts, "docs/performance.md"),
    ("startup", startup_first, "docs/performance.md"),
    ("startup", startup_profile, "docs/performance_limits.md"),
    ("hot_spots", hot_spots, "docs/performance_limits.md"),
    ("five_tasks", five_tasks, "docs/performance.md"),
    ("learning", learning, "docs/performance.md"),
    ("", goals, "docs/performance_limits.md"),
    ("accelerator", accelerator_goals, "docs/performance_limits.md"),
    ("accelerator", accelerator_environments, "docs/performance.md"),
    ("accelerator", accelerator_ppo, "docs/performance.md"),
    ("accelerator", accelerator_learning, "docs/performance.md"),
    ("accelerator", accelerator_filters, "docs/performance.md"),
    ("accelerator", accelerator_numbers, "docs/performance.md"),
    ("scaling", scaling, "docs/scaling.md"),
    ("scaling", projection, "docs/scaling.md"),
    ("memory", memory, "docs/scaling.md"),
    ("robustness", robustness, "docs/safety/attacks.md"),
    ("verification", verification, "docs/verification.md"),
    ("verification", verification_turning, "docs/verification.md"),
    ("verification", verification_tubes, "docs/verification.md"),
    ("verification", verification_starts, "docs/verification.md"),
    ("uncertain_training", uncertain_training, "docs/safety/attacks.md"),
    ("datasets", datasets, "docs/dataset.md"),
    ("constraints", constraints, "docs/constrained.md"),
    ("far_starts", far_starts, "docs/far_starts.md"),
    ("controllers", controllers, "docs/controllers.md"),
    ("controllers", controllers_filtered, "docs/controllers.md"),
    ("possible", possible, "docs/possible.md"),
    ("adapters", adapters, "docs/adapters/gymnasium.md"),
    ("rta", filter_calls, "docs/safety/cost.md"),
    ("rta", filter_reserve, "docs/safety/cost.md"),
    ("rta", filter_changes, "docs/safety/cost.md"),
    ("rta", programs, "docs/safety/cost.md"),
    ("rta", filter_cost, "docs/safety/cost.md"),
    ("", attacks, "docs/safety/attacks.md"),
    ("", bounded_attacks, "docs/safety/attacks.md"),
    ("", adversaries, "docs/safety/attacks.md"),
    ("", filtered_training, "docs/safety/cost.md"),
    ("", studied_training, "docs/studies.md"),
    ("", studied_training_tests, "docs/studies.md"),
    ("", studied_training_means, "docs/studies.md"),
    ("", studied_filters, "docs/studies.md"),
    ("", readme_tasks, "README.md"),
    ("", reported, "docs/protocol.md"),
)
"""The file of results, the function that makes a table from it, and the page of the table.

A function without a file reads those that it needs.
"""


def pages() -> dict[Path, str]:
    """Return the text of each page, with its tables as they should be.

    Raises:
        ValueError: a page does not have exactly one table that begins like the one to put there.
    """
    text: dict[Path, str] = {}
    for file, make, name in TABLES:
        page = ROOT / name
        results = read_json(RESULTS / f"{file}.json") if file else {}
        table = make(results)
        head = table.partition("\n")[0]
        before = text.get(page) or page.read_text(encoding="utf-8")
        text[page], count = re.subn(
            rf"^{re.escape(head)}\n(?:\|.*\n)+", lambda _, new=table: f"{new}\n", before, flags=re.M
        )
        if count != 1:
            raise ValueError(f"{name}: found {count} tables that begin with {head}; expected one")
    return text


def main() -> None:
    """Write the pages that changed, and name them."""
    try:
        for page, text in pages().items():
            if text != page.read_text(encoding="utf-8"):
                write_text(page, text)
                print(page.relative_to(ROOT))
    except ValueError as error:
        sys.exit(str(error))


def _record(task: str, kind: str) -> Results:
    return read_json(BASELINES / f"{task}-{kind}.json")


def _steps(results: Results) -> dict[tuple[str, int], float]:
    return {(run["task"], run["num_envs"]): run["steps_per_s"] for run in results["runs"]}


def _samples(results: Results) -> dict[tuple[str, int], float]:
    return {
        (run["peer"], run["cores"]): statistics.median(run["samples_per_s"])
        for run in results["runs"]
    }


def _rates(results: Results) -> dict[tuple[str, int], float]:
    return {(run["what"], run["cores"]): statistics.median(run["per_s"]) for run in results["runs"]}


def _scaled(name: str) -> str:
    """Return what the page calls a row of `scaling.py`."""
    return (
        name
        if "environment" in name
        else f"PPO {name}{'' if 'each' in name else ' that both share'}"
    )


def _reached(values: Sequence[float], goal: float, most: bool = False) -> str:
    """Return the range of some ratios. An end that misses the goal is bold.

    Args:
        values: the ratios.
        goal: the smallest ratio that reaches it, or the largest one.
        most: whether the goal is the largest one.
    """

    def shown(value: float) -> str:
        digits = 0 if value >= 100 else 2 if value < 2 else 1
        while (round(value, digits) > goal, round(value, digits) < goal) != (
            value > goal,
            value < goal,
        ):
            digits += 1  # otherwise it would look as if it were on the other side
        text = f"{value:,.{digits}f}"
        return f"**{text}**" if (value > goal if most else value < goal) else text

    return " to ".join(shown(value) for value in sorted({min(values), max(values)}))


def _until(steps: int | None) -> str:
    return "never" if steps is None else f"{steps:,}"


def _interval(metric: Results, factor: float, digits: int) -> str:
    return mean_text(metric, f".{digits}f", factor)


def _share(metric: Results) -> str:
    return f"{100 * metric['mean']:.3g} %" if metric["mean"] else "0"


def _three(value: float) -> str:
    """Return a number with three digits, without an exponent."""
    return f"{value:.3g}" if value < 1000 else f"{float(f'{value:.3g}'):,.0f}"


def _scale(rate: float) -> str:
    """Return calls a second in millions or thousands, with two or three digits."""
    scaled, unit = (rate / 1e6, "M") if rate >= 1e6 else (rate / 1e3, "k")
    return (
        f"{scaled:.{2 if scaled < 100 else 3}g} {unit}" if unit == "M" else f"{scaled:.3g} {unit}"
    )


if __name__ == "__main__":
    main()
