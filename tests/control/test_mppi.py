"""MPPI plans better with more samples and stays within the limits, and an estimator compensates for a push."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import GOAL, first_order, hover_task, random_state
from retrim.control.mppi import MppiController, _turn
from retrim.estimation.l1 import L1Estimator
from retrim.estimation.prediction import Prediction
from retrim.physics import Command, CommandPath, PointMass, State, small, so3
from retrim.physics.actuators import LaggedModel

DT, TAU = 0.02, 0.033
L1 = L1Estimator(jnp.array(-0.2), jnp.exp(jnp.array(-DT / 0.3)), DT)


PREDICTION = Prediction.of(CommandPath.of(DT, first_order(TAU)), DT)


def mppi(estimator=None, samples=256, seed=0):
    numbers = (jnp.array(v) for v in (0.1, 0.05, 10.0, 1.0, 1.0))
    return MppiController(
        hover_task(),
        PREDICTION,
        small().command_min,
        small().command_max,
        random.key(seed),
        estimator,
        jnp.array([2.0, 1.0, 1.0, 1.0]),
        *numbers,
        samples=samples,
        horizon=30,
    )


def test_batched_attitude_update_equals_single_updates(key):
    R = jax.vmap(lambda k: random_state(k).R)(random.split(key, 5))
    w = jnp.concatenate([random.normal(key, (4, 3)), jnp.zeros((1, 3))])
    result = jax.jit(lambda R, w: jnp.moveaxis(_turn(jnp.moveaxis(R, 0, -1), w.T), -1, 0))(R, w)
    np.testing.assert_allclose(result, jax.jit(jax.vmap(lambda R, w: R @ so3.exp(w)))(R, w), atol=1e-9)


def test_noise_has_stated_correlation():
    """The variance is one at every tick, and the correlation of two ticks is exp(-difference / time constant)."""
    for tau in (1e-3, 0.1, 0.5):
        colour = dataclasses.replace(mppi(), correlation=jnp.array(tau))._colour(jnp.zeros(()).dtype)
        t = DT * np.arange(30)
        np.testing.assert_allclose(colour @ colour.T, np.exp(-np.abs(t[:, None] - t[None]) / tau), atol=1e-6)


def test_plan_cost_is_integrated_distance(key):
    """A plan that stays at the goal costs nothing; a plan one metre away costs this distance over the horizon."""
    controller = mppi(samples=3)
    hover = jnp.tile(Command.hover(float).vector()[None, :, None], (30, 1, 3))
    expected = jax.vmap(controller.task.setpoint)(DT * jnp.arange(30.0))
    for away in (0.0, 1.0):
        x = State.at(jnp.array(GOAL) + jnp.array([away, 0.0, 0.0]))
        cost = controller._costs(hover, x, Command.hover(float), expected, jnp.zeros(3))
        np.testing.assert_allclose(cost, 10.0 * away * 30 * DT, atol=1e-4)


def test_more_samples_plan_better(key):
    """The score is the mean cost of the planned mean over seeds, from a displaced and tilted start."""
    x = State(jnp.array([0.4, -0.3, 1.2]), so3.exp(jnp.array([0.2, -0.1, 0.3])), jnp.array([0.5, 0.0, -0.2]))
    expected = jax.vmap(hover_task().setpoint)(DT * jnp.arange(30.0))

    def plan(samples):
        def cost(key):
            controller = dataclasses.replace(mppi(samples=samples), key=key)
            _, memory = controller(controller.init(x), jnp.array(0.0), x)
            plan = jnp.concatenate([memory.mean[:1], memory.mean[:-1]])[:, :, None]
            one = dataclasses.replace(controller, samples=1)
            return one._costs(plan, x, Command.hover(float), expected, jnp.zeros(3))[0]

        return float(jnp.mean(jax.jit(jax.vmap(cost))(random.split(key, 16))))

    few, some, many = (plan(n) for n in (8, 64, 512))
    hover = mppi(samples=1)._costs(
        jnp.tile(Command.hover(float).vector()[None, :, None], (30, 1, 1)),
        x,
        Command.hover(float),
        expected,
        jnp.zeros(3),
    )[0]
    assert many < some < few
    assert many < 0.9 * float(hover)


@eqx.filter_jit
def fly_once(controller, push):
    """Return positions and commands of 4 s in the lagged model with a command delay of one tick."""
    model = LaggedModel(PointMass(DT), first_order(TAU))

    def tick(carry, k):
        s, memory, waiting = carry
        u, memory = controller(memory, DT * k, model.state(s))
        s = model.step(s, waiting, push)
        return (s, memory, u), (model.state(s).p, u.vector())

    x0 = State.at(jnp.array([0.8, -0.5, 1.4]))
    first = (model.init(x0), controller.init(x0), Command.hover(x0.p.dtype))
    return lax.scan(tick, first, jnp.arange(200.0))[1]


@pytest.mark.parametrize("push", [0.0, 2.0])
def test_hovers_within_limits_and_estimator_compensates_push(push):
    errors = []
    for estimator in (None, L1):
        p, u = (np.asarray(column) for column in fly_once(mppi(estimator, samples=128), jnp.full(3, push)))
        low, high = (np.asarray(limit.vector()) for limit in (small().command_min, small().command_max))
        assert ((u >= low) & (u <= high)).all()
        errors.append(np.linalg.norm(p[-75:] - np.array(GOAL), axis=1).mean())
    assert errors[1] < 0.15
    if push:
        assert errors[1] < 0.5 * errors[0]
