"""Check whether results have all that the protocol of the benchmark asks for.

The protocol is docs/protocol.md. The exit code is 1 if something is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from jaxsafe.commands import cli
from jaxsafe.commands.options import CommandOptions, File, Option
from jaxsafe.schema.errors import ConfigError


class Options(CommandOptions):
    """The options of `jaxsafe check`."""

    run: Annotated[
        str,
        Option(
            first=True, examples=("run=runs/docking3d",), takes="a directory, or a results.json"
        ),
    ]
    """A run, an evaluation or a submission: a directory of results.json files, or one of them."""
    hidden_seed: File | None = None
    """The file of a hidden seed, to check that the results were measured with it."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from jaxsafe.evaluate.hidden_seed import read_hidden_seed
    from jaxsafe.runs.protocol import committed, findings, read_submission
    from jaxsafe.train.host.log import headline

    options = Options.parse(argv)
    try:
        submission = read_submission(options.run)
        found = findings(submission)
    except ConfigError as error:
        raise ConfigError(f"run: {error}") from None
    if options.hidden_seed is not None:
        hidden = read_hidden_seed(Path(options.hidden_seed))
        found.append(committed([submission.results, *submission.others], hidden))
    width = max(len(finding.what) for finding in found)
    print(f"{headline(submission.results)}\n")
    for what, reported, detail in found:
        print(f"{'reported' if reported else 'MISSING':8}  {what:{width}}  {detail}")
    missing = sum(not finding.reported for finding in found)
    print(f"\n{missing} of {len(found)} are missing" if missing else "\nall is there")
    return 1 if missing else 0


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
