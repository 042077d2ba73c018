"""Which cases of a parametrised test run by default.

The default suite takes one case of a kind, and the other cases carry the mark `thorough`.
`.ci/run` runs those too.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import pytest

thorough = partial(pytest.param, marks=pytest.mark.thorough)
"""A case that the default suite leaves out."""

TASKS_BY_DEFAULT = ("docking2d", "rejoin2d")
"""One docking and one rejoin task. Those in the plane compile in half the time."""


def one_of_each_kind(
    cases: Iterable[Any], by_default: Iterable[Any] = TASKS_BY_DEFAULT
) -> list[Any]:
    """Return all cases. Those that are not named in `by_default` are marked `thorough`.

    A case with several values is a tuple. Cases that carry a mark already stay as they are.
    """
    cases = list(cases)
    by_default = list(by_default)
    missing = [case for case in by_default if case not in cases]
    if missing or not by_default:
        raise ValueError(f"by_default: no such cases: {missing}")

    def marked(case: Any) -> Any:
        if case in by_default or getattr(case, "marks", ()):
            return case
        return thorough(*case) if isinstance(case, tuple) else thorough(case)

    return [marked(case) for case in cases]
