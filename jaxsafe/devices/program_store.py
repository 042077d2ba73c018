"""Compiled programs in files, so that a second start neither traces nor compiles them.

JAX's own cache holds compiled programs too, but asks for the traced program to find one. Tracing
takes most of a second start. Here a program is found by what it is made from: the text that its
user gives, the sources of jaxsafe, all other modules that are loaded, and the settings of JAX.

A program is stored only if nothing else can be in it. So no module of a user may be loaded, because
it could hold parts of the environment, read files or replace functions of jaxsafe. Like the cache
of JAX the files hold code, so they lie in a directory of the user.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import re
import sys
import sysconfig
import threading
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable
from jax.sharding import Mesh

from jaxsafe.devices.memory import footprint
from jaxsafe.storage.files import write_bytes

MAX_PROGRAMS = 64
"""Number of programs that are kept. The one that was used longest ago goes first."""

INSTALLED = tuple(f"{os.sep}{name}{os.sep}" for name in ("site-packages", "dist-packages"))
"""Parts of the paths of installed packages."""

REQUEST = "/jax/compilation_cache/compile_requests_use_cache"
"""The event with which JAX tells that it looks for a program in its cache."""

HIT = "/jax/compilation_cache/cache_hits"
"""The event with which JAX tells that it has found the program."""

_events = threading.local()
"""What JAX has told in each thread."""

LAPACK = "lapack_"
"""How the names of LAPACK's functions begin."""

PACKAGE = Path(__file__).resolve().parent.parent

OWN = os.path.join(PACKAGE, "")
"""How the paths of jaxsafe's own modules begin. Those of its neighbours, `jaxsafe_mine`, do not."""


def program_file(made_from: str, arguments: Any) -> Path | None:
    """Return the path of a program, whether or not it is there, or None if it cannot be stored.

    Args:
        made_from: a text that names the program and everything that the compiler sees of it, apart
            from its sources.
        arguments: arguments like those of the calls, or their shapes, types and shardings.
    """
    place = _directory()
    one_cpu = jax.default_backend() == "cpu" and jax.process_count() == 1
    if place is None or not one_cpu or not only_installed_code():
        return None
    shapes = [
        (x.shape, x.dtype, getattr(x, "weak_type", False), getattr(x, "sharding", None))
        for x in jax.tree.leaves(arguments)
    ]
    name = hashlib.sha256(f"{_surroundings()}\n{made_from}\n{shapes}".encode()).hexdigest()
    return place / name


class StoredProgram(NamedTuple):
    """What a file holds. It is read at once, and making a program of it takes much longer."""

    devices: list[int]
    """Numbers of the devices on which the program runs, in its own order."""
    with_lapack: bool
    """Whether the program calls LAPACK."""
    result_shapes: Any
    """Shapes and types of what the program returns."""
    footprint: int
    """Bytes that the program needs on each device. JAX takes long to tell."""
    parts: tuple[bytes, Any, Any]
    """What JAX makes of the program, and the structures of its arguments and results."""

    def load(self) -> jax.stages.Compiled | None:
        """Return the program, or None if it cannot be used here."""
        try:
            if self.with_lapack:
                _register_lapack()
            devices = {device.id: device for device in jax.devices()}
            return serialize_executable.deserialize_and_load(
                *self.parts, execution_devices=[devices[number] for number in self.devices]
            )
        except Exception:  # whatever is wrong with it, the program can be compiled
            return None


def read(path: Path) -> StoredProgram | None:
    """Return what a file holds, or None if there is none that is whole."""
    try:
        content = path.read_bytes()
        digest, content = content[:32], content[32:]
        if hashlib.sha256(content).digest() != digest:
            return None
        stored = pickle.loads(content)
        os.utime(path)
    except Exception:  # whatever is wrong with it, the program can be compiled
        return None
    return stored


def compile_anew(lowered: jax.stages.Lowered) -> tuple[jax.stages.Compiled, bool]:
    """Return a compiled program, and whether it was compiled and not found in JAX's cache.

    A program from that cache lacks what a file needs. XLA writes a file of it without an error, and
    the program of the file then fails when it is called.
    """
    _listen()
    _events.seen = set()
    compiled = lowered.compile()
    return compiled, REQUEST in _events.seen and HIT not in _events.seen


