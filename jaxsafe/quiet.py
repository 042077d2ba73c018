"""Silence a false alarm of two versions of jaxlib. It is imported before jaxlib is."""

import os
from importlib.metadata import version

if version("jaxlib") in ("0.10.0", "0.10.1"):
    # These versions log an error for every program that they load from the compilation cache. The
    # error takes +prefer-no-gather and +prefer-no-scatter for features of the machine, but they are
    # choices of jaxlib itself. Whatever really fails still raises an exception.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
