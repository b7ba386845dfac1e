"""Log file that contains only whole lines; its removal is detected."""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from .messages import COLUMNS

HEADER = (",".join(COLUMNS) + "\n").encode()
TAIL = 2**22  # bytes; at least the amount of data that reports may repeat


def log_path(path: Path, spare: Sequence[Path]) -> Path:
    """Return the path of a log: its path in the last temporary folder that contains it, or else its regular path.

    Args:
        path: Regular path of the log.
        spare: Temporary folders, in the order in which they are tried.
    """
    result = [folder / path.name for folder in spare if (folder / path.name).exists()]
    return result[-1] if result else path


class LogFile:
    """A file that stays open so that its content can be read even after its removal."""

    def __init__(self, path: Path, *, new: bool = False) -> None:
        """Open a log and remove an incomplete last line, or create a log with its header.

        Args:
            path: Path of the file.
            new: Create the file without the header, and fail if it exists.

        Raises:
            OSError: The file cannot be written.
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
        """Write lines; if the write fails, remove the part that was written.

        Raises:
            OSError: The lines cannot be written, or the file is no longer at its path.
        """
        there, mine = os.stat(self.path), os.fstat(self._file)
        if (there.st_ino, there.st_dev) != (mine.st_ino, mine.st_dev):
            raise FileNotFoundError(None, "a different file has replaced it", str(self.path))
        try:
            left = memoryview(lines)
            while left:
                left = left[os.write(self._file, left) :]
        except OSError:
            os.ftruncate(self._file, mine.st_size)
            raise

    def all(self) -> bytes:
        """Return the whole content."""
        return os.pread(self._file, os.fstat(self._file).st_size, 0)

    def tail(self) -> bytes:
        """Return the last part of the content; it begins at the beginning of a line."""
        size = os.fstat(self._file).st_size
        data = os.pread(self._file, TAIL, max(0, size - TAIL))
        return data if size <= TAIL else data[data.find(b"\n") + 1 :]

    def close(self) -> None:
        """Close the file."""
        with contextlib.suppress(OSError):
            os.close(self._file)
