"""Silence a false alarm of two versions of jaxlib. It is imported before jaxlib is."""

import os
from importlib.metadata import version

if version("jaxlib") in ("0.10.0", "0.10.1"):
    # For every program from the compilation cache these versions log an error. It is about the
    # features +prefer-no-gather and +prefer-no-scatter of the machine. They are not features of a
    # machine but choices of jaxlib itself. What fails still raises.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
