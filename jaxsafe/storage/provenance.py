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


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """The model of this host's processor: results agree to the last bit only between processors of one kind.

    With family and model, where they are known: a hypervisor may give many the same name.
    """
    try:
        lines = cpuinfo.read_text(encoding="utf-8").partition("\n\n")[0].splitlines()
    except OSError:
        lines = []
    found = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    if "model name" not in found:
        return platform.processor()
    numbers = [f"{name.removeprefix('cpu ')} {found[name]}" for name in ("cpu family", "model") if name in found]
    return ", ".join([found["model name"], *numbers])


def commit() -> str | None:
    """Of the checkout that this runs in, if it does, and whether code or a recipe (not a policy) is not that commit's."""
    git = shutil.which("git")
    if git is None:
        return None
    package = Path(__file__).resolve().parent.parent
    ours = [git, "-C", str(package), "ls-files", "--error-unmatch", "types.py"]
    if subprocess.run(ours, capture_output=True, check=False).returncode:
        return None  # installed somewhere inside another repository
    code = [str(path) for path in (package, package.parent / "configs") if path.is_dir()] + [":(exclude)*.npz"]
    found, changes = (
        subprocess.run([git, "-C", str(package), *words], capture_output=True, text=True, check=False).stdout.strip()
        for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--", *code])
    )
    return f"{found[:12]} with changes" if found and changes else found[:12] or None
