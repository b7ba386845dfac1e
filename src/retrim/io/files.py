"""Writes files completely or not at all."""

import contextlib
import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CheckpointError, ConfigError
from ..transport.wire import MAX_BYTES


def write_whole(path: Path, data: bytes | str) -> None:
    """Write a file via a partial one in the same folder; an interruption leaves either the old file or the new one.

    Raises:
        OSError: The folder cannot be written, or the disk is full; the error names ``path``, not the partial file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        if error.errno is not None:
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def npz_bytes(arrays: Mapping[str, Any], *, compressed: bool = False) -> bytes:
    """Return the bytes of an NPZ file.

    Equal arrays give equal bytes; NumPy's own writer would add the time of day.

    Args:
        arrays: Arrays by name.
        compressed: Whether to compress the arrays.
    """
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")  # dated 1980, the first year of the ZIP format
            member.compress_type = archive.compression
            with archive.open(member, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return data.getvalue()


def read_bounded(path: Path, advice: str) -> bytes:
    """Read a file of at most :data:`retrim.transport.wire.MAX_BYTES`.

    Raises:
        CheckpointError: The file is missing or is not a regular file (the message then contains ``advice`` on how
            to make one), is too large, or cannot be read.
    """
    try:
        if path.is_dir():
            raise CheckpointError(f"{path}: not a regular file, but a folder; {advice}")
        if not path.is_file():
            reason = "not a regular file, but a device or a pipe" if path.exists() else "no such file"
            raise CheckpointError(f"{path}: {reason}; {advice}")
        if (size := path.stat().st_size) > MAX_BYTES:
            raise CheckpointError(f"{path}: {size} bytes, more than the {MAX_BYTES} that are accepted")
        return path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror})") from error


def check_writable(folder: Path, option: str = "--out") -> None:
    """Check, before a long computation, that files can be written to a folder; new folders are removed again.

    Args:
        folder: The folder.
        option: Option that states the folder, for the message.

    Raises:
        ConfigError: Files cannot be written.
    """
    probe, new = folder / ".retrim-probe", [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"x" * 4096)
    except OSError as error:
        raise ConfigError(
            f"{folder}: results cannot be written there ({error.strerror}); choose a different {option}"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)
            for each in new:
                each.rmdir()
