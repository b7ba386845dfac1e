"""Moves the files of an earlier run aside, and back if the new run does not begin."""

import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

PREFIX = ".earlier-"


class EarlierOutputs:
    """Files of an earlier run; as a context, they return to their folder unless :meth:`discard` was called."""

    def __init__(self, folder: Path, patterns: Iterable[str]) -> None:
        """Move the files that match into a hidden folder; a killed process leaves them there.

        Args:
            folder: Folder of the run.
            patterns: Patterns of their names.
        """
        self._folder = folder
        self._aside: Path | None = None
        files = [path for pattern in patterns for path in folder.glob(pattern) if path.is_file()]
        if files:
            self._aside = Path(tempfile.mkdtemp(prefix=PREFIX, dir=folder))
            for path in files:
                path.rename(self._aside / path.name)

    def __enter__(self) -> "EarlierOutputs":
        """Return the files."""
        return self

    def __exit__(self, *_: object) -> None:
        """Move the files back, over those of the run that did not begin."""
        if self._aside is not None:
            for path in self._aside.iterdir():
                path.replace(self._folder / path.name)
            self._aside.rmdir()
            self._aside = None

    def discard(self) -> None:
        """Delete the files, since the new run has begun."""
        aside, self._aside = self._aside, None
        if aside is not None:
            shutil.rmtree(aside)
