"""The simulated plant: a model at 1 kHz with command delay, external effects and sensors."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array, Float, Key

from ..errors import PlantError
from ..physics.disturbance import Disturbance
from ..physics.state import Command, State
from ..physics.substep import SUBSTEP, AbstractSubstepDynamics
from .plant import Measurement, Plant, as_numpy, check_command, limited
from .sensors import SensorModel

FIRST_SAMPLE, INERTIAL = 2**31 - 1, 2**31 - 2  # folded into keys; no tick has these numbers


class SimState(eqx.Module):
    """Everything the simulation remembers."""

    model: Any
    """The model's own state."""
    queue: Command
    """Commands issued, oldest first; those that the delay still holds back, and the one acting."""
    samples: State
    """Samples of the state, oldest first: the one that has arrived, and those that the latency still holds back."""
    t: Float[Array, ""]
    """Time since the reset [s]."""
    a: Float[Array, "3"]
    """Mean acceleration over the last tick, world [m/s^2]."""


def launch(
    model: AbstractSubstepDynamics[Any], delay_s: float, sensors: SensorModel | None, x0: State, key: Key[Array, ""]
) -> SimState:
    """Return the state of a plant that hovers at ``x0``, with hover commands under way and one sample of ``x0``."""
    slots = -(-round(delay_s / SUBSTEP) // round(model.dt / SUBSTEP)) + 1
    queue = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (slots, *leaf.shape)), Command.hover())
    held = 1 if sensors is None else sensors.held
    sample = x0 if sensors is None else sensors.noisy(x0, random.fold_in(key, FIRST_SAMPLE))
    samples = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (held, *leaf.shape)), sample)
    return SimState(model.init(x0), queue, samples, jnp.zeros_like(x0.p[0]), jnp.zeros_like(x0.p))


def advance(
    model: AbstractSubstepDynamics[Any],
    disturbance: Disturbance,
    delay_s: float,
    sensors: SensorModel | None,
    s: SimState,
    u: Command,
    key: Key[Array, ""],
) -> SimState:
    """One control tick in steps of 1 ms; a command issued at the start of a tick acts ``delay`` seconds later."""
    per_tick, late = round(model.dt / SUBSTEP), round(delay_s / SUBSTEP)
    queue = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), s.queue, u)
    slots = queue.c.shape[0]
    # In the i-th millisecond, the newest command whose delay has passed is this many ticks old:
    ages = np.array([-(-max(0, late - i) // per_tick) for i in range(per_tick)])

    def millisecond(inner: Any, xs: tuple[Float[Array, ""], Command]) -> tuple[Any, State]:
        t, acting = xs
        after = model.substep(inner, acting, disturbance(t, model.state(inner)))
        return after, model.state(after)

    times = s.t + SUBSTEP * jnp.arange(per_tick, dtype=s.t.dtype)
    acting = jax.tree.map(lambda leaf: leaf[slots - 1 - ages], queue)
    inner, path = lax.scan(millisecond, s.model, (times, acting))
    if sensors is None:
        samples = jax.tree.map(lambda leaf: leaf[-1:], path)
    else:
        sampled = jax.tree.map(lambda leaf: leaf[sensors.period - 1 :: sensors.period], path)
        samples = sensors.received(s.samples, sampled, key)
    a = (model.state(inner).v - model.state(s.model).v) / model.dt
    return SimState(inner, queue, samples, s.t + model.dt, a)


def measured_state(s: SimState) -> State:
    """Return the newest sample that has arrived."""
    return jax.tree.map(lambda leaf: leaf[0], s.samples)  # type: ignore[no-any-return]


_launch = eqx.filter_jit(launch)
_advance = eqx.filter_jit(advance)


class SimPlant(Plant):
    """A model at 1 kHz as a :class:`retrim.Plant`."""

    def __init__(
        self,
        model: AbstractSubstepDynamics[Any],
        disturbance: Disturbance,
        *,
        delay_s: float = 0.02,
        sensors: SensorModel | None = None,
        seed: int = 0,
    ) -> None:
        """Build a plant.

        Args:
            model: The vehicle.
            disturbance: External effects as a function of time since the reset and state.
            delay_s: Command delay [s], a whole number of milliseconds.
            sensors: None: every measurement is exact.
            seed: Noise and dropouts of the sensors follow from it and the tick, so that a flight repeats.

        Raises:
            ValueError: The delay is no whole number of milliseconds, or a tick is no whole number of sensor periods.
        """
        if delay_s < 0 or abs(delay_s / SUBSTEP - round(delay_s / SUBSTEP)) > 1e-6:
            raise ValueError(f"SimPlant: delay_s = {delay_s} s must be a whole, non-negative number of milliseconds")
        if sensors is not None and round(model.dt / SUBSTEP) % sensors.period:
            raise ValueError(
                f"SimPlant: a tick of {model.dt} s is no multiple of the {sensors.period} ms of SensorModel"
            )
        self.dt = model.dt
        self._model, self._disturbance, self._delay_s, self._sensors = model, disturbance, delay_s, sensors
        limits = model.command_limits
        self._limits = None if limits is None else (as_numpy(limits[0]), as_numpy(limits[1]))
        self._key = random.key(seed)
        self._state: SimState | None = None
        self._ticks = 0

    def reset(self, x0: State | None) -> Measurement:
        """Hover at ``x0``; without one, 1 m above the ground."""
        start = State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        self._state = _launch(self._model, self._delay_s, self._sensors, start, self._key)
        self._ticks = 0
        return self._measurement(start if self._sensors is None else measured_state(self._state), start)

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Advance the model by one tick; commands beyond the vehicle's limits are clipped."""
        wanted = check_command(u, "SimPlant")
        if self._state is None:
            raise PlantError("SimPlant: not flying; call reset first")
        accepted = u if self._limits is None else limited(u, wanted, *self._limits)
        key = random.fold_in(self._key, self._ticks) if self._sensors is not None else self._key
        self._state = _advance(self._model, self._disturbance, self._delay_s, self._sensors, self._state, accepted, key)
        self._ticks += 1
        truth = self._model.state(self._state.model)
        return self._measurement(truth if self._sensors is None else measured_state(self._state), truth), accepted

    def _measurement(self, x: State, truth: State) -> Measurement:
        assert self._state is not None
        t, rotors, a = self._ticks * self.dt, self._model.rotor_state(self._state.model), self._state.a
        omega = None if rotors is None else rotors.omega
        speeds = None if rotors is None else rotors.motors
        if self._sensors is None:
            return Measurement(t, x, omega, a, speeds, truth=truth)
        if omega is not None:
            omega, a = _inertial(self._sensors, omega, a, random.fold_in(self._key, self._ticks))
        return Measurement(t, x, omega, a, speeds, age=1e-3 * self._sensors.latency, truth=truth)

    def stop(self) -> None:
        """Forget the flight."""
        self._state = None


@eqx.filter_jit
def _inertial(
    sensors: SensorModel, omega: Float[Array, "3"], a: Float[Array, "3"], key: Key[Array, ""]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    k_gyro, k_accelerometer = random.split(random.fold_in(key, INERTIAL))
    noise = random.normal(k_gyro, (3,), omega.dtype), random.normal(k_accelerometer, (3,), a.dtype)
    return omega + sensors.gyro * noise[0], a + sensors.accelerometer * noise[1]
