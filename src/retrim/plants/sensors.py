"""Sensors: their interface, and a model of an inertial unit with noisy, late and lost state samples at a fixed rate."""

import abc
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Bool, Float, Key

from ..physics import so3
from ..physics.state import State, where

M = TypeVar("M")


class AbstractSensors(eqx.Module, Generic[M]):
    """Sensors of a simulated vehicle, with the estimator that makes a state from their samples. ``M`` is its memory."""

    @property
    @abc.abstractmethod
    def period(self) -> int:
        """Time between the true states that the sensors receive [ms]; a tick is a multiple of it."""

    @property
    def age(self) -> float:
        """Age of a measurement at the end of a tick [s]; by default 0."""
        return 0.0

    @abc.abstractmethod
    def init(self, x: State, key: Key[Array, ""]) -> M:
        """Return the memory of a vehicle that hovers at ``x``; the key is consumed."""

    @abc.abstractmethod
    def sample(
        self,
        memory: M,
        xs: State,
        omega: Float[Array, "3"] | None,
        a: Float[Array, "3"],
        dt: float,
        key: Key[Array, ""],
    ) -> M:
        """Return the memory after a tick.

        Args:
            memory: Memory at the start of the tick.
            xs: True states in the tick, one per :attr:`period` (leading axis).
            omega: True body rates at the end of the tick [rad/s]; None for a plant without body rates.
            a: True mean acceleration in the tick, world [m/s^2].
            dt: Length of the tick [s].
            key: Random key, consumed.
        """

    @abc.abstractmethod
    def state(self, memory: M) -> State:
        """Return the measured state."""

    @abc.abstractmethod
    def inertial(
        self, memory: M, omega: Float[Array, "3"], a: Float[Array, "3"], key: Key[Array, ""]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Return the measured body rates [rad/s] and acceleration, world [m/s^2].

        Args:
            memory: Memory after the tick.
            omega: True body rates [rad/s].
            a: True mean acceleration in the tick, world [m/s^2].
            key: Random key, consumed.
        """


class SensorModel(AbstractSensors[State]):
    """Model of a motion-capture system or a state estimator, by default at 100 Hz as in the paper."""

    position: Float[Array, ""]
    """Standard deviation of the position per axis [m]."""
    velocity: Float[Array, ""]
    """Standard deviation of the velocity per axis [m/s]."""
    attitude: Float[Array, ""]
    """Standard deviation of the attitude about each body axis [rad]."""
    dropout: Float[Array, ""]
    """Probability that a sample is lost; the previous sample is then reused."""
    latency: int = eqx.field(static=True)
    """Age of a sample at its arrival [ms]; :attr:`age` is its age at the end of a tick."""
    period: int = eqx.field(static=True, default=10)
    """Time between samples [ms]."""
    gyro: float = eqx.field(static=True, default=0.0)
    """Standard deviation of the body rates per axis [rad/s]; the inertial unit has no latency."""
    accelerometer: float = eqx.field(static=True, default=0.0)
    """Standard deviation of the acceleration per axis [m/s^2]."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if a deviation or time is negative, or the probability is not in [0, 1)."""
        if self.latency < 0 or self.period < 1:
            raise ValueError(f"SensorModel: latency = {self.latency} ms, period = {self.period} ms")
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self)):
            return
        for name in ("position", "velocity", "attitude"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"SensorModel.{name} = {getattr(self, name)} must not be negative")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"SensorModel.dropout = {self.dropout} must be in [0, 1)")

    @classmethod
    def of(
        cls,
        *,
        position: float = 0.0,
        velocity: float = 0.0,
        attitude: float = 0.0,
        dropout: float = 0.0,
        latency: int = 0,
        gyro: float = 0.0,
        accelerometer: float = 0.0,
    ) -> "SensorModel":
        """Build a sensor model from plain numbers; by default, exact samples arrive without latency every 10 ms.

        Args:
            position: Standard deviation per axis [m].
            velocity: Standard deviation per axis [m/s].
            attitude: Standard deviation per body axis [rad].
            dropout: Probability that a sample is lost.
            latency: Age of a sample at its arrival [ms].
            gyro: Standard deviation of the body rates per axis [rad/s].
            accelerometer: Standard deviation of the acceleration per axis [m/s^2].

        Raises:
            ValueError: A deviation or time is negative, or the probability is not in [0, 1).
        """
        return cls(
            jnp.array(position),
            jnp.array(velocity),
            jnp.array(attitude),
            jnp.array(dropout),
            latency,
            gyro=gyro,
            accelerometer=accelerometer,
        )

    @property
    def held(self) -> int:
        """Number of samples in the queue: the samples in transit, and the sample that has arrived."""
        return -(-self.latency // self.period) + 1

    @property
    def age(self) -> float:
        """Age of the newest arrived sample at the end of a tick [s]: the latency, rounded up to whole periods."""
        return 1e-3 * (self.period * (self.held - 1))

    def noisy(self, x: State, key: Key[Array, ""]) -> State:
        """Return one noisy sample of ``x``."""
        kp, kv, kr = random.split(key, 3)
        dtype = x.p.dtype
        p, v, r = (random.normal(k, (3,), dtype) for k in (kp, kv, kr))
        return State(x.p + self.position * p, x.R @ so3.exp(self.attitude * r), x.v + self.velocity * v)

    def init(self, x: State, key: Key[Array, ""]) -> State:
        """Return a queue of :attr:`held` equal samples of ``x``; the key is consumed."""
        first = self.noisy(x, key)
        queue: State = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (self.held, *leaf.shape)), first)
        return queue

    def sample(
        self,
        memory: State,
        xs: State,
        omega: Float[Array, "3"] | None,
        a: Float[Array, "3"],
        dt: float,
        key: Key[Array, ""],
    ) -> State:
        """Return the queue of samples, oldest first, after new samples of the true states."""
        del omega, a, dt

        def one(queue: State, step: tuple[State, Key[Array, ""]]) -> tuple[State, None]:
            x, key = step
            k_noise, k_dropout = random.split(key)
            is_lost: Bool[Array, ""] = random.uniform(k_dropout, (), self.dropout.dtype) < self.dropout
            last = jax.tree.map(lambda leaf: leaf[-1], queue)
            new = where(is_lost, last, self.noisy(x, k_noise))
            return jax.tree.map(lambda old, n: jnp.concatenate([old[1:], n[None]]), queue, new), None

        after, _ = lax.scan(one, memory, (xs, random.split(key, xs.p.shape[0])))
        return after

    def state(self, memory: State) -> State:
        """Return the newest sample that has arrived."""
        return jax.tree.map(lambda leaf: leaf[0], memory)  # type: ignore[no-any-return]

    def inertial(
        self, memory: State, omega: Float[Array, "3"], a: Float[Array, "3"], key: Key[Array, ""]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Return the body rates and the acceleration with noise; the inertial unit has no latency."""
        del memory
        k_gyro, k_accelerometer = random.split(key)
        gyro = self.gyro * random.normal(k_gyro, (3,), a.dtype)
        return omega + gyro, a + self.accelerometer * random.normal(k_accelerometer, (3,), a.dtype)
