"""Prove that a policy keeps its safety constraint, or docks, from every start in a box.

The proof is about the closed loop that `jaxsafe.step` runs, between samples too, and with its
rounding. The exit code is 0 if the property is proved, 1 if a start violates it, and 3 if it is
open. Such a start is printed. A certificate is written, which `jaxsafe/verify/check.py` checks with
NumPy alone.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from jaxsafe.commands import cli
from jaxsafe.commands.export import BOX, MAX_STEPS, SingleOptions, single_policy
from jaxsafe.commands.options import Count, File, Option
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.schema.component import Range
from jaxsafe.schema.errors import ConfigError

if TYPE_CHECKING:
    from jaxsafe.verify.verify import Verification

EXIT_CODES = {"proved": 0, "refuted": 1, "open": 3}
"""The exit code of each result of a proof."""

BETWEEN_LINES = 2.0
"""Smallest time between two lines about the progress [s]."""


class Options(SingleOptions):
    """The options of `jaxsafe verify`."""

    groups: ClassVar = {
        "The policy.": ("run", "seed", "activation"),
        "The environment in which it acts.": ("env", "env.PATH", "actions", "variant", "rta"),
        "What is proved.": ("property", "steps", "box.FIELD", "arithmetic"),
        "The search.": ("minutes", "boxes", "everything", "resolution", "order", "resume", "out"),
    }

    property: Literal["safe", "docks"] = "safe"
    """What is proved. safe means that the margin h is never negative.

    docks means that the episode ends with a success within `steps`, and keeps the limit until then.
    """
    steps: Annotated[int, Range(1, largest=MAX_STEPS)] = 40
    """Number of steps."""
    box: Annotated[
        Mapping[str, Any],
        Option(prefix="box.", placeholder="FIELD", lists=True, takes="[low,high] or one per axis"),
    ]
    """The starts, for instance box.deputy.velocity=[[-0.1,0.1],[0,0.2]].

    By default the position of a spacecraft is within [70, 106] m and its velocity within [-0.28,
    0.28] m/s. Every other number that a start draws must be given.
    """
    arithmetic: Literal["float32", "real"] = "float32"
    """The arithmetic of the loop: single precision as it runs, or real numbers."""
    minutes: Annotated[int, Range(1, largest=100_000)] | None = None
    """Number of minutes after which to stop. By default there is no limit.

    The boxes that are left then are open.
    """
    boxes: Count = 100_000
    """Largest number of boxes to bound."""
    everything: bool = False
    """Whether to go on after a violation, for a map of the whole box."""
    resolution: Count = 2048
    """How fine the smallest boxes are. A box of at most 18 m / N and 0.1 m/s / N is not halved.

    A map needs no more than 4.
    """
    order: Annotated[int, Range(0, largest=100)] = 0
    """To how many generators per number of the state a set of states is reduced after 40 steps.

    With 0 all are kept. With 8 a proof over hundreds of steps is faster, and its bounds are wider.
    """
    resume: File | None = None
    """A certificate of the same loop and box to go on from."""
    out: File | None = None
    """The certificate to write. By default it has the name of the policy."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    enable_compilation_cache()
    from jaxsafe.storage.provenance import versions
    from jaxsafe.verify.certificate import load_certificate, save_certificate
    from jaxsafe.verify.loop import CRAFT
    from jaxsafe.verify.verify import verify

    options = Options.parse(argv)
    earlier = load_certificate(options.resume) if options.resume else None
    saved, stem = single_policy(options)
    out = Path(options.out or f"{stem}_{options.property}.npz")
    if out.suffix != ".npz":
        raise ConfigError(f"out: expected NAME.npz, found {out}")
    default = BOX if isinstance(saved.env.agent_platform, CRAFT) else {}
    verification = verify(
        saved.env,
        saved.agent.policy(saved.env, saved.params, True),
        {**default, **options.box},
        options.steps,
        property=options.property,
        arithmetic=options.arithmetic,
        seconds=math.inf if options.minutes is None else 60.0 * options.minutes,
        max_boxes=options.boxes,
        everything=options.everything,
        resolution=options.resolution,
        order=options.order,
        resume=earlier,
        progress=_Progress(),
    )
    save_certificate(out, verification, {"policy": stem, "jaxsafe": versions()["jaxsafe"]})
    result = verification.result
    print(f"{_line(verification)}\n{result}: {_reason(verification)}\nwritten to {out}")
    if result == "open":
        print(f"go on with the same options and resume={out}")
    return EXIT_CODES[result]


class _Progress:
    """Prints a line about the verification from time to time."""

    def __init__(self) -> None:
        self.last = time.monotonic()

    def __call__(self, verification: Verification) -> None:
        if time.monotonic() - self.last < BETWEEN_LINES:
            return
        self.last = time.monotonic()
        rest = verification.shares()["open"]
        seconds = verification.seconds * rest / (1.0 - rest) if rest < 0.9999 else None
        left = "" if seconds is None else f", about {seconds:.0f} s left"
        print(f"{_line(verification)}{left}", flush=True)


def _line(verification: Verification) -> str:
    shares = ", ".join(f"{share:.2%} {name}" for name, share in verification.shares().items())
    return f"{shares} after {verification.bounded:,} boxes and {verification.seconds:.1f} s"


def _reason(verification: Verification) -> str:
    violation = verification.counterexample
    if violation is not None and violation.undocked:
        start = json.dumps(violation.start)
        return (
            f"not docked after {violation.step} steps, at best {-violation.margin:.4g} m outside, "
            f"from reset_to {start}"
        )
    if violation is not None:
        start = json.dumps(violation.start)
        return f"margin {violation.margin:.4g} after {violation.step} steps from reset_to {start}"
    if verification.result == "open":
        return f"{len(verification.open.low):,} boxes are left"
    count = len(verification.proved.low)
    starts = f"every start in {count:,} box{'es' * (count != 1)}"
    margin = f"h ≥ {verification.margin:.3g} {'ft' if verification.loop.motion else 'm/s'}"
    if verification.loop.property == "docks":
        return (
            f"docked after {verification.last.min()} to {verification.last.max()} steps from "
            f"{starts}, and {margin} until then, between samples too"
        )
    return f"{margin} for {verification.steps} steps from {starts}, between samples too"


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
