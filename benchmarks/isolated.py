"""Measurements in processes of their own: on chosen cores, and with peers whose versions exclude each other."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def interpreter(name: str, packages: Sequence[str]) -> str:
    """Python with a peer beside jaxsafe, in `benchmarks/peers`; built the first time."""
    place = HERE / "peers" / name
    python = place / "bin" / "python"
    if not python.exists():
        try:
            subprocess.run([sys.executable, "-m", "venv", place], check=True)
            subprocess.run([python, "-m", "pip", "install", "-q", "-e", HERE.parent, *packages], check=True)
        except BaseException:
            shutil.rmtree(place, ignore_errors=True)  # the next run builds it again
            raise
    return str(python)


def probe(script: str, words: Sequence[str], cores: int | None = None, python: str = sys.executable) -> Any:
    """What a script prints last, as JSON, when it runs with these words pinned to some cores, or on all."""
    usable = sorted(os.sched_getaffinity(0))[:cores]
    command = [python, script, *words]
    ran = subprocess.run(command, capture_output=True, text=True, preexec_fn=lambda: os.sched_setaffinity(0, usable))
    if ran.returncode:
        sys.exit(f"{' '.join(words)}: {ran.stderr[-2000:]}")
    return json.loads(ran.stdout.splitlines()[-1])
