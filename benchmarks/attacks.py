"""Let all adversaries attack the filters, for the tables of docs/safety/attacks.md.

Each attack is one `jaxsafe falsify`, with the options that `ATTACKS` gives it. Results are written
to `benchmarks/results/attacks`, a file for each attack:

    python benchmarks/attacks.py [names=docking2d,…]
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from isolated import several, words

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "benchmarks" / "results" / "attacks"

TASKS = ("docking2d", "docking3d", "docking2d_oriented", "rejoin2d", "rejoin3d")
DEFAULT = ("num_envs=256", "steps=1000000")
ROBUST = ("rta=robust", "starts=edges", "num_envs=512")
WITHIN = (*ROBUST, "levels=1", "steps=1000000")
BEYOND = (*ROBUST, "levels=0.5,1.5,2", "steps=102400")
RAMMING = (
    "steps=6200000",
    "num_envs=4096",
    "policies=intercept",
    "env.terminal.timeout.limit=60",
    "env.wingman.start.position.distance=2000,5000",
)

ATTACKS: dict[str, tuple[str, ...]] = {
    **{task: (f"env={task}", *DEFAULT) for task in TASKS},
    **{f"{task}_within": (f"env={task}", *WITHIN) for task in TASKS},
    **{
        f"{task}_beyond": (f"env={task}", *BEYOND)
        for task in ("docking2d", "docking3d", "rejoin2d")
    },
    **{f"{task}_ramming": (f"env={task}", *RAMMING) for task in ("rejoin2d", "rejoin3d")},
    "inspection": ("env=examples/inspection.yaml", "num_envs=256", "steps=91000"),
}
"""The options of each attack, by its name."""


def attack(name: str) -> None:
    """Carry out an attack and write its results, with what they depend on.

    A violation ends the command, and the results then do not say what they depend on.

    Args:
        name: the name of the attack.
    """
    from machine import about

    from jaxsafe.storage.files import read_json, write_json

    here = about(__file__)
    path = OUT / f"{name}.json"
    # Paths are relative, because the results have the command.
    options = (*ATTACKS[name], f"out={path.relative_to(ROOT)}")
    command = [sys.executable, "-m", "jaxsafe.rta.falsify", *options]
    if code := subprocess.run(command, check=False, cwd=ROOT).returncode:
        sys.exit(code)
    write_json(path, {**read_json(path), **here})


def main() -> None:
    """Run the command."""
    options = words(names="")
    OUT.mkdir(exist_ok=True)
    for name in several("names", options["names"], ATTACKS) or ATTACKS:
        attack(name)


if __name__ == "__main__":
    main()
