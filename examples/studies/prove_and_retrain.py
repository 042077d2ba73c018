"""Train a small policy, prove it, and train it again where there is no proof.

The first training is short, so its policy breaks the speed limit from some starts of a box. The
certificate of `jaxsafe verify` says from which boxes it does, and where that is open. Each further
training goes on from the policy before, with every second start in such a box. The program ends
when the policy is proved.

    python examples/studies/prove_and_retrain.py out=runs/prove_and_retrain

Policies, certificates and a table of the results, `results.json`, are kept in `out`. What is there
already is not done again.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any

from jaxsafe.commands import cli
from jaxsafe.commands.options import CommandOptions, Count, Directory, Option, Seed
from jaxsafe.commands.verify import EXIT_CODES
from jaxsafe.storage import provenance
from jaxsafe.storage.files import write_json
from jaxsafe.verify.certificate import load_certificate

RECIPE = "preset=observation_only"
"""The recipe of all trainings, which has no engineered features."""

NETWORK = "agent.actor.hidden=[16,16]"
"""A network that is small enough to be proved in seconds."""


class Options(CommandOptions):
    """The options of this study."""

    program = "python examples/studies/prove_and_retrain.py"

    first_steps: Count = 300_000
    """Number of environment steps of the first training."""
    steps: Count = 500_000
    """Number of environment steps of each further training."""
    position: Annotated[tuple[float, float], Option(takes="two numbers low,high")] = (40.0, 76.0)
    """The starts of the proof, along each axis [m]."""
    velocity: Annotated[tuple[float, float], Option(takes="two numbers low,high")] = (-0.2, 0.2)
    """The starts of the proof, along each axis [m/s]."""
    horizon: Count = 40
    """Number of steps of the proof."""
    rounds: Count = 10
    """Largest number of further trainings."""
    boxes: Count = 4_000
    """Largest number of boxes of a proof."""
    from_boxes: bool = True
    """Whether further trainings draw starts from the boxes, or from those of the task alone."""
    seed: Seed = 1
    """The seed of all trainings."""
    out: Directory = "runs/prove_and_retrain"
    """Directory of the runs and the results."""


def call(command: str, *words: str, codes: Collection[int] = (0,)) -> None:
    """Run a command of jaxsafe. This program ends if it fails."""
    code = subprocess.run(
        [sys.executable, "-m", f"jaxsafe.{command}", *words], check=False
    ).returncode
    if code not in codes:
        sys.exit(code)


def trained(number: int, options: Options) -> Path:
    """Train the policy of a round, and return its file."""
    run = Path(options.out) / f"round_{number}"
    policy = run / "policy" / f"seed_{options.seed}.npz"
    if policy.exists():
        return policy
    words = ["docking2d", RECIPE, f"seed={options.seed}", "seeds=1", f"out={run}"]
    words += ["episodes=100", "eval_every=100000000"]
    if number == 0:
        call("train", *words, f"steps={options.first_steps}", NETWORK)
    else:
        before, unproved = trained(number - 1, options), certificate(number - 1, options)
        words += [f"steps={options.steps}", f"from={before}"]
        call("train", *words, *[f"starts={unproved}"] * options.from_boxes)
    return policy


def certificate(number: int, options: Options) -> Path:
    """Prove the policy of a round as far as it goes, and return the certificate."""
    path = Path(options.out) / f"round_{number}.npz"
    if not path.exists():
        search = ("everything=true", "resolution=8", f"boxes={options.boxes}")
        words = [f"run={trained(number, options)}", f"steps={options.horizon}", f"out={path}"]
        box = [f"box.{name}={list(getattr(options, name))}" for name in ("position", "velocity")]
        call("verify", *words, *box, *search, codes=EXIT_CODES.values())
    return path


def row(number: int, options: Options) -> dict[str, Any]:
    """Return what is known of the policy of a round."""
    known = load_certificate(certificate(number, options))
    return {
        "round": number,
        "result": known.result,
        **known.shares(),
        "bounded": known.bounded,
        "seconds": known.seconds,
    }


def main(argv: Sequence[str]) -> int:
    """Run the study and return the exit code: 0 if a policy is proved at last, else 1."""
    options = Options.parse(argv)
    rows = []
    for number in range(options.rounds + 1):
        rows.append(row(number, options))
        if rows[-1]["result"] == "proved":
            break
    write_json(
        Path(options.out) / "results.json",
        {
            "command": f"{Options.program} {' '.join(argv)}".rstrip(),
            "position": options.position,
            "velocity": options.velocity,
            "horizon": options.horizon,
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "rows": rows,
        },
    )
    for known in rows:
        shares = ", ".join(f"{known[name]:.1%} {name}" for name in ("proved", "refuted", "open"))
        print(f"after {known['round']} further trainings: {known['result']}: {shares}")
    return 0 if rows[-1]["result"] == "proved" else 1


if __name__ == "__main__":
    cli.run(main, Options, cli.at_once, alone=True)
