"""The simulated plant: a model at 1 kHz with command delay, external effects and sensors."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array, ArrayLike, Float, Int, Key

from ..errors import PlantError
from ..physics.command_path import LONGEST_DELAY, CommandQueue, check_delay
from ..physics.disturbance import Disturbance, SumOfDisturbances, advance, start, stateful_parts
from ..physics.effects import ExternalEffects
from ..physics.state import Command, State
from ..physics.substep import SUBSTEP, AbstractSubstepDynamics
from .measurement_faults import AbstractMeasurementFault
from .plant import Measurement, Plant, as_numpy, check_command, limit_command
from .sensors import AbstractSensors

FIRST_SAMPLE, INERTIAL, FAULT = 2**31 - 1, 2**31 - 2, 2**31 - 3  # folded into keys; no tick has these numbers


class Reports(eqx.Module):
    """Memory of a faulty measurement system."""

    past: State
    """Correct measurements, oldest first."""
    reported: State
    """State that is reported instead of the newest one."""


class SimState(eqx.Module):
    """State of the simulation."""

    model: Any
    """State of the model."""
    queue: CommandQueue
    """Issued commands, including those that have already acted."""
    samples: Any
    """Memory of the sensors; without sensors, the true state."""
    a: Float[Array, "3"]
    """Mean acceleration over the last tick in the world frame [m/s^2]."""
    reports: Reports | None = None
    """Memory of the measurement fault, if any."""
    disturbance: tuple[Any, ...] = ()
    """States of those parts of the disturbance that have one, such as a load on a cable."""


class Simulation(eqx.Module):
    """The constant part of a simulated plant; a flight is a pure function of it, the initial state and the commands."""

    model: AbstractSubstepDynamics[Any]
    """The vehicle."""
    disturbance: Disturbance
    """External effects, as a function of the time since the start of the flight and the state."""
    sensors: AbstractSensors[Any] | None
    """Sensors; without them, measurements are exact."""
    key: Key[Array, ""]
    """Seed of noise and dropouts; they depend only on the seed and the tick, so a flight is reproducible."""
    delay: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.02))
    """Transport delay of commands [s]; a change does not cause recompilation."""
    fault: AbstractMeasurementFault | None = None
    """Measurement fault, if any."""
    longest_delay: float = eqx.field(static=True, default=LONGEST_DELAY)
    """Longest delay that the command queue can hold [s]."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the delay is impossible or a tick is not a whole number of samples."""
        check_delay(self.delay, self.longest_delay, "Simulation")
        if self.sensors is not None and round(self.model.dt / SUBSTEP) % self.sensors.period:
            raise ValueError(
                f"SimPlant: a tick of {self.model.dt} s is not a multiple of "
                f"the {self.sensors.period} ms of {type(self.sensors).__name__}"
            )

    @property
    def age(self) -> float:
        """Age of measurements [s]."""
        return 0.0 if self.sensors is None else self.sensors.age

    def without_disturbances(self) -> "Simulation":
        """Return a copy without those parts of the disturbance that have no state; a launch does not need them."""
        parts = stateful_parts(self.disturbance)
        return dataclasses.replace(self, disturbance=SumOfDisturbances(parts) if parts else _calm)

    def launch(self, x0: State) -> SimState:
        """Return the state of a plant that hovers at ``x0``, with queued hover commands and one sample of ``x0``."""
        queue = CommandQueue.of(Command.hover(x0.p.dtype), self.model.dt, longest=self.longest_delay)
        samples = x0 if self.sensors is None else self.sensors.init(x0, random.fold_in(self.key, FIRST_SAMPLE))
        sample = self._measure(samples)
        reports = None
        if self.fault is not None:
            rows = self.fault.memory + 1
            reports = Reports(jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (rows, *leaf.shape)), sample), sample)
        return SimState(self.model.init(x0), queue, samples, jnp.zeros_like(x0.p), reports, start(self.disturbance, x0))

    def advance(self, s: SimState, u: Command, tick: Int[ArrayLike, ""]) -> SimState:
        """Return the state one control tick later, computed in steps of 1 ms.

        ``u`` takes effect :attr:`delay` after the start of the tick. In the millisecond in which the acting command
        changes, the mean of the two commands acts.

        Args:
            s: State at the start of the tick.
            u: Command, within the vehicle's limits.
            tick: Number of the tick, counted from the start of the flight.
        """
        per_tick, queue = round(self.model.dt / SUBSTEP), s.queue.push(u)

        def millisecond(carry: tuple[Any, Any], xs: tuple[Float[Array, ""], Command]) -> tuple[tuple[Any, Any], State]:
            (inner, outer), (t, acting) = carry, xs
            effects, outer = advance(self.disturbance, outer, t, self.model.state(inner), SUBSTEP)
            after = self.model.substep(inner, acting, effects)
            return (after, outer), self.model.state(after)

        times = self.time(tick, s.a.dtype) + SUBSTEP * jnp.arange(per_tick, dtype=s.a.dtype)
        acting = queue.substeps(self.delay, self.model.dt, per_tick)
        (inner, outer), path = lax.scan(millisecond, (s.model, s.disturbance), (times, acting))
        a = (self.model.state(inner).v - self.model.state(s.model).v) / self.model.dt
        if (sensors := self.sensors) is None:
            samples = jax.tree.map(lambda leaf: leaf[-1], path)
        else:
            xs = jax.tree.map(lambda leaf: leaf[sensors.period - 1 :: sensors.period], path)
            rates, key = self.model.body_rates(inner), random.fold_in(self.key, tick)
            samples = sensors.sample(s.samples, xs, rates, a, self.model.dt, key)
        reports = self._reports(s.reports, samples, jnp.asarray(tick) + 1)
        return SimState(inner, queue, samples, a, reports, outer)

    def _measure(self, samples: Any) -> State:
        return samples if self.sensors is None else self.sensors.state(samples)

    def _reports(self, before: Reports | None, samples: Any, tick: Int[Array, ""]) -> Reports | None:
        if before is None or self.fault is None:
            return None
        new_state = self._measure(samples)
        past = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), before.past, new_state)
        key = random.fold_in(random.fold_in(self.key, tick), FAULT)
        return Reports(past, self.fault(past, tick, key))

    def time(self, tick: Int[ArrayLike, ""], dtype: Any) -> Float[Array, ""]:
        """Return the time since the start of the flight [s].

        The time is not accumulated, since a sum would drift in single precision.
        """
        return jnp.asarray(tick, dtype) * self.model.dt

    def measure(self, s: SimState) -> State:
        """Return the newest sample that has arrived, as the measurement system reports it."""
        if s.reports is not None:
            return s.reports.reported
        return self._measure(s.samples)

    def inertial(self, s: SimState, tick: Int[ArrayLike, ""]) -> tuple[Float[Array, "3"], Float[Array, "3"]] | None:
        """Return the measured body rates [rad/s] and world acceleration [m/s^2]; None for a model without body rates.

        Args:
            s: State at the end of a tick.
            tick: Number of ticks since the start of the flight.
        """
        rates = self.model.body_rates(s.model)
        if rates is None or self.sensors is None:
            return None if rates is None else (rates, s.a)
        key = random.fold_in(random.fold_in(self.key, tick), INERTIAL)
        return self.sensors.inertial(s.samples, rates, s.a, key)

    def true(self, s: SimState) -> State:
        """Return the vehicle's true state."""
        return self.model.state(s.model)

    def within_limits(self, u: Command) -> Command:
        """Return ``u`` clipped to the vehicle's limits."""
        return u if self.model.command_limits is None else u.within(*self.model.command_limits)


