"""Processes of a live flight: started with a plan, deaf to Ctrl-C, which is the supervisor's to answer."""

import contextlib
import importlib
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any, BinaryIO

PYTHON = (sys.executable, "-P", "-m")
"""Runs a module of this package: what lies in the current folder has no part in it."""


def module_path() -> str:
    """Return where a process of this one finds modules: as this one does, but the current folder comes last.

    A module of the user's own may lie there. A ``numpy.py`` beside it is not taken for NumPy.
    """
    here, places = os.path.realpath(os.curdir), [place for place in sys.path if place]
    last = [place for place in places if os.path.realpath(place) == here]
    return os.pathsep.join([*(place for place in places if place not in last), *last[:1]])


def launch(main: str, plan: Any, complaints: Path, cores: set[int] | None = None) -> "subprocess.Popen[bytes]":
    """Start a process of this machine.

    Args:
        main: ``module:function`` that takes the plan.
        plan: What it is started with; it travels from this process to its own child and to nobody else.
        complaints: File for what it writes to its standard outputs.
        cores: Where it may run, from the start: importing is work, too. None for anywhere.

    Returns:
        The process.
    """
    # One thread: the arrays are small, and a pool of threads is late.
    quiet = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with _opened(complaints) as file:
        process = subprocess.Popen(
            [*PYTHON, "retrim.onboard.launch", main],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=file,
            start_new_session=True,
            env=os.environ | quiet | {"PYTHONPATH": module_path()},
        )
    if cores is not None and hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(process.pid, cores)
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin as pipe:  # it has died already; whoever waits will see
        pickle.dump(plan, pipe)
    return process


def _opened(complaints: Path) -> BinaryIO:
    """Open a file to append to it; where its folder cannot be written any more, what is said is lost."""
    try:
        complaints.parent.mkdir(parents=True, exist_ok=True)
        return complaints.open("ab")
    except OSError:
        return Path(os.devnull).open("ab")


def last_words(complaints: Path) -> str:
    """Return the last line that a process wrote to its standard outputs."""
    try:
        lines = complaints.read_text(errors="replace").strip().splitlines()
    except OSError:
        return "it left no word"
    return lines[-1] if lines else "without a word"


def main() -> None:
    """Read the plan and run."""
    module, _, name = sys.argv[1].partition(":")
    function = getattr(importlib.import_module(module), name)
    function(pickle.load(sys.stdin.buffer))  # the parent wrote it


if __name__ == "__main__":
    main()
