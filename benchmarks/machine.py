"""What every result says about where it was measured."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from fingerprint import fingerprint

from jaxsafe.devices.seed_mapper import usable_cores
from jaxsafe.storage.files import read_json
from jaxsafe.storage.provenance import processor


def about(script: str) -> dict[str, Any]:
    """Return commit, sources, versions, device and the number of cores that may be used.

    Call this before measuring, so that the commit is the one whose code is measured.

    Args:
        script: the path of the script that measures. `sources` is its `fingerprint`.
    """
    return {
        "commit": _git("rev-parse", "HEAD"),
        "changed": bool(
            _git("status", "--porcelain", "--", "jaxsafe", "benchmarks/*.py", "configs")
        ),
        "sources": fingerprint(Path(script)),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": version("jaxlib"),
        "device": jax.devices()[0].device_kind,
        "processor": processor(),
        "cores": usable_cores(),
    }


def with_kept(out: Path, results: dict[str, Any], same: Sequence[str]) -> dict[str, Any]:
    """Return results with the rows of an earlier file that were not measured again.

    As long as there are such rows, the results go on saying where those were measured, so that they
    stay stale. Each new row then has its own command, commit and processor.

    Args:
        out: the path of the earlier file, which may be missing.
        results: the new results: `command`, what `about` returns, and `rows`.
        same: the keys by which rows are the same measurement.
    """

    def name(row: dict[str, Any]) -> tuple[Any, ...]:
        return tuple(row[key] for key in same)

    earlier = read_json(out) if out.exists() else {"rows": []}
    new = {name(row): row for row in results["rows"]}
    if all(name(row) in new for row in earlier["rows"]):
        return results
    own = {key: results[key] for key in ("command", "commit", "processor")}
    new = {key: {**row, **own} for key, row in new.items()}
    rows = {**{name(row): row for row in earlier["rows"]}, **new}
    return {**earlier, "rows": list(rows.values())}


def _git(*words: str) -> str:
    command = ["git", "-C", str(Path(__file__).resolve().parent.parent), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
