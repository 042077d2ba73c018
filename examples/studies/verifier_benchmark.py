"""Write closed-loop docking as a benchmark for verifiers of neural networks.

For each docking task of the paper and each horizon there is an instance: the closed loop of the
policy that comes with the package as an ONNX graph, and its safety as a VNN-LIB property. The
directory has the form of the competition VNN-COMP: `onnx/`, `vnnlib/`, `instances.csv` with a
graph, a property and a time limit on each line, and a `README.md` with the properties in words.

    python examples/studies/verifier_benchmark.py out=docking_benchmark
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from jaxsafe.commands import cli, export
from jaxsafe.commands.options import CommandOptions, Count, Directory, Option
from jaxsafe.schema.component import Range
from jaxsafe.storage.files import write_text

BOXES = {
    "docking2d": {"position": (70, 106), "velocity": (-0.28, 0.28)},
    "docking3d": {"position": (70, 106), "velocity": (-0.25, 0.25)},
    "docking2d_oriented": {
        "position": (70, 106),
        "velocity": (-0.28, 0.28),
        "attitude": (-3.1415927, 3.1415927),
    },
}
"""The starts by task. All of them keep the speed limit: at 70 m along each axis it is at least
0.40 m/s in the plane and 0.44 m/s in space."""

UNITS = {"position": "m", "velocity": "m/s", "attitude": "rad"}

WORDS = """# Docking under a speed limit

A deputy spacecraft of 12 kg flies to a chief on a circular orbit, n = 0.001027 1/s. A neural
network controls its thrust, which is held for 1 s. In Hill's frame the chief is at the origin.

- **X** is the state at the start: position [m] and velocity [m/s] along each axis, and in
  docking2d_oriented the attitude [rad]. There the attitude rate is 0 at the start.
- **Y_t** is the margin of the speed limit after t seconds: 0.2 m/s + 2n‖r‖ − ‖v‖.
- **The question** is whether some Y_0, …, Y_N is 0 or less for some X in the box. `unsat` proves
  that the deputy keeps the limit at every whole second up to N. `sat` is a start from which it does
  not.

A graph has no loop. It repeats the step of the environment: the observation, the network, the
limits of the thrust, and the exact motion over 1 s. The questions are about real numbers at whole
seconds.

| instance | starts |
|---|---|
{rows}
"""


class Options(CommandOptions):
    """The options of this study."""

    program = "python examples/studies/verifier_benchmark.py"

    tasks: Annotated[tuple[str, ...], Option(names=tuple(BOXES))] = tuple(BOXES)
    """The tasks, with commas between them."""
    horizons: Annotated[
        tuple[float, ...], Range(1.0, 2000.0), Option(takes="numbers of steps from 1 to 2,000")
    ] = (10, 40)
    """Numbers of steps, with commas between them."""
    timeout: Count = 1000
    """Time limit of each instance [s]."""
    out: Directory = "docking_benchmark"
    """The directory to write."""


def instance(task: str, steps: int, out: Path) -> tuple[str, str]:
    """Write the graph and the property of an instance, and return their paths within `out`."""
    name = f"{task}_{steps}"
    graph, question = f"onnx/{name}.onnx", f"vnnlib/{name}.vnnlib"
    boxes = [f"box.{field}={low},{high}" for field, (low, high) in BOXES[task].items()]
    written = out / f"{name}.vnnlib"
    export.main(
        [f"run=pretrained/{task}", "format=vnnlib", f"steps={steps}", *boxes, f"out={written}"]
    )
    for path in (graph, question):
        (out / path).parent.mkdir(exist_ok=True)
    written.with_suffix(".onnx").replace(out / graph)
    written.replace(out / question)
    return graph, question


def main(argv: Sequence[str]) -> int:
    """Write the benchmark and return the exit code."""
    options = Options.parse(argv)
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    files = []
    rows = []
    for task in options.tasks:
        for steps in map(int, options.horizons):
            files.append((*instance(task, steps, out), options.timeout))
            starts = ", ".join(
                f"{field} in [{low}, {high}] {UNITS[field]}"
                for field, (low, high) in BOXES[task].items()
            )
            rows.append(f"| {task}, N = {steps} | {starts} |")
    with (out / "instances.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(files)
    write_text(out / "README.md", WORDS.format(rows="\n".join(rows)))
    return 0


if __name__ == "__main__":
    cli.run(main, Options, cli.at_once, alone=True)