def save(
    path: Path, lowered: jax.stages.Lowered, compiled: jax.stages.Compiled, result_shapes: Any
) -> None:
    """Store a program, if it can be, and remove programs that were not used for long.

    A program that calls other libraries than LAPACK is not stored. JAX registers their functions
    when it lowers a program, and a program that calls an unknown function crashes.

    Args:
        path: the path that `program_file` has returned.
        lowered: the program before it was compiled.
        compiled: the program.
        result_shapes: shapes and types of what it returns.
    """
    called = re.findall(r"custom_call @(\w+)", lowered.as_text())
    if not all(name.startswith(LAPACK) for name in called):
        return
    stored = StoredProgram(
        devices=_devices(compiled),
        with_lapack=bool(called),
        result_shapes=result_shapes,
        footprint=footprint(compiled),
        parts=serialize_executable.serialize(compiled),
    )
    content = pickle.dumps(stored)
    with contextlib.suppress(OSError):  # without its file the program is compiled again
        write_bytes(path, hashlib.sha256(content).digest() + content)
        newest = sorted(path.parent.iterdir(), key=lambda file: file.stat().st_mtime, reverse=True)
        for file in newest[MAX_PROGRAMS:]:
            file.unlink()


@cache
def _listen() -> None:
    """Let JAX tell what it does, from now on."""

    def note(event: str, **_: Any) -> None:
        getattr(_events, "seen", set()).add(event)

    jax.monitoring.register_event_listener(note)


@cache
def _register_lapack() -> None:
    """Let JAX register the functions of LAPACK, as it does when it lowers one of them."""
    jax.jit(jnp.linalg.qr).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))


def _devices(compiled: jax.stages.Compiled) -> list[int]:
    """Return the numbers of the devices on which a program runs, in its own order."""
    shardings = jax.tree.leaves(compiled.input_shardings)
    meshes = [mesh for x in shardings if isinstance(mesh := getattr(x, "mesh", None), Mesh)]
    devices = [*meshes[0].devices.flat] if meshes else [*shardings[0].device_set]
    return [device.id for device in devices]


def only_installed_code() -> bool:
    """Return whether all loaded modules belong to Python, to installed packages or to jaxsafe.

    Other modules are a user's, and so is the main module of a notebook or an interactive session.
    """
    if not os.path.exists(getattr(sys.modules["__main__"], "__file__", None) or ""):
        return False
    names = ("stdlib", "platstdlib", "scripts")
    places = (OWN, *(os.path.join(sysconfig.get_path(name), "") for name in names))
    return all(
        path.startswith(places) or any(name in path for name in INSTALLED)
        for path in _loaded_files()
    )


def _directory() -> Path | None:
    """Return the directory of programs, or None if the user has no cache on this machine."""
    settings = jax.config.values
    place = settings["jax_compilation_cache_dir"]
    if not settings["jax_enable_compilation_cache"] or place is None or not Path(place).is_dir():
        return None
    return Path(place) / "programs"


def _loaded_files() -> list[str]:
    """Return the paths of all loaded modules.

    PyTorch makes modules by hand that name files that do not exist, such as `_ops.py`.
    """
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    named = [path for path in files if path and (os.path.isabs(path) or os.path.exists(path))]
    return sorted({os.path.abspath(path) for path in named})


@cache
def _surroundings() -> str:
    """Return a hash of all that compiled programs depend on besides what they are made from."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(f"{path.relative_to(PACKAGE)}\n".encode() + path.read_bytes())
    for path in _loaded_files():
        if not path.startswith(OWN):
            archive = (path, *map(str, Path(path).parents))  # a module may be inside one
            stat = os.stat(next(place for place in archive if os.path.exists(place)))
            digest.update(f"{path} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    facts = (
        sys.version,
        os.environ.get("XLA_FLAGS"),
        sorted(jax.config.values.items()),
        [str(device) for device in jax.devices()],
        _processor_features(),
    )
    digest.update(repr(facts).encode())
    return digest.hexdigest()


def _processor_features() -> list[str]:
    """Return what the processor can do, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    return sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