def _calm(t: Float[Array, ""], x: State) -> ExternalEffects:
    del t
    return ExternalEffects.calm(x.p.dtype)


_launch = eqx.filter_jit(Simulation.launch)
_advance = eqx.filter_jit(Simulation.advance)
_inertial: Any = eqx.filter_jit(Simulation.inertial)


class SimPlant(Plant):
    """A :class:`retrim.Plant` that simulates a model at 1 kHz."""

    def __init__(
        self,
        model: AbstractSubstepDynamics[Any],
        disturbance: Disturbance,
        *,
        delay_s: float = 0.02,
        sensors: AbstractSensors[Any] | None = None,
        fault: AbstractMeasurementFault | None = None,
        seed: int = 0,
    ) -> None:
        """Build a simulated plant.

        Args:
            model: The vehicle.
            disturbance: External effects, as a function of the time since the reset and the state.
            delay_s: Transport delay of commands [s].
            sensors: Sensors; by default, measurements are exact.
            fault: Measurement fault; by default, measurements are correct.
            seed: Seed of sensor noise and dropouts; they depend only on the seed and the tick, so a flight is
                reproducible.

        Raises:
            ValueError: The delay is negative, or a tick is not a whole number of sensor periods.
        """
        if not 0.0 <= delay_s < math.inf:
            raise ValueError(f"SimPlant: delay_s = {delay_s} s must be a finite, non-negative number of seconds")
        longest = max(LONGEST_DELAY, delay_s)
        self.simulation = Simulation(
            model, disturbance, sensors, random.key(seed), jnp.array(float(delay_s)), fault, longest
        )
        self.dt = model.dt
        limits = model.command_limits
        self._limits = None if limits is None else (as_numpy(limits[0]), as_numpy(limits[1]))
        self._state: SimState | None = None
        self._ticks = 0

    def reset(self, x0: State | None) -> Measurement:
        """Start hovering at ``x0``, or 1 m above the ground if ``x0`` is None."""
        start = State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        self._state = _launch(self.simulation.without_disturbances(), start)  # one compilation for all disturbances
        self._ticks = 0
        return self._measurement()

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Advance the model by one tick; commands beyond the vehicle's limits are clipped."""
        command = check_command(u, "SimPlant")
        if self._state is None:
            raise PlantError("SimPlant: not flying; call reset first")
        accepted_command = u if self._limits is None else limit_command(u, command, *self._limits)
        fault = self.simulation.fault
        while True:
            self._state = _advance(self.simulation, self._state, accepted_command, np.int32(self._ticks))
            self._ticks += 1
            if fault is None or not fault.is_missing(self._ticks):
                break  # in a measurement gap, the vehicle continues with the last command
        return self._measurement(), accepted_command

    def disturb(self, disturbance: Disturbance) -> None:
        """Change the disturbance in flight; new parameters of the same kind do not cause recompilation.

        The states of its parts continue if they have the same structure; otherwise, they begin anew.
        """
        self.simulation = dataclasses.replace(self.simulation, disturbance=disturbance)
        if (s := self._state) is not None:
            states = start(disturbance, self.simulation.true(s))
            structures: list[Any] = [jax.tree.structure(each) for each in (states, s.disturbance)]
            if structures[0] != structures[1]:
                self._state = dataclasses.replace(s, disturbance=states)

    def _measurement(self) -> Measurement:
        assert self._state is not None
        simulation, state = self.simulation, self._state
        t = self._ticks * self.dt + (0.0 if simulation.fault is None else simulation.fault.clock_error(self._ticks))
        truth, rotors = simulation.true(state), simulation.model.rotor_state(state.model)
        rates, speeds = simulation.model.body_rates(state.model), None if rotors is None else rotors.motors
        if simulation.sensors is None:
            x = simulation.measure(state)
            return Measurement(t, x, rates, state.a, speeds, truth=truth)
        omega, a = None, state.a
        if rates is not None:
            omega, a = _inertial(simulation.without_disturbances(), state, np.int32(self._ticks))
        return Measurement(t, simulation.measure(state), omega, a, speeds, age=simulation.age, truth=truth)

    def stop(self) -> None:
        """Discard the flight state."""
        self._state = None
