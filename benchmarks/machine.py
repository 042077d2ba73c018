"""What every result says about where it was measured."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from fingerprint import fingerprint

from jaxsafe.devices.seed_mapper import usable_cores
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


def _git(*words: str) -> str:
    command = ["git", "-C", str(Path(__file__).resolve().parent.parent), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
