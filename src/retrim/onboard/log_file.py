"""The file of a log: whole lines only, and noticed when somebody takes it away."""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from .messages import COLUMNS

HEADER = (",".join(COLUMNS) + "\n").encode()
TAIL = 2**22  # bytes: as much as reports may repeat


def log_path(path: Path, spare: Sequence[Path]) -> Path:
    """Return where a log is: in its place, or in the last temporary folder that it went to.

    Args:
        path: Its place.
        spare: Temporary folders, in the order in which they are tried.
    """
    found = [folder / path.name for folder in spare if (folder / path.name).exists()]
    return found[-1] if found else path


class LogFile:
    """A file that stays open, so that what is written can be read even after it was removed."""

    def __init__(self, path: Path, *, new: bool = False) -> None:
        """Open a log, without a torn last line, or begin it with its header.

        Args:
            path: The file.
            new: Begin it without the header, and only if there is none.

        Raises:
            OSError: It cannot be written.
        """
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | (os.O_EXCL if new else 0)
        self.path, self._file = path, os.open(path, flags, 0o666)
        try:
            tail = self.tail()
            size = os.fstat(self._file).st_size
            os.ftruncate(self._file, size - len(tail) + tail.rfind(b"\n") + 1)
            if not new and os.fstat(self._file).st_size == 0:
                self.append(HEADER)
        except OSError:
            self.close()
            raise

    def append(self, lines: bytes) -> None:
        """Write lines, all of them or none.

        Raises:
            OSError: They cannot be written, or the file is not in its place any more.
        """
        there, mine = os.stat(self.path), os.fstat(self._file)
        if (there.st_ino, there.st_dev) != (mine.st_ino, mine.st_dev):
            raise FileNotFoundError(None, "another file has taken its place", str(self.path))
        try:
            left = memoryview(lines)
            while left:
                left = left[os.write(self._file, left) :]
        except OSError:
            os.ftruncate(self._file, mine.st_size)
            raise

    def all(self) -> bytes:
        """Return all that is written."""
        return os.pread(self._file, os.fstat(self._file).st_size, 0)

    def tail(self) -> bytes:
        """Return the end of what is written, from the beginning of a line."""
        size = os.fstat(self._file).st_size
        data = os.pread(self._file, TAIL, max(0, size - TAIL))
        return data if size <= TAIL else data[data.find(b"\n") + 1 :]

    def close(self) -> None:
        """Close the file."""
        with contextlib.suppress(OSError):
            os.close(self._file)
