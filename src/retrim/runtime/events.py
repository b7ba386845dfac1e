"""Events and observers of a flight."""

from typing import NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Float

from ..adapt.updates import KINDS, Update
from ..control.condition import Condition, describe_condition
from ..control.vehicle_report import REPORTS, VehicleReport
from ..physics.state import Command
from ..plants.plant import Measurement

ROUNDING = 1e-3  # [s]


class Event(NamedTuple):
    """An action of the adaptation, or the termination of the flight."""

    t: float
    """Time at which the event became visible, since the start of the flight [s]."""
    kind: str
    """``residual``, ``policy``, ``rejected`` (a result that must not be used), ``skipped`` (the learner was busy),
    ``stage`` (the controller stepped back or returned), ``vehicle`` (the identified vehicle) or ``terminated``."""
    note: str
    """One-line description."""

    @classmethod
    def of(cls, t: float, update: Update) -> "Event":
        """Return the event of an update that became visible at time ``t`` [s] of the flight."""
        return cls(t, KINDS[type(update)], update.note())


def stage_events(conditions: Condition | None, t: Float[np.ndarray, " n"]) -> list[Event]:
    """Return an event for each change of a controller's stage.

    Args:
        conditions: Condition at each tick (leading axis n); None for a controller that never steps back.
        t: Times of the ticks since the start of the flight [s].
    """
    if conditions is None:
        return []
    stages, causes = np.asarray(conditions.stage), np.asarray(conditions.cause)
    changes = np.flatnonzero(np.diff(stages, prepend=0))
    return [Event(float(t[k]), "stage", describe_condition(int(stages[k]), int(causes[k]))) for k in changes]


def vehicle_events(vehicles: VehicleReport | None, t: Float[np.ndarray, " n"]) -> list[Event]:
    """Return the events that report the identified vehicle.

    Args:
        vehicles: Vehicle at each tick (leading axis n); None for a controller that does not identify the vehicle.
        t: Times of the ticks since the start of the flight [s].
    """
    if vehicles is None:
        return []
    ticks = [int(np.searchsorted(t, at - ROUNDING)) for at in REPORTS]
    rows = [(k, jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], vehicles)) for k in ticks if k < len(t)]
    return [Event(float(t[k]), "vehicle", row.note()) for k, row in rows]


@runtime_checkable
class Observer(Protocol):
    """Follows a flight; its methods must not block."""

    def measurement(self, measurement: Measurement, u: Command) -> None:
        """Receive each measurement and the command accepted for the tick that ends with it (hover for the first)."""
        ...

    def event(self, event: Event) -> None:
        """Receive each event."""
        ...
