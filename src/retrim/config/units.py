"""Numbers in a wrong unit: refused, with the unit that they are likely in."""

from collections.abc import Callable, Iterable
from typing import Annotated

from pydantic import Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Three = tuple[Positive, Positive, Positive]


def at_most(largest: float, unit: str, *others: tuple[str, float]) -> Callable[[float], float]:
    """Return a validator that refuses larger numbers, and says what they would be in another unit.

    Args:
        largest: What is accepted.
        unit: Its unit.
        others: Units that are easily taken for it, in order: the name, and how many of ``unit`` one is.
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
    """Return the first question whose number lies within bounds, after a semicolon; nothing if there is none."""
    return next((f"; {question}" for question, value in questions if least <= value <= most), "")
