"""Imported before jaxlib is: silences a false alarm of two of its versions."""

import os
from importlib.metadata import version

if version("jaxlib") in ("0.10.0", "0.10.1"):
    # For every program from the compilation cache they log an error about the machine's features +prefer-no-gather and
    # +prefer-no-scatter, which are no features of machines but their own choices. What fails still raises.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
