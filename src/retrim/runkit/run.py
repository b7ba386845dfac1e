"""Manages a run's folder: creates it once, writes files atomically, and records an interruption."""

import contextlib
import copy
import json
import os
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from datetime import datetime
from pathlib import Path
from typing import Any

from ..io.files import check_writable, write_whole
from .provenance import code, command_line, commit, describe_hardware, versions
from .reporter import Reporter
from .stopwatch import Stopwatch
from .store import Store

SCHEMA = "retrim.results/2"
PARTS = "sections"
"""Folder for a run's finished parts, which an interruption does not affect."""
INTERRUPTED = 130  # exit code


class Run:
    """The folder, stopwatch and stop token of one command.

    The first Ctrl-C sets ``stop``, even if the KeyboardInterrupt itself is lost; long computations poll ``stop``.
    """

    def __init__(
        self,
        command: str,
        out: Path | None = None,
        *,
        stop: threading.Event | None = None,
        remark: str = "",
        policy_folder: Path | None = None,
        executor: Executor | None = None,
        inputs: Iterable[Path | None] = (),
    ) -> None:
        """Choose the folder and check that it can be written.

        Args:
            command: Name of the command; if ``out`` is None, it and the time name a new folder under ``runs/``.
            out: The folder.
            stop: Set when the run should end early.
            remark: Remark in the documents on how they were made.
            policy_folder: Folder for trained networks, which several runs may share; by default the run's own folder.
            executor: Executor with other processes for training and flights; by default this process does both.
            inputs: Files that the command reads, which must not be removed from the folder.

        Raises:
            ConfigError: The folder cannot be written.
        """
        # Two commands may begin within the same second.
        self.folder = out or Path("runs") / f"{command}-{datetime.now():%Y%m%d-%H%M%S}-{os.getpid()}"
        self.inputs = tuple(path.resolve() for path in inputs if path is not None)
        self.remark = remark
        self.policy_folder = policy_folder or self.folder
        self.executor, self.failed = executor, False
        self.pages: list[Path] = []  # pages that its documents have written
        self.watch = Stopwatch()
        self.reused = 0
        """Number of parts and groups of flights that were taken from an earlier run."""
        self.stop = stop or threading.Event()
        commit(), code()  # cached now, since the files may change during a run that takes hours
        check_writable(self.folder)

    def at(self, folder: Path) -> "Run":
        """Return this run with another folder."""
        result = copy.copy(self)
        result.folder = folder
        return result

    def describe_earlier(self) -> str:
        """Return a line on whether the run resumes or replaces earlier results; empty if the folder has none."""
        if any((self.folder / PARTS).glob("*")):
            return f"results in {self.folder}: parts of the same code and settings are used again, others are replaced"
        return f"results in {self.folder} will be replaced" if any(self.folder.glob("*.json")) else ""

    def store(self, reporter: Reporter | None = None) -> Store:
        """Return the store of the run's parts in its folder; ``reporter`` receives lines about unusable files."""
        return Store(self.folder, reporter=reporter, stop=self.stop)

    def reuse(self, part: str, reporter: Reporter) -> None:
        """Count a part that an earlier run has made, and report it."""
        self.reused += 1
        reporter.say(f"{part}: taken from an earlier run in this folder")

    @property
    def interrupted(self) -> bool:
        """Whether the run was stopped early."""
        return self.stop.is_set()

    @property
    def exit_code(self) -> int:
        """Exit code: 0 for success, 130 after an interruption, 1 if a part failed."""
        return INTERRUPTED if self.interrupted else int(self.failed)

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Let Ctrl-C end the block early and set ``stop``, without propagating the exception."""
        try:
            yield
        except KeyboardInterrupt:
            self.stop.set()

    def write_text(self, name: str, text: str) -> Path:
        """Write a file in the folder atomically; return its path."""
        path = self.folder / name
        write_whole(path, text)
        return path

    def write_results(
        self, rows: Sequence[dict[str, Any]], *, seeds: Sequence[int], name: str = "results", **more: Any
    ) -> Path:
        """Write ``<name>.json`` with the rows, provenance and times; return its path."""
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
