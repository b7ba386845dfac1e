"""A row of ``retrim bench``, and how one is timed."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax


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


def timed(compile_s: float, run: Callable[[], Any], runs: int) -> dict[str, Any]:
    """The median of some runs, beside what compiling took."""
    seconds = []
    for _ in range(runs):
        began = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - began)
    spread = f"{min(seconds):.3g} to {max(seconds):.3g} s in {runs} runs" if runs > 1 else "1 run"
    return {"compile_s": compile_s, "run_s": statistics.median(seconds), "remarks": spread}


def compiled(jitted: Any, *arguments: Any) -> tuple[Any, float]:
    """A jitted function compiled for its arguments, and the seconds that it took."""
    began = time.perf_counter()
    program = jitted.lower(*arguments).compile()
    return program, time.perf_counter() - began
