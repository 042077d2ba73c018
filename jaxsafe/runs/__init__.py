"""Runs: the training of all seeds of a task in a directory, and everything that is kept there.

The commands use this package, and so does `jaxsafe.train` with the name of a task.
"""

from jaxsafe.runs.run import Run, open_run
from jaxsafe.runs.training import train_run

__all__ = ["Run", "open_run", "train_run"]
