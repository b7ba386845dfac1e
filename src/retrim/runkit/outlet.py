"""Writes the output of a run, to a temporary folder if the run's own folder cannot be written."""

import contextlib
import secrets
import tempfile
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from ..config.presets import Preset
from .flights import Flight
from .outputs import clear_outputs, write_events, write_learner_state, write_logs
from .run import Run

T = TypeVar("T")
SHARED_MEMORY = Path("/dev/shm")


def spare_folders(folder: Path) -> tuple[Path, ...]:
    """Return temporary substitutes for a folder, in order of preference; they are not created yet.

    Args:
        folder: The folder; its name becomes part of the substitutes' names.
    """
    bases = dict.fromkeys((Path(tempfile.gettempdir()), *([SHARED_MEMORY] if SHARED_MEMORY.is_dir() else [])))
    name = f"kept-{folder.resolve().name[:80]}-{secrets.token_hex(4)}"
    return tuple(base / name for base in bases)


class Outlet:
    """Writes each file into its run's folder, or into a temporary folder if that fails."""

    def __init__(self, folder: Path, inputs: Collection[Path] = ()) -> None:
        """Create the outlet for a run's folder.

        Args:
            folder: Folder of the run.
            inputs: Files that the run reads; they are replaced, but not removed.
        """
        self.folder, self.spare, self._inputs = folder, spare_folders(folder), inputs
        self.faults: list[str] = []
        """One line for each file that was written to a different folder or could not be written."""

    def write(self, name: str, put: Callable[[Path], T]) -> T | None:
        """Write one output.

        Args:
            name: Name of the output, for messages.
            put: Function that writes the output into a given folder.

        Returns:
            The result of ``put``; None if no folder can be written.
        """
        reason = ""
        for folder in (self.folder, *self.spare):
            try:
                folder.mkdir(parents=True, exist_ok=True, mode=0o777 if folder == self.folder else 0o700)
                result = put(folder)
            except OSError as error:
                reason = reason or error.strerror or str(error)
                if folder != self.folder:
                    with contextlib.suppress(OSError):
                        folder.rmdir()
                continue
            except Exception as error:  # a broken back end or viewer must not prevent the other outputs
                self.faults.append(f"{name} cannot be made ({type(error).__name__}: {error})")
                return None
            if folder != self.folder:
                self.faults.append(f"{name} cannot be written to {self.folder} ({reason}); it is in {folder}")
            return result
        self.faults.append(f"{name} cannot be written to {self.folder} ({reason}), nor to any temporary folder")
        return None

    def write_results(self, run: Run, rows: Sequence[dict[str, Any]], **more: Any) -> Path | None:
        """Write a run's results like :meth:`Run.write_results`, with all faults so far; return the file's path."""

        def put(folder: Path) -> Path:
            return run.at(folder).write_results(rows, faults=self.faults, **more)

        return self.write("results.json", put)

    def write_flights(self, flights: Sequence[Flight], preset: Preset) -> None:
        """Write the learned parameters, events and logs of flights; remove those of earlier flights."""
        with contextlib.suppress(OSError):
            clear_outputs(self.folder, self._inputs)
        self.write("the learner state", partial(write_learner_state, flights, preset))
        self.write("events.jsonl", partial(write_events, flights))
        self.write("the logs", partial(write_logs, flights))
