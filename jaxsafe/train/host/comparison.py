"""The results of several runs in one table, as CSV and as LaTeX."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxsafe.evaluate.evaluator import EVALUATION_KINDS
from jaxsafe.train.host.results import mean_text

METRICS = (
    "success_rate",
    "average_return",
    "episode_length",
    "control_usage",
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "episode_cost",
    "intervention_rate",
)
"""The metrics in the CSV file, of each kind of evaluation."""

SPECIAL = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "&%$#_{}"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
    }
)
"""Replacements of the characters that have a meaning in LaTeX."""


def csv_rows(runs: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each run: what it is, and means with the bounds of their 95 % intervals.

    Args:
        runs: the results of each run by its label.
    """
    return [
        {
            "run": label,
            **{name: results.get(name) for name in ("env", "algorithm", "preset", "rta")},
            "seeds": results["seeds"],
            "steps": results["steps"],
            "steps_to_80_percent": results["interaction_efficiency"]["timesteps"],
            **_columns("training_cost", results["training_cost"]),
            **{
                name: value
                for kind, metrics in results["evaluation"].items()
                for metric in METRICS
                for name, value in _columns(f"{kind}/{metric}", metrics[metric]).items()
            },
        }
        for label, results in runs.items()
    ]


def latex(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a LaTeX table with 95 % intervals. It needs the package booktabs.

    Args:
        runs: the results of each run by its label.
    """
    heads = (
        "Run",
        r"Success [\%]",
        r"deterministic [\%]",
        r"Violating steps [\%]",
        r"deterministic [\%]",
        "Violating steps in training",
        r"Steps to 80\,\%",
    )
    rows = []
    for label, results in runs.items():
        drawn, mode = (results["evaluation"][kind] for kind in EVALUATION_KINDS)
        reached = results["interaction_efficiency"]["timesteps"]
        rows.append(
            (
                label.translate(SPECIAL),
                *(_cell(kind["success_rate"], 100.0, ".2f") for kind in (drawn, mode)),
                *(
                    _cell(kind["episode_safety_violation_rate"], 100.0, ".2f")
                    for kind in (drawn, mode)
                ),
                _cell(results["training_cost"], 1.0, ",.0f"),
                f"{reached:,}" if reached else "never",
            )
        )
    lines = [" & ".join(row) + r" \\" for row in rows]
    columns = "l" + "r" * (len(heads) - 1)
    return "\n".join(
        [
            r"% needs \usepackage{booktabs}",
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            " & ".join(heads) + r" \\",
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _columns(name: str, metric: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the mean of a metric and the bounds of its interval, by column."""
    low, high = metric["ci95"] or (None, None)
    return {f"{name}/mean": metric["mean"], f"{name}/low": low, f"{name}/high": high}


def _cell(metric: Mapping[str, Any], factor: float, form: str) -> str:
    return "--" if metric["mean"] is None else mean_text(metric, form, factor)
