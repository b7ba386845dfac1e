"""The folder of a run: created once, results written whole, an interruption remembered."""

import contextlib
import json
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from datetime import datetime
from pathlib import Path
from typing import Any

from ..io.files import check_writable, write_whole
from .provenance import code, command_line, commit, describe_hardware, versions
from .stopwatch import Stopwatch

SCHEMA = "retrim.results/2"
PARTS = "sections"
"""Folder of the parts of a run that are finished, whatever happens to the rest."""
INTERRUPTED = 130  # exit code


class Run:
    """Folder, stopwatch and stop token of one command.

    ``stop`` is set by the first Ctrl-C, also where the KeyboardInterrupt itself is lost; long work looks at it.
    """

    def __init__(
        self,
        command: str,
        out: Path | None = None,
        *,
        stop: threading.Event | None = None,
        remark: str = "",
        trained: Path | None = None,
        executor: Executor | None = None,
    ) -> None:
        """Choose the folder and check that it can be written.

        Args:
            command: Names the folder if ``out`` is None: a new one under ``runs/``.
            out: The folder.
            stop: Set when the run should end early.
            remark: What its documents say of how they were made.
            trained: Folder of what is trained, for several runs; the run's own by default.
            executor: Who trains and flies, in other processes; by default this one does.

        Raises:
            ConfigError: The folder cannot be written.
        """
        self.folder = out or Path("runs") / f"{command}-{datetime.now():%Y%m%d-%H%M%S}"
        self.remark = remark
        self.trained = trained or self.folder
        self.executor, self.failed = executor, False
        self.pages: list[Path] = []  # that its documents have written
        self.watch = Stopwatch()
        self.taken_over = 0
        """Parts, and groups of flights, that an earlier run had made."""
        self.stop = stop or threading.Event()
        commit(), code()  # as they are now: the run may last for hours
        check_writable(self.folder)

    def of_earlier(self) -> str:
        """Return what becomes of what lies in the folder, in a line; empty if there is nothing."""
        if any((self.folder / PARTS).glob("*")):
            return f"results in {self.folder}: what the same code made there of the same things stays, the rest goes"
        return f"results in {self.folder} are replaced" if any(self.folder.glob("*.json")) else ""

    @property
    def interrupted(self) -> bool:
        """Whether the run was told to end early."""
        return self.stop.is_set()

    @property
    def exit_code(self) -> int:
        """0; 130 for a run that was interrupted, 1 for one of which a part failed."""
        return INTERRUPTED if self.interrupted else int(self.failed)

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Let a Ctrl-C end the block early, and be remembered, instead of raising further."""
        try:
            yield
        except KeyboardInterrupt:
            self.stop.set()

    def write_text(self, name: str, text: str) -> Path:
        """Write a file of the folder, whole; return its path."""
        path = self.folder / name
        write_whole(path, text)
        return path

    def write_results(
        self, rows: Sequence[dict[str, Any]], *, seeds: Sequence[int], name: str = "results", **more: Any
    ) -> Path:
        """Write ``<name>.json`` with rows, provenance and times; return its path."""
        compiling = self.watch.compile_s
        results = {
            "schema": SCHEMA,
            "command": command_line(sys.argv[1:]),
            "commit": commit(),
            "code": code(),
            "versions": versions(),
            "device": describe_hardware(),
            "seeds": list(seeds),
            "compile_s": round(compiling, 3),
            "run_s": round(self.watch.total_s - compiling, 3),
            "interrupted": self.interrupted,
            "rows": list(rows),
            **more,
        }
        return self.write_text(f"{name}.json", json.dumps(results, indent=2) + "\n")
