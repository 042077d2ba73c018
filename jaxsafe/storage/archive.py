"""Arrays in .npz files of strangers: nothing is read before its name, type and size are known, and nothing runs."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.lib import format as npy

from jaxsafe.schema.errors import ConfigError

MAX_BYTES = 2**28
"""Bytes that an array may have, 256 MiB: 67 million weights. A few compressed bytes can claim to be terabytes."""


class Archive:
    """The arrays of an open .npz file by name. What is wrong with the file may raise anything, see `open_archive`."""

    def __init__(self, file: zipfile.ZipFile) -> None:
        """Look at the names only."""
        self._file = file
        self.names = [name.removesuffix(".npy") for name in file.namelist()]

    def describe(self, name: str) -> tuple[tuple[int, ...], np.dtype]:
        """Return shape and type of an array without reading it."""
        with self._file.open(f"{name}.npy") as member:
            shape, _, dtype = _header(member)
        return shape, dtype

    def read(self, name: str) -> np.ndarray:
        """Return an array of numbers or text."""
        with self._file.open(f"{name}.npy") as member:
            shape, fortran_order, dtype = _header(member)
            size = math.prod(shape) * dtype.itemsize
            if dtype.kind not in "fiubU" or size > MAX_BYTES:
                raise ValueError(f"{name} is no array of at most {MAX_BYTES} bytes")
            content = member.read(size)
            if len(content) != size or member.read(1):  # at the end of a member its checksum is compared
                raise ValueError(f"{name} has not the size that it claims")
        return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran_order else "C")


@contextmanager
def open_archive(path: str | os.PathLike, wrong: str) -> Iterator[Archive]:
    """Open an .npz file; whatever goes wrong while it is read is a ConfigError.

    Args:
        path: of the file.
        wrong: what the message says of a file that can be opened and is damaged or no .npz.
    """
    try:
        with zipfile.ZipFile(path) as file:
            yield Archive(file)
    except ConfigError:
        raise
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or wrong}") from None
    except Exception:  # zipfile, zlib and numpy raise whatever their layers raise
        raise ConfigError(f"{path}: {wrong}") from None


def _header(member: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, order and type of the array that begins here."""
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    return read[npy.read_magic(member)](member)
