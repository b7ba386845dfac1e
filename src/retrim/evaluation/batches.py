"""Divides flights into batches, each of which runs as one program."""

import threading
from collections.abc import Callable, Hashable, Iterable
from itertools import pairwise
from typing import NamedTuple

import jax

from ..runkit.flights import FlightSpec
from ..runkit.provenance import cores

CPU_LIMIT, ACCELERATOR_LIMIT = 64, 2048  # largest number of flights in one program: on a CPU, on an accelerator
SMALLEST_BATCH = 2  # smallest batch; Python steps a single flight, which uses only one core


class FlightBatch(NamedTuple):
    """A batch of flights."""

    specs: list[FlightSpec]
    compiled: threading.Event | None
    """Set when the first batch of the same program has compiled it; None for a single flight."""
    compiles: bool = False
    """Whether this is the first batch of its program."""


def in_batches(
    groups: Iterable[list[FlightSpec]], program: Callable[[list[FlightSpec]], Hashable | None]
) -> list[FlightBatch]:
    """Divide flights into batches; flights that cannot share a program run individually.

    The first batches of all programs come before the others, so that different programs compile at the same time.

    Args:
        groups: Groups of flights that differ only in the vehicle's numbers, the start and the seed.
        program: Returns a key that identifies a group's program; None if its flights run one by one.
    """
    first, others = dict[Hashable, FlightBatch](), list[FlightBatch]()
    for group in groups:
        of_group = program(group)
        for part in _parts(
            group, 1 if of_group is None else min(largest(), max(SMALLEST_BATCH, -(-len(group) // lanes())))
        ):
            if len(part) == 1:
                others.append(FlightBatch(part, None))
            elif (of_group, len(part)) in first:
                others.append(FlightBatch(part, first[of_group, len(part)].compiled))
            else:
                first[of_group, len(part)] = FlightBatch(part, threading.Event(), compiles=True)
    return [*first.values(), *others]


def _parts(group: list[FlightSpec], size: int) -> list[list[FlightSpec]]:
    """Divide a group into parts of ``size`` flights; a single remaining flight joins the previous part."""
    bounds = [*range(0, len(group), size), len(group)]
    if size > 1 and len(bounds) > 2 and bounds[-1] - bounds[-2] == 1:
        del bounds[-2]
    return [group[a:b] for a, b in pairwise(bounds)]


def largest() -> int:
    """Return the largest number of flights in one program, on all devices together."""
    return (CPU_LIMIT if jax.default_backend() == "cpu" else ACCELERATOR_LIMIT) * jax.device_count()


def lanes() -> int:
    """Return the number of concurrent batches: one per core, or one for several devices or an accelerator."""
    return cores() if jax.default_backend() == "cpu" and jax.device_count() == 1 else 1
