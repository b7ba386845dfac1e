"""Actuator lag: the exact step response at ticks, the mean over a tick, gradients, and a zero residual."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import (
    GOAL,
    check_slope,
    first_order,
    random_command,
    random_state,
    replace_fields,
    residual_targets,
    stack_trees,
)
from retrim.learn import Window
from retrim.physics import ActuatorState, Command, Hybrid, LaggedModel, PointMass, State, StraightThrough, f_a, so3
from retrim.physics.actuators import LagState

TAU, DT = 0.033, 0.02
STILL = jnp.zeros(3)


def lag_model(tau=TAU):
    return LaggedModel(PointMass(DT), first_order(tau))


def commands(key, n):
    return stack_trees([random_command(k) for k in random.split(key, n)])


@jax.jit
def fly_once(model, s, us):
    """Return all states of the model, including the first."""

    def tick(s, u):
        return model.step(s, u, STILL), s

    end, states = lax.scan(tick, s, us)
    return jax.tree.map(lambda all_, last: jnp.concatenate([all_, last[None]]), states, end)


def test_zero_lag_equals_base_model(key):
    x, us = random_state(key), commands(key, 10)
    plain, quick = fly_once(PointMass(DT), x, us), fly_once(lag_model(1e-9), lag_model(1e-9).init(x), us)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(quick.inner), strict=True):
        np.testing.assert_allclose(b, a, atol=1e-5)
    slow = fly_once(lag_model(), lag_model().init(x), us)
    assert float(jnp.abs(slow.inner.v - plain.v).max()) > 0.01


@pytest.mark.parametrize("tau", [0.01, 0.033, 0.2])
def test_step_response_is_exact_at_every_tick(tau):
    u = Command(jnp.array(12.0), jnp.array([1.0, -2.0, 0.5]))
    hold = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (20, *leaf.shape)), u)
    states = fly_once(lag_model(tau), lag_model(tau).init(State.at(jnp.array(GOAL))), hold)
    rise = 1.0 - np.exp(-DT * np.arange(21) / tau)
    np.testing.assert_allclose(states.actuators.command.c - 9.81, rise * (12.0 - 9.81), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(states.actuators.command.omega, rise[:, None] * np.array([[1.0, -2.0, 0.5]]), rtol=1e-12)


def test_hover_is_an_equilibrium():
    x = State.at(jnp.array(GOAL))
    still = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (50, *leaf.shape)), Command.hover())
    states = fly_once(lag_model(), lag_model().init(x), still)
    np.testing.assert_allclose(states.inner.p, np.broadcast_to(GOAL, (51, 3)), atol=1e-12)
    np.testing.assert_allclose(states.inner.v, 0.0, atol=1e-12)


def fine(x, us, tau, h=1e-3):
    """Integrate Eq. (1) under a command that approaches ``us``, in steps of 1 ms by the midpoint rule."""
    acting, states = Command.hover().vector(), [x]
    base, expected = PointMass(h), np.stack([np.append(c, w) for c, w in zip(us.c, us.omega, strict=True)])
    step = jax.jit(base.step)
    for target in expected:
        for i in range(round(DT / h)):
            now = target + np.exp(-(i + 0.5) * h / tau) * (acting - target)
            x = step(x, Command.of(jnp.asarray(now)), STILL)
        acting = target + np.exp(-DT / tau) * (acting - target)
        states.append(x)
    return stack_trees(states)


def test_thrust_over_tick_is_its_mean(key):
    """Without rotation, the velocity is exact, since only the integral of thrust matters."""
    us = jax.tree.map(lambda leaf: leaf if leaf.ndim == 1 else jnp.zeros_like(leaf), commands(key, 8))
    x = random_state(key)
    result, true = fly_once(lag_model(), lag_model().init(x), us).inner, fine(x, us, TAU)
    np.testing.assert_allclose(result.v, true.v, atol=1e-4)  # the error of 1 ms steps
    np.testing.assert_allclose(result.p, true.p, atol=1e-3)
    end_only = fly_once(PointMass(DT), x, us)
    assert float(jnp.abs(end_only.v - true.v).max()) > 0.01


def test_close_to_fine_integration_while_rotating(key):
    us, x = commands(key, 8), random_state(key)
    result, true = fly_once(lag_model(), lag_model().init(x), us).inner, fine(x, us, TAU)
    assert float(jnp.abs(result.v - true.v).max()) < 0.02
    np.testing.assert_allclose(result.R, true.R, atol=0.01)
    assert float(jnp.abs(fly_once(PointMass(DT), x, us).R - true.R).max()) > 0.02


def test_external_acceleration_is_not_delayed():
    x = State.at(jnp.array(GOAL))
    with_push = lag_model().step(lag_model().init(x), Command.hover(), jnp.array([2.0, 0.0, 0.0]))
    np.testing.assert_allclose(with_push.inner.v, [0.04, 0.0, 0.0], atol=1e-12)


def test_hidden_state_is_kept(key):
    s = LagState(random_state(key), ActuatorState.at(random_command(key)))
    after = lag_model().with_state(s, State.at(jnp.array(GOAL)))
    jax.tree.map(np.testing.assert_array_equal, after.actuators, s.actuators)
    np.testing.assert_array_equal(lag_model().state(after).p, GOAL)


def test_gradients_equal_finite_differences(key):
    """The function is a mixture of the state after three ticks; directions are random in state, commands and tau."""
    kx, ku, kw, kd = random.split(key, 4)
    start = (random_state(kx), commands(ku, 3), jnp.array(TAU))
    weights = random.normal(kw, (15,))

    def mixture(what):
        x, us, tau = what
        model, s = LaggedModel(PointMass(DT), first_order(tau)), None
        s = model.init(x)
        for k in range(3):
            s = model.step(s, jax.tree.map(lambda leaf, k=k: leaf[k], us), STILL)
        return jnp.sum(weights * s.inner.vector())

    slope = check_slope(jax.jit(mixture), start, kd, h=1e-6, rel=1e-5)
    assert float(jnp.abs(slope[2])) > 1e-3  # tau has an effect


def test_composition_with_wrappers(key):
    """A residual around it acts immediately; behind a straight-through estimator its lag is kept."""
    push = lambda x, u: jnp.array([1.0, 0.0, 0.0])  # noqa: E731
    x, u = State.at(jnp.array(GOAL)), Command(jnp.array(15.0), jnp.zeros(3))
    model = Hybrid(lag_model(), push)
    s = model.step(model.init(x), u, STILL)
    assert float(s.inner.v[0]) == pytest.approx(0.02, rel=1e-9)
    through = StraightThrough(model, PointMass(DT))
    t = through.step(through.init(x), u, STILL)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), t, s)
    gain = jax.jit(jax.jacobian(lambda c: through.step(through.init(x), replace_fields(u, c=c), STILL).inner.v[2]))(u.c)
    assert float(gain) == pytest.approx(DT)  # of the inner model, which has no lag


# ---- zero residual


def window(key, n, delay):
    """Return a flight of the lagged model; commands act ``delay`` ticks after they were issued."""
    issued_commands = commands(key, n)
    acting = stack_trees(
        [Command.hover()] * delay + [jax.tree.map(lambda l, k=k: l[k], issued_commands) for k in range(n - delay)]
    )
    states = fly_once(lag_model(), lag_model().init(State.at(jnp.array(GOAL))), acting).inner
    x = jax.tree.map(lambda leaf: leaf[:n], states)
    return Window(jnp.asarray(DT * np.arange(n)), x, issued_commands, jnp.ones(n, dtype=bool))


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_lagged_flight_has_zero_residual(delay, key):
    rows = residual_targets(window(key, 40, delay), lag_model(), delay_ticks=delay)
    np.testing.assert_allclose(rows.a_res, 0.0, atol=1e-10)
    unaware = residual_targets(window(key, 40, delay), PointMass(DT), delay_ticks=delay)
    assert float(jnp.abs(unaware.a_res).max()) > 0.3


def test_residual_of_window_from_mid_flight_decays(key):
    """The command that acts at its first tick is unknown; the error decays with the lag to 4 % after five ticks."""
    late = jax.tree.map(lambda leaf: leaf[23:], window(key, 80, 1))
    away = np.linalg.norm(residual_targets(late, lag_model(), delay_ticks=1).a_res, axis=1)
    assert away[0] > 0.05
    assert away[5:].max() < 0.1
    assert away[35:].max() < 1e-6


def test_residual_of_partly_filled_window_decays(key):
    """The oldest tick is repeated in front and marked invalid, and has no effect soon after take-off."""
    whole = window(key, 60, 1)
    padding = jax.tree.map(lambda leaf: jnp.concatenate([jnp.repeat(leaf[:1], 20, axis=0), leaf]), whole)
    padding = replace_fields(padding, valid=jnp.arange(80) >= 20)
    rows = residual_targets(padding, lag_model(), delay_ticks=1)
    away = np.linalg.norm(rows.a_res, axis=1)
    assert away[27:].max() < 0.1
    assert away[57:].max() < 1e-6


def test_rates_lag_like_thrust():
    """The rotation after a tick of a roll command follows exactly from the mean rate, since the axis is constant."""
    u = Command(jnp.array(9.81), jnp.array([2.0, 0.0, 0.0]))
    s = lag_model().step(lag_model().init(State.at(jnp.array(GOAL))), u, STILL)
    angle = 2.0 * (DT - TAU * (1.0 - np.exp(-DT / TAU)))
    np.testing.assert_allclose(so3.log(s.inner.R), [angle, 0.0, 0.0], atol=1e-12)
    assert float(f_a(s.inner, u, STILL).v[1]) < 0.0  # rolled to the right: -y
