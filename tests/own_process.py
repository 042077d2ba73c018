"""Check what depends on how a program is compiled, in a process that compiles as commands do."""

import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

SCRIPT = """
from jaxsafe.devices.seed_mapper import claim_cores
claim_cores()
from {module} import {name}
{name}(*{arguments!r})
"""


def check_as_compiled_by_commands(check: Callable[..., None], *arguments: Any) -> None:
    """Call a function of a test module in a process without the compiler flags of the tests.

    Args:
        check: a function of a module, which raises if something is wrong.
        arguments: its arguments, which Python reads as they are printed.
    """
    script = SCRIPT.format(module=check.__module__, name=check.__name__, arguments=arguments)
    environment = {**os.environ, "XLA_FLAGS": "", "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
