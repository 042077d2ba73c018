"""Measure everything on one machine, or say which results are stale.

    python benchmarks/all.py [names=environments,ppo,…] [measure=true] [published=FILE]

Each script of this directory writes its own file in `benchmarks/results`, and each attack one in
`benchmarks/results/attacks`. A result is current if it was measured on this processor with these
versions, and its fingerprint of the sources is that of today's. What is current is not measured
again, so a command that was stopped goes on where it was. The rows of the verification benchmark
that need the published network are measured if `published` names it.

Results of different machines are not mixed: with `names`, all others must be current. An
accelerator has a script of its own.

With `measure=false` nothing is measured. The table says what is stale and why, and the exit code is
1 if anything is.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from attacks import ATTACKS
from isolated import several, words
from machine import about

from jaxsafe.storage.files import read_json

RESULTS = Path(__file__).parent / "results"

SCRIPTS: dict[str, tuple[str, ...]] = {
    "environments": ("repeats=3",),
    "dynamics": (),
    "hot_spots": ("names=rejoin3d,docking3d,docking2d", "repeats=5"),
    "ppo": ("repeats=2",),
    "startup": ("rta=none", "repeats=2"),
    "adapters": ("repeats=3",),
    "scaling": ("repeats=2",),
    "memory": (),
    "five_tasks": ("repeats=1",),
    "learning": (),
    "controllers": (),
    "possible": (),
    "datasets": (),
    "robustness": ("episodes=100",),
    "uncertain_training": (),
    "constraints": (),
    "far_starts": (),
    "verification": (),
    "rta": (),
    **{f"attacks/{name}": (f"names={name}",) for name in ATTACKS},
}
"""The options of each script by the name of its result, in the order in which they run."""

SAME = ("processor", "cores", "python", "jax", "jaxlib", "sources")
"""What must be as it is here for a result to be current."""


def main() -> int:
    """Run the command and return the exit code."""
    options = words(names="", measure="true", published="")
    names = several("names", options["names"], SCRIPTS) or list(SCRIPTS)
    if options["measure"] not in ("true", "false"):
        sys.exit(f"measure: found {options['measure']!r}; choose from true, false")
    if options["published"] and not Path(options["published"]).is_file():
        sys.exit(f"published: no file {options['published']!r}")
    stale = {name: why for name in SCRIPTS if (why := reason(name))}
    if options["measure"] == "false":
        print("\n".join(f"{name:34s}{stale.get(name, 'current')}" for name in SCRIPTS))
        return 1 if stale else 0
    if about(__file__)["changed"]:
        sys.exit("all.py: the code differs from its commit; commit it first")
    if others := [name for name in stale if name not in names]:
        first = others[0]
        sys.exit(f"names: {first} is stale too ({stale[first]}); leave names out to measure all")
    published = [f"published={options['published']}"] if options["published"] else []
    for name in names:
        if name in stale:
            given = [*SCRIPTS[name], *published * (name == "verification")]
            script = script_of(name)
            print(f"$ python benchmarks/{script.name} {' '.join(given)}".strip(), flush=True)
            if code := subprocess.run([sys.executable, script, *given], check=False).returncode:
                return code
    return 0


def script_of(name: str) -> Path:
    """Return the path of the script that makes a result.

    Args:
        name: the name of the result.
    """
    return Path(__file__).with_name(f"{name.partition('/')[0]}.py")


def reason(name: str) -> str | None:
    """Return why a result is not current, or None if it is.

    Args:
        name: the name of the result.
    """
    path = RESULTS / f"{name}.json"
    if not path.exists():
        return "not measured"
    here = about(str(script_of(name)))
    found = list(_measurements(read_json(path)))
    if not found:
        return "nothing says where it was measured"
    for entry in found:
        for key in SAME:
            if entry.get(key) != here[key]:
                return f"{key}: {entry.get(key, 'not known')}, here {here[key]}"
    return None


def _measurements(content: Any) -> Iterator[dict[str, Any]]:
    """Yield what the parts of a result say about where they were measured."""
    if isinstance(content, dict):
        if "sources" in content:
            yield content
        for value in content.values():
            yield from _measurements(value)
    elif isinstance(content, list):
        for value in content:
            yield from _measurements(value)


if __name__ == "__main__":
    sys.exit(main())
