"""Reject numbers in a wrong unit, with messages that suggest the probable unit."""

from collections.abc import Callable, Iterable
from typing import Annotated

from pydantic import Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Three = tuple[Positive, Positive, Positive]


def at_most(largest: float, unit: str, *others: tuple[str, float]) -> Callable[[float], float]:
    """Return a validator that rejects larger numbers, and suggests a different unit if the number is plausible in it.

    Args:
        largest: Largest accepted value.
        unit: Unit of the value.
        others: Units that are easily confused with ``unit``, in order of preference: name, and size in ``unit``.
    """

    def validate(value: float) -> float:
        if value <= largest:
            return value
        units = (
            (f"is it in {name}? {value:g} {name} are {value * one:.3g} {unit}", value * one) for name, one in others
        )
        raise ValueError(f"Input should be less than or equal to {largest:g} {unit}{likely(units, 0.0, largest)}")

    return validate


def likely(questions: Iterable[tuple[str, float]], least: float, most: float) -> str:
    """Return a semicolon and the first question whose number is within the bounds, or an empty string."""
    return next((f"; {question}" for question, value in questions if least <= value <= most), "")
