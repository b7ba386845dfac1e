"""Pilots: what decides the next command of a flight, tick by tick."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..control.condition import Condition
from ..control.controller import AbstractController
from ..control.vehicle_report import REPORTS, VehicleReport
from ..physics.state import Command, State
from ..plants.plant import Measurement
from .events import ROUNDING, Event


class Pilot(abc.ABC):
    """Flies one vehicle. It may hold whatever it needs to."""

    dt: float | None = None
    """Control period that it was made for [s]; None for any."""

    @abc.abstractmethod
    def reset(self, measurement: Measurement) -> None:
        """Start a flight. What was learnt before stays; what was remembered of an earlier flight does not.

        Args:
            measurement: The first one of the flight. Its time, by the plant's clock, is the flight's time zero.
        """

    @abc.abstractmethod
    def act(self, measurement: Measurement) -> Command:
        """Return the command for the next tick."""

    def warm_up(self, measurement: Measurement) -> None:
        """Compile every program of a flight, before the first one: by a tick that nobody flies.

        Args:
            measurement: Of any state of the vehicle.
        """
        self.reset(measurement)
        self.act(measurement)

    def accepted(self, u: Command) -> None:
        """Take note that the plant accepted ``u`` instead of the command that was issued last."""
        del u

    def take_events(self) -> list[Event]:
        """Return what happened since the last call, and forget it."""
        return []


class FunctionPilot(Pilot):
    """Any function of the measurement as a pilot."""

    def __init__(self, function: Callable[[Measurement], Command]) -> None:
        self._function = function

    def reset(self, measurement: Measurement) -> None:
        """Do nothing: a function remembers nothing."""

    def act(self, measurement: Measurement) -> Command:
        """Call the function."""
        return self._function(measurement)


class ControllerPilot(Pilot):
    """Any controller as a pilot. ``controller`` may be replaced in flight; its memory goes on.

    Each change of the controller's stage is an event, and so is the vehicle that it has identified.
    """

    def __init__(self, controller: AbstractController[Any]) -> None:
        self.controller = controller
        self._memory: Any = None
        self._start = 0.0
        self._stage = 0
        self._t = -1.0
        self._events: list[Event] = []

    def reset(self, measurement: Measurement) -> None:
        """Initialise the controller's memory."""
        self._memory, self._start = _begin(self.controller, measurement.x), measurement.t
        self._stage, self._t, self._events = 0, -1.0, []

    def act(self, measurement: Measurement) -> Command:
        """Call the controller once, with the time since the start of the flight."""
        x = measurement.x
        t = jnp.asarray(measurement.t - self._start, dtype=x.p.dtype)
        controller = self.controller.with_age(measurement.age)
        if measurement.omega is not None and measurement.a is not None:
            controller = controller.with_inertial(measurement.omega, measurement.a)
        before = self._t
        u, self._memory, condition, vehicle = _decide(controller, self._memory, t, x)
        self._t = float(t)
        self._note(self._t, condition)
        if vehicle is not None and any(before < at - ROUNDING <= self._t for at in REPORTS):
            self._events.append(Event(self._t, "vehicle", vehicle.note()))
        return u

    def accepted(self, u: Command) -> None:
        """Correct the controller's memory of its last command."""
        self._memory = self.controller.accepted(self._memory, u)

    def take_events(self) -> list[Event]:
        """Return the changes of the controller's stage since the last call."""
        found, self._events = self._events, []
        return found

    def _note(self, t: float, condition: Condition | None) -> None:
        if condition is not None and int(condition.stage) != self._stage:
            self._stage = int(condition.stage)
            self._events.append(Event(t, "stage", condition.note()))


@eqx.filter_jit
def _begin(controller: AbstractController[Any], x: State) -> Any:
    return controller.init(x)


@eqx.filter_jit
def _decide(
    controller: AbstractController[Any], memory: Any, t: Float[Array, ""], x: State
) -> tuple[Command, Any, Condition | None, VehicleReport | None]:
    u, memory = controller(memory, t, x)
    return u, memory, controller.condition(memory), controller.vehicle(memory)
