"""Pilots, which compute the command at each tick of a flight."""

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
from ..tasks.paced_reference import Clock
from .events import ROUNDING, Event


class Pilot(abc.ABC):
    """Flies one vehicle. A pilot may hold state."""

    dt: float | None = None
    """Control period for which the pilot was built [s]; None for any period."""

    @abc.abstractmethod
    def reset(self, measurement: Measurement) -> None:
        """Start a flight. Keep learned parameters, and drop the memory of earlier flights.

        Args:
            measurement: First measurement of the flight. Its time, on the plant's clock, is time zero of the flight.
        """

    @abc.abstractmethod
    def act(self, measurement: Measurement) -> Command:
        """Return the command for the next tick."""

    def warm_up(self, measurement: Measurement) -> None:
        """Compile every program before the first flight: run one tick and discard its command.

        Args:
            measurement: Measurement of the vehicle in any state.
        """
        self.reset(measurement)
        self.act(measurement)

    def accept(self, u: Command) -> None:
        """Receive the command ``u`` that the plant accepted instead of the command issued last."""
        del u

    def take_events(self) -> list[Event]:
        """Return the events since the last call, and clear them."""
        return []

    def task_time(self, t: float) -> float:
        """Return the time along the reference at flight time ``t`` [s]; by default, both times are equal.

        Args:
            t: Time since the start of the flight, at most one tick after the last command [s].
        """
        return t


class FunctionPilot(Pilot):
    """Pilot that calls a function of the measurement."""

    def __init__(self, function: Callable[[Measurement], Command]) -> None:
        self._function = function

    def reset(self, measurement: Measurement) -> None:
        """Do nothing, since a function does not have a memory."""

    def act(self, measurement: Measurement) -> Command:
        """Call the function."""
        return self._function(measurement)


class ControllerPilot(Pilot):
    """Pilot that calls a controller. ``controller`` may be replaced in flight; the new one takes over the memory.

    The pilot issues an event for each change of the controller's stage and for the identified vehicle.
    """

    def __init__(self, controller: AbstractController[Any]) -> None:
        self.controller = controller
        self._memory: Any = None
        self._start = 0.0
        self._stage = 0
        self._t = -1.0
        self._clock: Clock | None = None
        self._events: list[Event] = []

    def reset(self, measurement: Measurement) -> None:
        """Initialise the controller's memory."""
        self._memory, self._start = _begin(self.controller, measurement.x), measurement.t
        self._stage, self._t, self._clock, self._events = 0, -1.0, None, []

    def act(self, measurement: Measurement) -> Command:
        """Call the controller once, with the time since the start of the flight."""
        x = measurement.x
        t = jnp.asarray(measurement.t - self._start, dtype=x.p.dtype)
        controller = self.controller.with_age(measurement.age)
        if measurement.omega is not None and measurement.a is not None:
            controller = controller.with_inertial(measurement.omega, measurement.a)
        before = self._t
        u, self._memory, condition, vehicle, self._clock = _decide(controller, self._memory, t, x)
        self._t = float(t)
        self._note(self._t, condition)
        if vehicle is not None and any(before < at - ROUNDING <= self._t for at in REPORTS):
            self._events.append(Event(self._t, "vehicle", vehicle.note()))
        return u

    def accept(self, u: Command) -> None:
        """Correct the controller's memory of its last command."""
        self._memory = self.controller.accept(self._memory, u)

    def task_time(self, t: float) -> float:
        """Return the phase of the controller's clock; for a controller without a clock, return ``t``."""
        return t if self._clock is None else float(self._clock.phase_at(jnp.asarray(t, self._clock.t.dtype)))

    def take_events(self) -> list[Event]:
        """Return the events since the last call: changes of the controller's stage, and identified vehicles."""
        result, self._events = self._events, []
        return result

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
) -> tuple[Command, Any, Condition | None, VehicleReport | None, Clock | None]:
    u, memory = controller(memory, t, x)
    return u, memory, controller.condition(memory), controller.vehicle(memory), controller.clock(memory)
