"""A controller as a NumPy program: source text and constants, made before take-off by :mod:`retrim.live.numpy_code`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import lax, threefry

Arrays = list[Any]
"""Leaves of a pytree, in its order: NumPy arrays and scalars."""


@dataclass(frozen=True)
class ProgramSource:
    """A program that travels to another process, once, at the start: Python source that this project wrote itself."""

    text: str
    """Two functions: ``prepare(parameters)``, called when they change, and ``step(prepared, inputs)``, each tick."""
    constants: dict[str, Any]


class NumpyProgram:
    """The two functions of a program."""

    def __init__(self, source: ProgramSource) -> None:
        scope: dict[str, Any] = {"np": np, "lax": lax, "threefry": threefry, **source.constants}
        exec(compile(source.text, "<controller>", "exec"), scope)  # never text from a message
        self._prepare: Callable[[Sequence[Any]], Arrays] = scope["prepare"]
        self._step: Callable[[Sequence[Any], Sequence[Any]], Arrays] = scope["step"]

    def prepare(self, parameters: Sequence[Any]) -> Arrays:
        """Return what depends on the parameters alone."""
        with np.errstate(all="ignore"):
            return self._prepare(parameters)

    def step(self, prepared: Sequence[Any], inputs: Sequence[Any]) -> Arrays:
        """Return the outputs of one evaluation; values that are not finite come out as they are, without a warning."""
        with np.errstate(all="ignore"):
            return self._step(prepared, inputs)
