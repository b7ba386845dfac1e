"""Hover around a moving goal, and the defaults of a task: laws of relative motion and of frames."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import draw_starts, random_state
from retrim.config import Setup, TaskEntry, changed, load, register_task
from retrim.config.families import policy_controller
from retrim.config.tasks import TASKS
from retrim.control import PolicyController
from retrim.control.resting import RestingController
from retrim.errors import FrameError
from retrim.physics import Command, State
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.tasks import AbstractTask, L2Hover, StateObs
from retrim.tasks.moving_goal import MovingGoal
from retrim.testing import check_task

VELOCITY = jnp.array([0.4, -0.3, 0.1])
PUSH = jnp.array([2.0, -1.0, 1.5])


def circle(t):
    return jnp.stack([jnp.cos(0.5 * t), jnp.sin(0.5 * t), 1.5 + 0.0 * t])


def straight(t):
    return jnp.array([1.0, 2.0, 1.0]) + VELOCITY * t


def hover(goal):
    return L2Hover(goal, StateObs(goal, jnp.full(3, 6.0), 2), jnp.array(5.0), jnp.array(0.3))


class Height(AbstractTask):
    """A task with defaults only and a moving target."""

    observation: StateObs
    dt: float = 0.02
    horizon: int = 50

    def home(self):
        return straight(jnp.array(0.0))

    def target(self, t):
        return straight(t)

    def reward(self, t, x, u):
        away = x.p - self.target(t)
        return -away @ away - 0.1 * u.omega @ u.omega - 0.01 * (u.c - 9.81) ** 2


def moving(path=circle):
    return MovingGoal(hover(jnp.zeros(3)), path)


def observe(task, t, x, u):
    return task.observation(task.observation.init(x), t, x, u)[0]


@pytest.mark.parametrize("task", [moving(), Height(StateObs(jnp.zeros(3), jnp.full(3, 6.0), 0))], ids=["goal", "own"])
def test_conformance(task):
    check_task(task)


def test_goal_at_rest_is_hover(key):
    at = jnp.array([0.5, -1.0, 2.0])
    x, u, t = random_state(key), Command.of(jnp.array([9.0, 0.3, -0.2, 0.1])), jnp.array(3.0)
    one, other = moving(lambda t: at + 0.0 * t), hover(at)
    for name in ("reward", "error", "terminated"):
        values = (getattr(task, name)(t, x, *([u] if name == "reward" else [])) for task in (one, other))
        np.testing.assert_allclose(*values, rtol=1e-12)
    np.testing.assert_allclose(observe(one, t, x, u), observe(other, t, x, u), rtol=1e-12, atol=1e-12)


def test_uniform_motion_is_unobservable(key):
    """By Galilean relativity, a vehicle that moves with the goal has the observation and the reward of hover."""
    x, u, t = random_state(key), Command.hover(), jnp.array(7.0)
    along = State(x.p + straight(t), x.R, x.v + VELOCITY)
    one, other = moving(straight), hover(jnp.zeros(3))
    np.testing.assert_allclose(observe(one, t, along, u), observe(other, t, x, u), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.reward(t, along, u), other.reward(t, x, u), rtol=1e-9)


def test_derivatives_of_goal():
    task, t, h = moving(), jnp.array(2.0), 1e-4
    here, after, before = (task.setpoint(t + k * h) for k in (0, 1, -1))
    np.testing.assert_allclose(here.v, (after.p - before.p) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(here.a, (after.v - before.v) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(here.jerk, (after.a - before.a) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(here.u[0], np.linalg.norm(here.a + np.array([0.0, 0.0, 9.81])), rtol=1e-3)


def test_starts_are_near_moving_target(key):
    for task, path in ((moving(), circle), (Height(StateObs(jnp.zeros(3), jnp.full(3, 6.0), 0)), straight)):
        starts = draw_starts(task, key, 200)
        assert np.ptp(starts.t) > 20.0
        off = np.asarray(starts.x.p - jax.vmap(path)(starts.t))
        assert np.abs(off).max() <= 1.0
        speeds = jax.vmap(lambda t, path=path: jax.jvp(path, (t,), (1.0,))[1])(starts.t)
        assert np.abs(starts.x.v - speeds).max() < 0.6


def test_frames(key):
    """In a frame, the target is the same, and for built-in hover the error is equal up to the scale of the frame."""
    frame, t = EffectiveGravityFrame.of(PUSH), jnp.array(4.0)
    x, u = random_state(key), Command.of(jnp.array([10.0, 0.1, 0.2, -0.1]))
    task = moving()
    task_in_frame = task.in_frame(frame)
    np.testing.assert_allclose(task_in_frame.target(t), frame.vector(task.target(t)), rtol=1e-12)
    np.testing.assert_allclose(task_in_frame.error(t, frame.state(x)), frame.scale * task.error(t, x), rtol=1e-9)
    own = Height(StateObs(jnp.zeros(3), jnp.full(3, 6.0), 0))
    in_frame = own.in_frame(frame)
    np.testing.assert_allclose(in_frame.target(t), frame.vector(own.target(t)), rtol=1e-12)
    np.testing.assert_allclose(in_frame.reward(t, frame.state(x), u), own.reward(t, x, u), rtol=1e-9)
    np.testing.assert_allclose(in_frame.error(t, frame.state(x)), own.error(t, x), rtol=1e-9)
    with pytest.raises(FrameError, match="twice"):
        task_in_frame.in_frame(frame)


def test_only_task_with_fixed_target_rests():
    assert hover(jnp.zeros(3)).rests
    assert not moving().rests
    assert not Height(StateObs(jnp.zeros(3), jnp.full(3, 6.0), 0)).rests


def test_only_policy_of_resting_task_is_shifted():
    """A policy for many vehicles commands hover at the goal, but not at the first position of a moving goal."""
    register_task("orbit-family", TaskEntry(lambda request: request.hover(goal=circle)))
    try:
        kinds = []
        for task in ("hover", "orbit-family"):
            setup = Setup.from_preset(changed(load("hover/any"), task=task, pretrain={"hidden_sizes": (8, 8)}))
            policy = setup.new_policy(random.key(0))
            kinds.append(type(policy_controller(setup.preset, setup.flight_task, policy).inner))
        assert kinds == [RestingController, PolicyController]
    finally:
        del TASKS._objects["orbit-family"]
