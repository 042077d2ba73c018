"""Measurements in processes of their own: on chosen cores, and with peers whose versions exclude each other."""

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
"""Variables that say whether JAX keeps compiled programs, and from which time and size on."""


PEERS = {
    "gymnax": ["gymnax", "six"],
    "brax": ["brax"],
    "envpool": ["envpool"],
    "rejax": ["rejax", "gymnax==0.0.9", "six", "--pre", "tfp-nightly"],
    "sb3": ["stable-baselines3"],
}
"""What pip installs for each beside jaxsafe, which brings Gymnasium itself; gymnax imports six without asking for it."""


def words(**defaults: str) -> dict[str, str]:
    """What the command says, `name=value`, over its defaults; a name that has none ends it with one line.

    `probe` asks for a single measurement.
    """
    given = {name: value for name, _, value in (word.partition("=") for word in sys.argv[1:])}
    for name in given:
        if name not in {*defaults, "probe"}:
            sys.exit(f"{name}: unknown option; choose from {', '.join(defaults)}")
    return {**defaults, **given}


def several(option: str, value: str, known: Iterable[str]) -> list[str]:
    """The names in a list with commas; one that is not known ends the command with one line."""
    names = [name for name in value.split(",") if name]
    allowed = list(known)
    for name in names:
        if name not in allowed:
            sys.exit(f"{option}: found {name!r}; choose from {', '.join(allowed)}")
    return names


def interpreter(name: str) -> str:
    """Python with a peer beside jaxsafe, in `benchmarks/peers`, built the first time; this Python for what is no peer."""
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
    """Of each peer's environment: what pip installed there for it, and what that computes with."""
    ask = "import json, sys; from importlib.metadata import distributions as all; "
    ask += (
        "print(json.dumps({one.name.lower(): one.version for one in all() if"
        " one.name.lower() in sys.argv[1:]}))"
    )
    found = {}
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
        found[name] = json.loads(
            subprocess.run(command, capture_output=True, text=True, check=True).stdout
        )
    return found


def probe(
    script: str,
    request: Sequence[str],
    cores: int | None = None,
    python: str = sys.executable,
    cache: Path | None = None,
) -> Any:
    """What a script prints last, as JSON, when it runs with such words pinned to some cores, or on all.

    `cache` keeps what JAX compiles, however small; without it nothing is kept.
    """
    command = [python, script, *request]
    environment = {key: value for key, value in os.environ.items() if key not in CACHE}
    if cache:
        environment |= dict(zip(CACHE, (str(cache), "0", "-1"), strict=True))
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(
        0, sorted(before)[:cores]
    )  # a child has that of the thread which starts it
    try:
        ran = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    finally:
        os.sched_setaffinity(0, before)
    if ran.returncode:
        sys.exit(f"{' '.join(request)}: {ran.stderr[-2000:]}")
    return json.loads(ran.stdout.splitlines()[-1])
