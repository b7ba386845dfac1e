"""Reads arrays from an NPZ file; each array is read when it is accessed, after a check of its size."""

import math
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from ...errors import LogError, excerpt

MAX_MEMBER = 512 * 2**20
"""Maximum unpacked size of an array [bytes]; the nine numbers of an attitude, for 45 minutes at 1 kHz, take 200 MB."""
SUFFIX = ".npy"


class NpzMembers(Mapping[str, Any]):
    """A file's arrays by name; a member that is not accessed is not unpacked, whatever its size."""

    def __init__(self, path: Path) -> None:
        """Read the table of members.

        Raises:
            LogError: The file is not an NPZ file.
        """
        self._path = path
        try:
            with zipfile.ZipFile(path) as archive:
                self._members = {each.filename.removesuffix(SUFFIX): each for each in archive.infolist()}
        except Exception as error:  # the parser raises various errors for bytes that are not an archive
            raise self._unreadable(error) from error

    def __getitem__(self, name: str) -> np.ndarray:
        """Return an array.

        Raises:
            LogError: The array is too large or damaged, or does not consist of numbers.
        """
        member = self._members[name]
        if member.file_size > MAX_MEMBER:
            raise LogError(
                f"{self._path}: array {excerpt(name)} has {member.file_size} bytes, more than the {MAX_MEMBER} that "
                "are accepted"
            )
        try:
            with zipfile.ZipFile(self._path) as archive, archive.open(member) as file:
                return _array(file, member.file_size)
        except Exception as error:
            raise self._unreadable(error) from error

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._members)

    def __len__(self) -> int:
        """Return the number of arrays."""
        return len(self._members)

    def _unreadable(self, error: Exception) -> LogError:
        return LogError(f"{self._path}: not a whole NPZ file ({error})")


def _array(file: Any, size: int) -> np.ndarray:
    """Read an array, after validating its header, which may contain an arbitrary shape."""
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    version = npy.read_magic(file)
    if version not in read:
        raise ValueError(f"version {version} of an array")
    shape, by_columns, dtype = read[version](file)
    if dtype.hasobject or dtype.names is not None:
        raise ValueError(f"an array of {dtype}, not of numbers")
    if not math.prod(shape) * dtype.itemsize <= size:
        raise ValueError(f"an array of {shape} in {size} bytes")
    flat = np.frombuffer(file.read(), dtype=dtype, count=math.prod(shape))
    return flat.reshape(shape, order="F" if by_columns else "C")
