"""Model-predictive path integral control: many random command sequences, weighted by their predicted costs.

In each tick, the shifted mean of the previous tick is perturbed by noise. Every sequence is rolled out in the nominal
model, with the estimated disturbance if there is an estimator. The new mean is the average of all sequences, each with
the weight exp(-cost / temperature) (Williams et al. 2017; costs as in the comparison with DATT, Huang et al. 2023). The
noise is correlated in time (Vlahov et al. 2024), since independent noise in each tick cancels out before it moves the
vehicle.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Float, Int, Key

from ..estimation.l1 import L1Estimator, L1State
from ..estimation.prediction import Prediction, Underway
from ..physics import so3
from ..physics.actuator_response import FASTEST
from ..physics.actuators import apply_lag
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..tasks.abstract_reference import Point
from ..tasks.task import AbstractTask
from .controller import AbstractController


class MppiState(eqx.Module):
    """Memory of the controller."""

    underway: Underway
    mean: Float[Array, "horizon 4"]
    """Planned commands, one row [c, omega] per tick."""
    estimate: L1State
    last: State
    """State measured one tick ago."""
    tick: Int[Array, ""]


class MppiController(AbstractController[MppiState]):
    """MPPI over commands, in the nominal model with actuator lag."""

    task: AbstractTask
    """Task, which provides the reference."""
    prediction: Prediction
    low: Command
    """Smallest command that the vehicle accepts."""
    high: Command
    """Largest command that the vehicle accepts."""
    key: Key[Array, ""]
    estimator: L1Estimator | None
    """Estimator of the disturbance that the model includes; None for the nominal model."""
    spread: Float[Array, "4"]
    """Standard deviation of the noise: thrust [m/s^2], body rates [rad/s]."""
    correlation: Float[Array, ""]
    """Correlation time of the noise [s]."""
    temperature: Float[Array, ""]
    """Temperature of the weights, in the unit of the cost."""
    position_cost: Float[Array, ""]
    """Cost of the position error, per metre and second."""
    velocity_cost: Float[Array, ""]
    """Cost of the velocity error, per metre."""
    attitude_cost: Float[Array, ""]
    """Cost of the attitude error, per unit of 1 - <q, q_ref>^2 and second."""
    samples: int = eqx.field(static=True, default=1024)
    """Number of sequences per tick."""
    horizon: int = eqx.field(static=True, default=40)
    """Length of a sequence [ticks]."""

    def with_age(self, age: float | Float[Array, ""]) -> "MppiController":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(self, prediction=self.prediction.with_age(age))

    def init(self, x: State) -> MppiState:
        """Return the memory at the start of a flight, with hover as the plan."""
        mean = jnp.tile(Command.hover(x.p.dtype).vector(), (self.horizon, 1))
        return MppiState(self.prediction.init(x), mean, L1State.start(x), x, jnp.array(0))

    def __call__(self, memory: MppiState, t: Float[Array, ""], x: State) -> tuple[Command, MppiState]:
        """Plan from the state in which the command begins to act, and return the first command of the plan."""
        dtype, underway, estimate = x.p.dtype, memory.underway, memory.estimate
        if self.estimator is not None:
            estimate = self.estimator(estimate, t, x, self.prediction.thrust(underway, memory.last.R, x.R))
        soon, acting = self.prediction(underway, x, estimate.d_hat)
        dt = self.prediction.dt
        begin = t.astype(dtype) + self.prediction.path.delay.astype(dtype)
        times = begin + dt * (1 + jnp.arange(self.horizon, dtype=dtype))
        setpoints = jax.vmap(self.task.setpoint)(times)
        low, high = self.low.vector().astype(dtype), self.high.vector().astype(dtype)
        samples = random.normal(random.fold_in(self.key, memory.tick), (self.horizon, 4, self.samples), dtype)
        noise = jnp.tensordot(self._colour(dtype), samples, 1)
        plans = memory.mean[:, :, None] + self.spread.astype(dtype)[None, :, None] * noise
        plans = jnp.clip(plans, low[None, :, None], high[None, :, None])
        cost = self._costs(plans, soon, acting, setpoints, estimate.d_hat)
        weights = jax.nn.softmax(-(cost - jnp.min(cost)) / self.temperature.astype(dtype))
        mean = plans @ weights
        u = Command.of(mean[0])
        plan = jnp.concatenate([mean[1:], mean[-1:]])
        return u, MppiState(self.prediction.issue(underway, u), plan, estimate, x, memory.tick + 1)

    def accept(self, memory: MppiState, u: Command) -> MppiState:
        """Remember the accepted command."""
        return dataclasses.replace(memory, underway=self.prediction.accept(memory.underway, u))

    def _colour(self, dtype: jnp.dtype) -> Float[Array, "horizon horizon"]:
        """Return the matrix that gives independent numbers the correlation exp(-|difference| / time constant)."""
        ticks = jnp.arange(self.horizon, dtype=dtype)
        decay = jnp.exp(-self.prediction.dt / self.correlation.astype(dtype))
        since = ticks[:, None] - ticks[None, :]
        first = jnp.where(ticks == 0.0, jnp.ones((), dtype), jnp.sqrt(1.0 - decay**2))
        return jnp.where(since >= 0.0, decay ** jnp.abs(since) * first[None, :], 0.0)

    def _costs(
        self,
        plans: Float[Array, "horizon 4 samples"],
        x: State,
        acting: Command,
        setpoints: Point,
        d: Float[Array, "3"],
    ) -> Float[Array, " samples"]:
        """Return the cost of each plan. Samples are along the last axis, so that every operation has long rows."""
        dt, dtype = self.prediction.dt, x.p.dtype
        response = self.prediction.path.response
        # The plans neglect the ringing of the rate loops.
        lags = jnp.concatenate([response.thrust_lag[None], response.rate_lag]).astype(dtype)
        tau = jnp.maximum(lags, FASTEST)[:, None]
        pull = d + jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=dtype)

        def rows(a: Array) -> Array:
            return jnp.broadcast_to(a[..., None], (*a.shape, self.samples))

        def tick(carry: Any, plan: tuple[Array, Point]) -> tuple[Any, None]:
            p, R, v, u, cost = carry
            commands, setpoint = plan
            mean, u = apply_lag(u, commands, dt, tau)
            before, R = R, _turn(R, dt * mean[1:])
            a = 0.5 * (before[:, 2] + R[:, 2]) * mean[:1] + pull[:, None]
            p, v = p + dt * v + 0.5 * dt**2 * a, v + dt * a
            away = jnp.sqrt(jnp.sum((p - setpoint.p[:, None]) ** 2, axis=0) + 1e-12)
            apart = jnp.sqrt(jnp.sum((v - setpoint.v[:, None]) ** 2, axis=0) + 1e-12)
            heading = so3.rotz(setpoint.heading)
            askew = 0.25 * (3.0 - jnp.sum(heading[:, :, None] * R, axis=(0, 1)))
            weights = (self.position_cost, self.velocity_cost, self.attitude_cost)
            terms = zip(weights, (away, apart, askew), strict=True)
            cost = cost + dt * sum(weight.astype(dtype) * term for weight, term in terms)
            return (p, R, v, u, cost), None

        start = (rows(x.p), rows(x.R), rows(x.v), rows(acting.vector()), jnp.zeros(self.samples, dtype))
        last, _ = lax.scan(tick, start, (plans, setpoints))
        cost: Array = last[-1]
        return cost


def _turn(R: Float[Array, "3 3 n"], w: Float[Array, "3 n"]) -> Float[Array, "3 3 n"]:
    """Return attitudes turned by rotation vectors [rad] in the body frame, all at once (Rodrigues' formula)."""
    square = jnp.sum(w * w, axis=0) + 1e-12
    angle = jnp.sqrt(square)
    once = _times_hat(R, w)
    s, c = jnp.sin(angle) / angle, (1.0 - jnp.cos(angle)) / square
    return R + s[None, None] * once + c[None, None] * _times_hat(once, w)


def _times_hat(R: Float[Array, "3 3 n"], w: Float[Array, "3 n"]) -> Float[Array, "3 3 n"]:
    """Return R [w]x, column by column."""
    (x, y, z), (i, j, k) = w[:, None], jnp.moveaxis(R, 1, 0)
    return jnp.stack([j * z - k * y, k * x - i * z, i * y - j * x], axis=1)
