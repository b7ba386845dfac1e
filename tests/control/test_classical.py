"""Controllers without a policy: geometric tracking and INDI hover, reject steps, track, and are equivariant."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import GOAL, at, first_order, hover_task, random_state
from retrim.control.attitude import LEAST_LIFT, attitude_of, command_for, flyable, thrust_of
from retrim.control.geometric import Gains, GeometricController
from retrim.control.indi import IndiController
from retrim.estimation.prediction import Prediction
from retrim.physics import Command, CommandPath, PointMass, State, small, so3
from retrim.physics.actuators import LaggedModel
from retrim.tasks import Preview, Track
from retrim.tasks.shapes import figure8

DT, TAU = 0.02, 0.033
PREDICTION = Prediction.of(CommandPath.of(DT, first_order(TAU)), DT)
LIMITS = small().command_min, small().command_max


def gains(integral=0.0):
    return Gains(jnp.array(12.0), jnp.array(6.0), jnp.array(12.0), jnp.array(integral))


def make(kind, task):
    if kind == "indi":
        return IndiController(task, gains(), PREDICTION, jnp.array(0.08), *LIMITS)
    return GeometricController(task, gains(12.0 if kind == "geometric-i" else 0.0), PREDICTION, jnp.array(6.0), *LIMITS)


@eqx.filter_jit
def _fly_once(controller, x0, push, start, ticks):
    model = LaggedModel(PointMass(DT), first_order(TAU))

    def tick(carry, k):
        s, memory, waiting = carry
        t = DT * k.astype(float)
        u, memory = controller(memory, t, model.state(s))
        s = model.step(s, waiting, jnp.where(t >= start, push, 0.0))
        return (s, memory, u), model.state(s)

    first = (model.init(x0), controller.init(x0), Command.hover(x0.p.dtype))
    return lax.scan(tick, first, jnp.arange(ticks))[1]


def fly_once(controller, x0, push, seconds=8.0, start=0.0):
    """Return states by tick in the lagged model, delayed by one tick; the push acts from ``start`` [s] on."""
    return _fly_once(controller, x0, push, jnp.array(start), round(seconds / DT))


@pytest.mark.parametrize("kind", ["geometric", "geometric-i", "indi"])
def test_converges_to_hover_from_nearby_states(kind, key):
    task = hover_task()
    for k in random.split(key, 3):
        x0 = State(jnp.array(GOAL) + random.uniform(k, (3,), minval=-1.0), random_state(k, 0.3).R, jnp.zeros(3))
        path = fly_once(make(kind, task), x0, jnp.zeros(3))
        np.testing.assert_allclose(path.p[-1], GOAL, atol=2e-3)
        assert float(jnp.max(jnp.abs(path.v[-50:]))) < 5e-3


@pytest.mark.parametrize("kind", ["geometric-i", "indi"])
@pytest.mark.parametrize("push", [(2.0, 2.0, 2.0), (-1.0, 0.5, -3.0)])
def test_rejects_step_disturbance(kind, push):
    task, d = hover_task(), jnp.array(push)
    path = fly_once(make(kind, task), State.at(jnp.array(GOAL)), d, start=1.0, seconds=12.0)
    error = jnp.sqrt(jnp.sum((path.p - jnp.array([GOAL])) ** 2, axis=1))
    assert float(jnp.max(error)) > 0.02  # the step has an effect
    assert float(error[-1]) < 2e-3


def test_offset_without_integral_action_balances_push():
    d = jnp.array([0.6, -0.3, 0.2])
    path = fly_once(make("geometric", hover_task()), State.at(jnp.array(GOAL)), d)
    expected = d / 12.0 * (1.0 + 6.0 * DT + 0.5 * 12.0 * DT**2)  # the prediction does not contain the push
    np.testing.assert_allclose(path.p[-1] - jnp.array(GOAL), expected, rtol=0.01)


def test_indi_uses_accelerometer():
    """INDI treats measured acceleration that the velocities do not explain as a disturbance."""
    task, x = hover_task(), State.at(jnp.array(GOAL))
    plain = make("indi", task)
    _, memory = plain(plain.init(x), jnp.array(0.0), x)  # the first tick has no earlier velocity to compare with
    level, _ = plain(memory, jnp.array(DT), x)
    pull, _ = plain.with_inertial(jnp.zeros(3), jnp.array([0.0, 0.0, -1.0]))(memory, jnp.array(DT), x)
    share = 1.0 - np.exp(-DT / 0.08)  # of 1 m/s^2; the vehicle falls a little before the controller responds
    assert share < float(pull.c - level.c) < 1.2 * share


@pytest.mark.parametrize("kind", ["geometric", "indi"])
def test_commands_stay_within_limits(kind):
    """The vehicle is far away and upside down, so that commands reach the limits of thrust and rates."""
    controller, low, high = make(kind, hover_task()), *(limit.vector() for limit in LIMITS)
    message = set()
    for R, z in ((jnp.eye(3), -9.0), (so3.exp(jnp.array([2.8, 0.4, 0.0])), 9.0)):
        x = State(jnp.array([6.0, -6.0, z]), R, jnp.zeros(3))
        u = controller(controller.init(x), jnp.array(0.0), x)[0].vector()
        assert bool(jnp.all((low <= u) & (u <= high)))
        message |= {("low", k) for k in np.flatnonzero(u == low)} | {("high", k) for k in np.flatnonzero(u == high)}
    assert {("low", 0), ("high", 0)} <= message
    assert message & {("low", 1), ("high", 1)}


@pytest.mark.parametrize("kind", ["geometric", "geometric-i", "indi"])
def test_tracks_figure_8(kind):
    reference = figure8()
    task = Track(reference, Preview(reference, small().omega_max, 0), jnp.array(1.0), jnp.array(5.0))
    here = at(reference, [0.0])
    start = State(jnp.asarray(here.p[0]), jnp.eye(3), jnp.asarray(here.v[0]))
    path = fly_once(make(kind, task), start, jnp.zeros(3), seconds=10.0)
    expected = at(reference, DT * np.arange(1.0, path.p.shape[0] + 1)).p
    error = np.linalg.norm(np.asarray(path.p) - expected, axis=1)
    assert np.mean(error[250:]) < 0.03


@pytest.mark.parametrize("kind", ["geometric", "indi"])
def test_commands_are_equivariant_to_position_and_heading(kind, key):
    task, x = hover_task(), random_state(key, 0.5)
    turn, shift = so3.rotz(jnp.array(1.2)), jnp.array([5.0, -3.0, 2.0])
    here = dataclasses.replace(task, goal=jnp.array(GOAL))

    def decide(x, goal, heading):
        controller = make(kind, dataclasses.replace(here, goal=goal))
        point = controller.task.setpoint(jnp.array(0.0))._replace(heading=jnp.array(heading))
        thrust = thrust_of(controller.gains.acceleration(x, point, jnp.zeros(3)))
        return command_for(x, thrust, point, controller.gains.turning()).vector()

    first = decide(x, jnp.array(GOAL), 0.0)
    state_after = State(turn @ x.p + shift, turn @ x.R, turn @ x.v)
    np.testing.assert_allclose(decide(state_after, turn @ jnp.array(GOAL) + shift, 1.2), first, atol=1e-9)


def test_desired_attitude_is_rotation_and_its_fixed_point_commands_reference(key):
    for k in random.split(key, 5):
        thrust = flyable(thrust_of(5.0 * random.normal(k, (3,))))
        R = attitude_of(thrust, jnp.array(0.7))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(R[:, 2] * jnp.linalg.norm(thrust), thrust, atol=1e-12)
        assert thrust[2] >= LEAST_LIFT
    point = figure8()(jnp.array(1.3))
    thrust = thrust_of(point.a)
    x = State(point.p, attitude_of(thrust, point.heading), point.v)
    u = command_for(x, thrust, point, jnp.full(3, 12.0))
    np.testing.assert_allclose(u.vector(), point.u, atol=2e-2)
