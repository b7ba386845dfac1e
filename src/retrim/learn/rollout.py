"""Roll out the flight of one drone as one scan."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..control.policy import AbstractPolicy, Inputs, Perturbations, Policy
from ..physics.command_path import CommandQueue
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State, where
from ..tasks.task import AbstractTask, Start
from .env import Env


class Trajectory(eqx.Module):
    """``horizon`` ticks of one drone; every leaf has a leading time axis."""

    x: State
    """State at the start of each tick."""
    u: Command
    """Mean command that acts during each tick."""
    reward: Float[Array, " horizon"]
    """r(x_t, u_t). After termination, the reward is the worst of the roll-out so far, so terminating never pays."""
    terminated: Bool[Array, " horizon"]
    """True after the tick in which the vehicle left the task's bounds; the vehicle's state is then frozen."""


def rollout(env: Env, policy: AbstractPolicy, start: Start) -> Trajectory:
    """Fly ``env.task.horizon`` ticks from ``start``.

    A command begins to act ``env.delay`` after it was issued. Until the first one acts, the vehicle receives the hover
    command. During a tick in which the acting command changes, the mean of the two commands acts.

    Args:
        env: Model, task and delay.
        policy: Policy of the flight.
        start: Time and state at which the roll-out starts.

    Returns:
        States, commands and rewards, with a leading time axis.
    """
    return _scan(env, policy, start, lambda o, _: (policy(o), ()), None)[0]


def rollout_with_perturbations(
    env: Env, policy: Policy, start: Start, perturbations: Perturbations
) -> tuple[Trajectory, Inputs]:
    """Fly like :func:`rollout`, with a perturbation added to each layer's output at each tick.

    Args:
        env: Model, task and delay.
        policy: Policy of the flight; gradients do not flow to its weights.
        start: Time and state at which the roll-out starts.
        perturbations: Perturbations per layer, horizon x width; the result is differentiable with respect to them.

    Returns:
        The trajectory, and the inputs of each layer (per layer, horizon x fan-in).
    """
    return _scan(env, policy, start, policy.perturb, perturbations)


def _scan(
    env: Env,
    policy: AbstractPolicy,
    start: Start,
    act: Callable[[Array, Any], tuple[Command, Inputs]],
    perturbations: Perturbations | None,
) -> tuple[Trajectory, Inputs]:
    if start.member is not None:
        env = env.with_path(start.member.path)
    dynamics, task = env.dynamics, env.task
    calm = jnp.zeros_like(start.x.p)
    hover = policy.u_hover
    commands = CommandQueue.of(hover, task.dt, longest=env.longest_delay)
    shares = commands.weights(env.delay, task.dt)  # the same in every tick

    def to_frame(x: State, newest: Command) -> tuple[EffectiveGravityFrame | None, AbstractTask, State]:
        """Return the policy's frame, and the task and the state in this frame."""
        frame = env.frame(x, newest)
        return (None, task, x) if frame is None else (frame, task.in_frame(frame), frame.state(x))

    def tick(carry: Any, xs: Any) -> Any:
        s, memory, last, newest, commands, alive, worst = carry
        k, perturbation = xs
        t = start.t + k * task.dt
        x = dynamics.state(s)
        frame, task_in_frame, x_in_frame = to_frame(x, newest)
        actuators, observation = dynamics.actuators(s), task_in_frame.observation
        if actuators is not None:
            observation = observation.with_actuators(actuators if frame is None else frame.actuators(actuators))
        if start.member is not None:
            observation = observation.with_belief(start.member.belief)
        o, memory = observation(memory, t, x_in_frame, last)
        before = last
        last, inputs = act(o, perturbation)
        newest = last if frame is None else frame.world_command(last)
        commands = commands.push(newest)
        acting = commands.combine(shares)
        reward = task_in_frame.reward(t, x_in_frame, acting if frame is None else frame.command(acting))
        reward = jnp.where(alive, reward - env.cost_of_jump(before, last), worst)
        after = dynamics.step(s, acting, calm)
        still_alive = alive & ~task.terminated(t + task.dt, dynamics.state(after))
        # A terminated vehicle is frozen at its last good state: a diverging state turns masked rewards into NaN
        # gradients.
        s = where(still_alive, after, lax.stop_gradient(s))
        worst = jnp.minimum(worst, lax.stop_gradient(reward))
        return (s, memory, last, newest, commands, still_alive, worst), ((x, acting, reward, ~alive), inputs)

    _, task_in_frame, x_in_frame = to_frame(
        start.x, hover
    )  # the memory of the time before the start has the same frame
    carry = (
        dynamics.init(start.x),
        task_in_frame.observation.init(x_in_frame),
        hover,
        hover,
        commands,
        jnp.array(True),
        jnp.zeros_like(start.t),
    )
    ticks = jnp.arange(task.horizon, dtype=start.t.dtype)
    _, (trajectory, inputs) = lax.scan(tick, carry, (ticks, perturbations))
    return Trajectory(*trajectory), inputs
