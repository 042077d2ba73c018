"""Silence a false alarm of two versions of jaxlib."""

import importlib
import os
import sys
from importlib.metadata import version

JAX_CHOICE = "1"
"""The level of log messages that JAX writes into the environment if nobody has set one."""

LOUD = ("0.10.0", "0.10.1")
"""Versions of jaxlib that log an error for every program that they load from the cache.

The error takes +prefer-no-gather and +prefer-no-scatter for features of the machine, but they are
choices of jaxlib itself. Whatever really fails still raises an exception.
"""

if version("jaxlib") in LOUD and os.environ.get("TF_CPP_MIN_LOG_LEVEL", JAX_CHOICE) == JAX_CHOICE:
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # for processes that this one starts, too
    if "jaxlib" in sys.modules:
        # jaxlib has read the level already, so it must be told.
        importlib.import_module("jaxlib.utils").absl_set_min_log_level(3)
