"""What a result was made by: versions, device, processor and commit."""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Any

PACKAGES = ("jaxsafe", "jax", "jaxlib", "numpy", "optax", "orbax-checkpoint")
"""Those whose version can change a result."""


def versions() -> dict[str, Any]:
    """What ran: package and library versions, Python, the kind and number of devices, and the processor of the host."""
    import jax

    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {
        **found,
        "python": platform.python_version(),
        "device": f"{len(jax.devices())} × {jax.devices()[0].device_kind}",
        "processor": processor(),
    }


def processor() -> str:
    """The model of this host's processor: results agree to the last bit only between processors of one kind."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor())


def commit() -> str | None:
    """Of the checkout that this runs in, if it does, and whether code or a recipe (not a policy) is not that commit's."""
    git = shutil.which("git")
    if git is None:
        return None
    package = Path(__file__).resolve().parent
    code = [str(path) for path in (package, package.parent / "configs") if path.is_dir()] + [":(exclude)*.npz"]
    found, changes = (
        subprocess.run([git, "-C", str(package), *words], capture_output=True, text=True, check=False).stdout.strip()
        for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--", *code])
    )
    return f"{found[:12]} with changes" if found and changes else found[:12] or None
