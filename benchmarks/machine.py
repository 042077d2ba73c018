"""What every result says about where it was measured."""

from __future__ import annotations

import os
import subprocess
from typing import Any

import jax


def about() -> dict[str, Any]:
    """Commit, version of JAX, device and number of cores."""
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    return {"commit": commit, "jax": jax.__version__, "device": jax.devices()[0].device_kind, "cores": os.cpu_count()}
