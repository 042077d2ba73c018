"""What a result was made by: versions, device, processor and commit."""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Any

RECORDED_PACKAGES = ("jaxsafe", "jax", "jaxlib", "numpy", "optax", "orbax-checkpoint")
"""Packages whose versions are recorded, because they can change a result."""


def version() -> str:
    """Return the version of jaxsafe. It is `unknown` in a checkout that is not installed."""
    try:
        return importlib.metadata.version("jaxsafe")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def versions() -> dict[str, Any]:
    """Return what a result depends on besides its options.

    Returns:
        The versions of packages and of Python, the number and kind of devices, and the processor of
        the host.
    """
    import jax

    devices = jax.devices()
    return {
        **{name: importlib.metadata.version(name) for name in RECORDED_PACKAGES},
        "python": platform.python_version(),
        "device": f"{len(devices)} × {devices[0].device_kind}",
        "processor": processor(),
    }


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the model of this host's processor.

    Results agree to the last bit only between processors of one kind. Family and model numbers are
    included where they are known, because a hypervisor may give many processors the same name.
    """
    try:
        lines = cpuinfo.read_text(encoding="utf-8").partition("\n\n")[0].splitlines()
    except OSError:
        lines = []
    properties = {}
    for line in lines:
        name, _, value = line.partition(":")
        properties[name.strip()] = value.strip()
    if "model name" not in properties:
        return platform.processor()
    parts = [properties["model name"]]
    for name, label in (("cpu family", "family"), ("model", "model")):
        if name in properties:
            parts.append(f"{label} {properties[name]}")
    return ", ".join(parts)


def commit() -> str | None:
    """Return the commit of the checkout this runs in, or None outside one.

    The commit is marked if code or recipes differ from it. A change of policy files does not count.
    """
    git = shutil.which("git")
    if git is None:
        return None
    package = Path(__file__).resolve().parent.parent
    in_package = [git, "-C", str(package)]
    is_tracked = [*in_package, "ls-files", "--error-unmatch", "types.py"]
    if subprocess.run(is_tracked, capture_output=True, check=False).returncode:
        return None  # the package is installed somewhere inside another repository

    def output(*words: str) -> str:
        command = [*in_package, *words]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    sources = [str(path) for path in (package, package.parent / "configs") if path.is_dir()]
    name = output("rev-parse", "HEAD")[:12]
    changes = output("status", "--porcelain", "--", *sources, ":(exclude)*.npz")
    return f"{name} with changes" if name and changes else name or None
