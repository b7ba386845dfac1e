"""A row of ``retrim bench``, and how one is timed."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from .machine import seconds, unit


@dataclass(frozen=True)
class Work:
    """One row of the bench."""

    title: str
    goal: str
    do: Callable[[], dict[str, Any]]
    """Returns compile_s, run_s and remarks."""
    paper: str = "-"
    """What the paper reports, on an RTX 4090."""
    cached: bool = False
    """Uses the bench's own persistent compile cache, empty at first."""
    one_core: bool = False
    """Is done on one core, too."""
    two_cores: bool = False
    """Needs two cores, and chooses among them."""


def timed(compile_s: float, run: Callable[[], Any], runs: int) -> dict[str, Any]:
    """The median of some runs, beside what compiling took, in seconds and in units of the machine.

    A unit is timed before and after each run, since machines are busy with other things, too.
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


def compiled(jitted: Any, *arguments: Any) -> tuple[Any, float]:
    """A jitted function compiled for its arguments, and the seconds that it took."""
    began = time.perf_counter()
    program = jitted.lower(*arguments).compile()
    return program, time.perf_counter() - began
