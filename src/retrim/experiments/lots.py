"""Flights that are flown at once, as one program."""

import threading
from collections.abc import Callable, Hashable, Iterable
from itertools import pairwise
from typing import NamedTuple

import jax

from .flights import FlightSpec
from .provenance import cores

LOT, LARGE = 64, 2048  # flights of one program: on one CPU, on one accelerator
SMALL = 2  # a flight by itself is stepped by Python, which uses one core however many there are


class Lot(NamedTuple):
    """Flights that are flown at once."""

    specs: list[FlightSpec]
    compiled: threading.Event | None
    """Set when the first lot of its program has compiled it; None for a flight by itself."""
    compiles: bool = False
    """It is the first lot of its program."""


def in_lots(groups: Iterable[list[FlightSpec]], program: Callable[[list[FlightSpec]], Hashable | None]) -> list[Lot]:
    """Divide flights into lots: those that are flown together, each other one by itself.

    The first lot of each program comes first: while it compiles, another program's does.

    Args:
        groups: Flights that differ in numbers of the vehicle, start and seed only.
        program: It tells the program of a group apart; None if its flights are flown one by one.
    """
    first, others = dict[Hashable, Lot](), list[Lot]()
    for group in groups:
        of_group = program(group)
        for part in _parts(group, 1 if of_group is None else min(largest(), max(SMALL, -(-len(group) // lanes())))):
            if len(part) == 1:
                others.append(Lot(part, None))
            elif (of_group, len(part)) in first:
                others.append(Lot(part, first[of_group, len(part)].compiled))
            else:
                first[of_group, len(part)] = Lot(part, threading.Event(), compiles=True)
    return [*first.values(), *others]


def _parts(group: list[FlightSpec], size: int) -> list[list[FlightSpec]]:
    """Divide a group; no flight is left over by itself."""
    bounds = [*range(0, len(group), size), len(group)]
    if size > 1 and len(bounds) > 2 and bounds[-1] - bounds[-2] == 1:
        del bounds[-2]
    return [group[a:b] for a, b in pairwise(bounds)]


def largest() -> int:
    """Return how many flights one program has at most, on all devices together."""
    return (LOT if jax.default_backend() == "cpu" else LARGE) * jax.device_count()


def lanes() -> int:
    """Return how many lots fly at once: one for each core, and one where several devices or an accelerator share it."""
    return cores() if jax.default_backend() == "cpu" and jax.device_count() == 1 else 1
