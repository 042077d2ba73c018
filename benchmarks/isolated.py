"""Measurements in processes of their own, and the words of the commands.

A process is pinned to chosen cores. Peers whose versions exclude each other have a Python each.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
CACHE = (
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
)
"""Variables that decide whether JAX keeps compiled programs, and from which time and size on."""

PEERS = {
    "gymnax": ["gymnax", "six"],
    "brax": ["brax"],
    "envpool": ["envpool"],
    "rejax": ["rejax", "gymnax==0.0.9", "six", "--pre", "tfp-nightly"],
    "sb3": ["stable-baselines3"],
}
"""Packages that pip installs for each peer beside jaxsafe, which brings Gymnasium itself.

Gymnax imports six without asking for it.
"""


def words(**defaults: str) -> dict[str, str]:
    """Return the options of the command, which are words `name=value`, over their defaults.

    A name that has no default ends the command with one line. Only `probe`, which asks for a single
    measurement, needs no default.
    """
    given = {name: value for name, _, value in (word.partition("=") for word in sys.argv[1:])}
    for name in given:
        if name not in {*defaults, "probe"}:
            sys.exit(f"{name}: unknown option; choose from {', '.join(defaults)}")
    return {**defaults, **given}


def several(option: str, value: str, known: Iterable[str]) -> list[str]:
    """Return the names in a list with commas. An unknown name ends the command with one line."""
    names = [name for name in value.split(",") if name]
    choices = list(known)
    for name in names:
        if name not in choices:
            sys.exit(f"{option}: found {name!r}; choose from {', '.join(choices)}")
    return names


def command(name: str, *options: str) -> None:
    """Run a command of jaxsafe, which stops this program if it fails."""
    subprocess.run([sys.executable, "-m", f"jaxsafe.{name}", *options], check=True)


def interpreter(name: str) -> str:
    """Return the path of a Python that has a peer beside jaxsafe.

    It is built in `benchmarks/peers` the first time. For a name that is no peer, return the path of
    this Python.
    """
    if name not in PEERS:
        return sys.executable
    place = HERE / "peers" / name
    python = place / "bin" / "python"
    if not python.exists():
        try:
            subprocess.run([sys.executable, "-m", "venv", place], check=True)
            subprocess.run(
                [python, "-m", "pip", "install", "-q", "-e", HERE.parent, *PEERS[name]], check=True
            )
        except BaseException:
            shutil.rmtree(place, ignore_errors=True)  # the next run builds it again
            raise
    return str(python)


def versions(names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the versions of packages in each peer's environment.

    The packages are those that pip installed for the peer, and those that it computes with.
    """
    ask = "import json, sys; from importlib.metadata import distributions as all; "
    ask += (
        "print(json.dumps({package.name.lower(): package.version for package in all()"
        " if package.name.lower() in sys.argv[1:]}))"
    )
    versions_of = {}
    for name in sorted(set(names) & set(PEERS)):
        wanted = [re.split("[=<>]", word)[0] for word in PEERS[name] if not word.startswith("-")]
        command = [
            interpreter(name),
            "-c",
            ask,
            *wanted,
            "jax",
            "jaxlib",
            "numpy",
            "gymnasium",
            "torch",
        ]
        versions_of[name] = json.loads(
            subprocess.run(command, capture_output=True, text=True, check=True).stdout
        )
    return versions_of


def variables(cache: Path | None = None) -> dict[str, str]:
    """Return the environment variables of a process.

    Python keeps its bytecode, as it does for packages that pip has installed.

    Args:
        cache: a directory that keeps every program that JAX compiles, however small. Without it
            nothing is kept.
    """
    without = (*CACHE, "PYTHONDONTWRITEBYTECODE")
    given = {key: value for key, value in os.environ.items() if key not in without}
    kept = dict(zip(CACHE, (str(cache), "0", "-1"), strict=True)) if cache else {}
    return {**given, **kept}


def probe(
    script: str,
    request: Sequence[str],
    cores: int | None = None,
    python: str = sys.executable,
    cache: Path | None = None,
) -> Any:
    """Run a script in a process of its own. Return the last line that it prints, read as JSON.

    Args:
        script: the path of the script.
        request: its words.
        cores: the number of cores that it is pinned to. None stands for all.
        python: the path of Python.
        cache: the cache of `variables`.
    """
    command = [python, script, *request]
    environment = variables(cache)
    before = os.sched_getaffinity(0)
    # A child inherits the cores of the thread that starts it.
    os.sched_setaffinity(0, sorted(before)[:cores])
    try:
        run = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    finally:
        os.sched_setaffinity(0, before)
    if run.returncode:
        sys.exit(f"{' '.join(request)}: {run.stderr[-2000:]}")
    return json.loads(run.stdout.splitlines()[-1])
