"""Arrays in .npz files that may come from strangers.

No array is read before its name, type and size are known, and nothing in the file is run.
"""

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
from jaxsafe.storage.files import parse_json

MAX_ARRAY_BYTES = 2**28
"""The largest size of an array: 256 MiB, or 67 million weights.

There is a limit because a few compressed bytes can stand for terabytes.
"""

CERTIFICATE = "jaxsafe certificate 1"
"""What the header of a certificate of `jaxsafe verify` gives as its format."""

_HEADER_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
"""How the header of an array is read, by the version of its format."""


class Archive:
    """The arrays of an open .npz file by name.

    A file that is damaged may raise anything, which `open_archive` turns into a ConfigError.
    """

    def __init__(self, path: str | os.PathLike, file: zipfile.ZipFile) -> None:
        """Read only the names of the arrays."""
        self._path = path
        self._file = file
        self.names = [name.removesuffix(".npy") for name in file.namelist()]

    def describe(self, name: str) -> tuple[tuple[int, ...], np.dtype]:
        """Return shape and type of an array without reading it."""
        with self._file.open(f"{name}.npy") as member:
            shape, _, dtype = _read_header(member)
        return shape, dtype

    def read(self, name: str) -> np.ndarray:
        """Return an array of numbers or text."""
        with self._file.open(f"{name}.npy") as member:
            shape, fortran_order, dtype = _read_header(member)
            size = math.prod(shape) * dtype.itemsize
            if dtype.kind not in "fiubU" or size > MAX_ARRAY_BYTES:
                raise ValueError(f"{name} is no array of at most {MAX_ARRAY_BYTES} bytes")
            content = member.read(size)
            if len(content) != size or member.read(1):  # reading to the end compares the checksum
                raise ValueError(f"{name} does not have the size that it claims")
        return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran_order else "C")

    def header(self, what: str, *formats: str, infinite: bool = False) -> dict[str, Any]:
        """Return the mapping that the array `header` holds as a JSON text.

        Args:
            what: what the file should be, for the error.
            formats: what `format` may be in the header, the one of today first.
            infinite: whether numbers may be infinite or NaN.

        Raises:
            ConfigError: the header has another format, or none.
        """
        header = parse_json(str(self.read("header")), infinite=infinite)
        if not isinstance(header, dict) or header.get("format") not in formats:
            raise ConfigError(f"{self._path}: not {what}: expected format {formats[0]!r}")
        return header


@contextmanager
def open_archive(path: str | os.PathLike, wrong: str) -> Iterator[Archive]:
    """Open an .npz file.

    Args:
        path: the file.
        wrong: the message for a file that can be opened but is damaged or not an .npz file.

    Raises:
        ConfigError: anything goes wrong while the file is read.
    """
    try:
        with zipfile.ZipFile(path) as file:
            yield Archive(path, file)
    except ConfigError:
        raise
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or wrong}") from None
    except Exception:  # zipfile, zlib and numpy raise whatever their layers raise
        raise ConfigError(f"{path}: {wrong}") from None


def _read_header(member: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, whether the order is Fortran's, and type of the array that begins here."""
    version = npy.read_magic(member)
    return _HEADER_READERS[version](member)
