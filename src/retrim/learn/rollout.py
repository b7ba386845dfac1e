"""One drone flown by a policy through a model, as one scan."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..control.policy import Inputs, Policy, Taps
from ..physics.dynamics import AbstractDynamics
from ..physics.state import Command, State, where
from ..tasks.task import AbstractTask, Start


class Trajectory(eqx.Module):
    """``horizon`` ticks of one drone; every leaf has the ticks in front."""

    x: State
    """State at the start of each tick."""
    u: Command
    """Command acting during it."""
    reward: Float[Array, " horizon"]
    """r(x_t, u_t). After a crash: the worst reward of the roll-out until then, so that dying never pays."""
    alive: Bool[Array, " horizon"]
    """False from the tick on in which the vehicle left the task's bounds; it is then frozen."""


def rollout(
    dynamics: AbstractDynamics[Any],
    task: AbstractTask,
    policy: Policy,
    start: Start,
    *,
    delay: int = 0,
    a_ext: Float[Array, "3"] | None = None,
) -> Trajectory:
    """Fly ``task.horizon`` ticks from ``start``.

    A command issued at a tick acts ``delay`` ticks later; until the first one does, the vehicle is told to hover.
    ``a_ext`` is a constant external acceleration (world [m/s^2]).
    """
    return _scan(dynamics, task, policy, start, None, delay, a_ext)[0]


def tapped_rollout(
    dynamics: AbstractDynamics[Any],
    task: AbstractTask,
    policy: Policy,
    start: Start,
    taps: Taps,
    *,
    delay: int = 0,
    a_ext: Float[Array, "3"] | None = None,
) -> tuple[Trajectory, Inputs]:
    """The same with the layers' inputs; differentiable in ``taps`` (per layer: horizon x width), not in the policy."""
    return _scan(dynamics, task, policy, start, taps, delay, a_ext)


def _scan(
    dynamics: AbstractDynamics[Any],
    task: AbstractTask,
    policy: Policy,
    start: Start,
    taps: Taps | None,
    delay: int,
    a_ext: Float[Array, "3"] | None,
) -> tuple[Trajectory, Inputs]:
    push = a_ext if a_ext is not None else jnp.zeros_like(start.x.p)
    hover = policy.u_hover

    def tick(carry: Any, xs: Any) -> Any:
        s, memory, last, pending, alive, worst = carry
        k, tap = xs
        t = start.t + k * task.dt
        x = dynamics.state(s)
        o, memory = task.observation(memory, t, x, last)
        u, inputs = (policy(o), ()) if tap is None else policy.tapped(o, tap)
        queue = (*pending, u)
        acting, waiting = queue[0], queue[1:]
        reward = jnp.where(alive, task.reward(t, x, acting), worst)
        after = dynamics.step(s, acting, push)
        survived = alive & task.alive(t + task.dt, dynamics.state(after))
        # A lost vehicle is frozen where it last was well: a diverging state turns masked rewards into NaN gradients.
        s = where(survived, after, lax.stop_gradient(s))
        worst = jnp.minimum(worst, lax.stop_gradient(reward))
        return (s, memory, u, waiting, survived, worst), ((x, acting, reward, alive), inputs)

    carry = (
        dynamics.init(start.x),
        task.observation.init(start.x),
        hover,
        (hover,) * delay,
        jnp.array(True),
        jnp.zeros_like(start.t),
    )
    ticks = jnp.arange(task.horizon, dtype=start.t.dtype)
    _, (flown, inputs) = lax.scan(tick, carry, (ticks, taps))
    return Trajectory(*flown), inputs
