"""Define and time a row of ``retrim bench``."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from .machine import seconds, unit


@dataclass(frozen=True)
class Work:
    """One row of ``retrim bench``."""

    title: str
    goal: str
    do: Callable[[], dict[str, Any]]
    """Function that returns ``compile_s``, ``run_s`` and ``remarks``."""
    paper: str = "-"
    """Time reported in the paper, on an RTX 4090."""
    cached: bool = False
    """Whether the benchmark uses the persistent compile cache of ``retrim bench``, which is empty at first."""
    one_core: bool = False
    """Whether the benchmark also runs on one core."""
    two_cores: bool = False
    """Whether the benchmark needs two cores and the right to choose between them."""


def time_runs(compile_s: float, run: Callable[[], Any], runs: int) -> dict[str, Any]:
    """Return the median time of several runs in seconds and in machine units, and the compile time.

    The unit is timed before and after each run, because other processes may load the machine.
    """
    now = unit()
    units, took = [now()], []
    for _ in range(runs):
        took.append(seconds(run))
        units.append(now())
    ratios = [2.0 * each / (before + after) for each, (before, after) in zip(took, pairwise(units), strict=True)]
    spread = f"{min(took):.3g} to {max(took):.3g} s in {runs} runs" if runs > 1 else "1 run"
    about = {"unit_s": statistics.median(units), "units": statistics.median(ratios)}
    return {"compile_s": compile_s, "run_s": statistics.median(took), **about, "remarks": spread}


def compile_function(jitted: Any, *arguments: Any) -> tuple[Any, float]:
    """Return a jitted function, compiled for the given arguments, and the compile time [s]."""
    began = time.perf_counter()
    program = jitted.lower(*arguments).compile()
    return program, time.perf_counter() - began
