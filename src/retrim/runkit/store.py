"""Stores the values that a run has made in its folder, so that the same command resumes after being killed.

A key states everything from which a value is made, see :func:`retrim.runkit.provenance.section_key`. A value is made
again if its file is damaged or has other content than its key promises. Reading a file never executes anything.
"""

import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from ..errors import RetrimError, one_line
from .reporter import Reporter, Silent

T = TypeVar("T")


@dataclass(frozen=True)
class Codec(Generic[T]):
    """Conversion of values of one kind to files and back, bit for bit."""

    suffix: str
    """Suffix of the file names."""
    write: Callable[[Path, T], None]
    """Writes a value completely or not at all, and creates the folder if necessary."""
    read: Callable[[Path], T]
    """Returns the value in a file; raises any exception if the file is damaged, or of another kind or content."""


class Store:
    """Values in a folder by their keys; each value is one file, which is complete or absent."""

    def __init__(self, folder: Path, *, reporter: Reporter | None = None, stop: threading.Event | None = None) -> None:
        """Create a store; the folder is created with the first value.

        Args:
            folder: Folder of the files.
            reporter: Receives a line about each file that cannot be used.
            stop: Set if the run ends early; a value that is made after that may be incomplete, and is not stored.
        """
        self.folder, self._reporter = folder, reporter or Silent()
        self._stop = stop or threading.Event()

    def path(self, key: str, codec: Codec[T]) -> Path:
        """Return the path of a value; its file may be absent."""
        return self.folder / f"{key}{codec.suffix}"

    def get(self, key: str, codec: Codec[T]) -> T | None:
        """Return a stored value; None if there is none, or if its file cannot be used.

        Args:
            key: Key of the value; it may begin with a folder, as in ``policies/...``.
            codec: Codec of the value.
        """
        path = self.path(key, codec)
        if not path.is_file():
            return None
        try:
            return codec.read(path)
        except Exception as error:  # the readers of file formats raise exceptions of any kind for damaged bytes
            reason = str(error) if isinstance(error, RetrimError) else f"{path}: {type(error).__name__}, {error}"
            self._reporter.say(f"{one_line(reason)}; it is made again")
            return None

    def put(self, key: str, value: T, codec: Codec[T]) -> None:
        """Store a value, and replace an earlier one with the same key.

        Raises:
            OSError: The folder cannot be written, or the disk is full.
        """
        codec.write(self.path(key, codec), value)

    def get_or_make(
        self,
        key: str,
        make: Callable[[], T | None],
        codec: Codec[T],
        *,
        on_reuse: Callable[[], None] = lambda: None,
        on_store: Callable[[], None] = lambda: None,
    ) -> T | None:
        """Return a stored value; make and store the value if it is missing.

        Args:
            key: Key of the value.
            make: Makes the value; None, and any value that is made after a stop, is returned but not stored.
            codec: Codec of the value.
            on_reuse: Called if the value is not made.
            on_store: Called after a new value is stored.
        """
        earlier = self.get(key, codec)
        if earlier is not None:
            on_reuse()
            return earlier
        value = make()
        if value is not None and not self._stop.is_set():
            self.put(key, value, codec)
            on_store()
        return value

    def remove(self, key: str, codec: Codec[T]) -> None:
        """Remove a value, if it is stored."""
        self.path(key, codec).unlink(missing_ok=True)

    def clear(self, folder: str) -> None:
        """Remove all values whose keys begin with a folder."""
        shutil.rmtree(self.folder / folder, ignore_errors=True)
