"""Measurements in processes of their own.

They run on chosen cores, and with peers whose versions exclude each other.
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
    """Return the options of the command, `name=value`, over their defaults.

    A name that has no default ends the command with one line. `probe` asks for a single
    measurement.
    """
    given = {name: value for name, _, value in (word.partition("=") for word in sys.argv[1:])}
    for name in given:
        if name not in {*defaults, "probe"}:
            sys.exit(f"{name}: unknown option; choose from {', '.join(defaults)}")
    return {**defaults, **given}


def several(option: str, value: str, known: Iterable[str]) -> list[str]:
    """Return the names in a list with commas. An unknown name ends the command with one line."""
    names = [name for name in value.split(",") if name]
    allowed = list(known)
    for name in names:
        if name not in allowed:
            sys.exit(f"{option}: found {name!r}; choose from {', '.join(allowed)}")
    return names


def interpreter(name: str) -> str:
    """Return Python with a peer beside jaxsafe. It is built in `benchmarks/peers` the first time.

    For what is no peer, it is this Python.
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
    """Return the versions in each peer's environment.

    They are those of what pip installed for it, and of what that computes with.
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


def probe(
    script: str,
    request: Sequence[str],
    cores: int | None = None,
    python: str = sys.executable,
    cache: Path | None = None,
) -> Any:
    """Run a script pinned to some cores, or on all. Return what it prints last, as JSON.

    `request` are its words. `cache` keeps what JAX compiles, however small. Without it nothing is
    kept.
    """
    command = [python, script, *request]
    environment = {key: value for key, value in os.environ.items() if key not in CACHE}
    if cache:
        environment |= dict(zip(CACHE, (str(cache), "0", "-1"), strict=True))
    before = os.sched_getaffinity(0)
    # A child inherits the cores of the thread that starts it.
    os.sched_setaffinity(0, sorted(before)[:cores])
    try:
        ran = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    finally:
        os.sched_setaffinity(0, before)
    if ran.returncode:
        sys.exit(f"{' '.join(request)}: {ran.stderr[-2000:]}")
    return json.loads(ran.stdout.splitlines()[-1])
