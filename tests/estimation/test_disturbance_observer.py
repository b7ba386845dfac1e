"""The disturbance observer is exact without noise, and estimates the noise that determines its bandwidth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import stack_trees
from retrim.estimation.disturbance_observer import DisturbanceObserver
from retrim.physics import ActuatorResponse, Command, CommandPath, PointMass, State, so3
from retrim.physics.actuators import apply_lag

DT, D = 0.02, jnp.array([1.5, -1.0, 2.0])


def observe(observer, key, *, ticks=200, noise=0.0, late=0, turning=1.0, d=D, thrust_tau=None):
    """Return estimates while a vehicle tumbles under random commands that act ``late`` ticks after they were issued.

    The vehicle turns ``turning`` times as fast as commanded, its thrust has the lag ``thrust_tau`` [s], and its
    velocity is measured with ``noise`` [m/s].
    """
    thrust_tau = None if thrust_tau is None else jnp.array(thrust_tau)
    return _observe(observer, key, ticks, jnp.array(noise), late, jnp.array(turning), d, thrust_tau)


@eqx.filter_jit
def _observe(observer, key, ticks, noise, late, turning, d, thrust_tau):
    model = PointMass(DT)
    keys = random.split(key, ticks)

    def command(k):
        return Command(9.81 + random.normal(k, ()), 2.0 * random.normal(random.fold_in(k, 1), (3,)))

    def tick(carry, xs):
        s, x, queue, thrust = carry
        k, k_noise, t = xs
        u = command(k)
        s = observer.issue(s, u)
        queue = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), queue, u)
        acting = jax.tree.map(lambda leaf: leaf[0], queue)
        c, thrust = (acting.c, thrust) if thrust_tau is None else apply_lag(thrust, acting.c, DT, thrust_tau)
        x = model.step(x, Command(c, turning * acting.omega), d)
        observation = State(x.p, x.R, x.v + noise * random.normal(k_noise, (3,)))
        s = observer(s, t, observation)
        return (s, x, queue, thrust), (s.d_hat, s.noise)

    x = State.at(jnp.zeros(3))
    hover = jax.tree.map(lambda leaf: jnp.stack([leaf] * (late + 1)), Command.hover(jnp.float64))
    start = (observer(observer.init(x), jnp.array(0.0), x), x, hover, hover.c[0])
    times = DT * jnp.arange(1.0, ticks + 1.0)
    _, result = jax.lax.scan(tick, start, (keys, random.split(random.fold_in(key, 7), ticks), times))
    return result


def make(*, tau=0.05, wander=4.0, limit=9.0, thrust_tau=None, limits=None, delay_ticks=0):
    path = CommandPath.of(delay_ticks * DT, ActuatorResponse.of(thrust_tau or 0.0))
    numbers = (jnp.array(each) for each in (tau, limit, wander))
    return DisturbanceObserver(PointMass(DT), *numbers, path, limits)


@pytest.mark.parametrize(("late", "turning"), [(0, 1.0), (2, 1.0), (0, 0.5)])
def test_estimate_without_noise_is_low_pass_of_disturbance(late, turning, key):
    """This holds for all commands and delays, and if the vehicle turns at a different rate than commanded."""
    result, _ = observe(make(delay_ticks=late, wander=np.inf), key, ticks=60, late=late, turning=turning)
    expected = np.asarray(D) * (1.0 - np.exp(-DT / 0.05 * np.arange(1, 61)))[:, None]
    np.testing.assert_allclose(result, expected, atol=2e-3 if turning == 1.0 else 2e-2)


@pytest.mark.parametrize("late", [0, 2])
def test_declared_thrust_lag_is_not_disturbance(late, key):
    """With an undeclared lag, each change of thrust appears as a disturbance."""
    calm = {"late": late, "thrust_tau": 0.04, "ticks": 60, "d": jnp.zeros(3)}
    message, _ = observe(make(delay_ticks=late, wander=np.inf, thrust_tau=0.04), key, **calm)
    untold, _ = observe(make(delay_ticks=late, wander=np.inf), key, **calm)
    assert float(jnp.abs(message).max()) < 2e-3
    assert float(jnp.abs(untold).max()) > 0.3


def test_estimate_is_held_while_command_at_limit_acts(key):
    """A mixer that lifts the vehicle at idle thrust is not wind."""
    limits = Command(jnp.array(0.2), -10.0 * jnp.ones(3)), Command(jnp.array(40.0), 10.0 * jnp.ones(3))
    observer, model, hover = make(limits=limits), PointMass(DT), Command.hover(jnp.float64)
    idle = Command(jnp.array(0.3), jnp.array([9.9, 0.0, 0.0]))

    def tick(carry, xs):
        (s, x, acting), (message, t) = carry, xs
        at_limit = acting.c < 1.0
        lift = jnp.where(at_limit, 1.0, 0.0) * 9.0 * x.R[:, 2]
        x = model.step(x, acting, D + lift)
        s = observer.issue(observer(s, t, x), message)
        return (s, x, message), (s.d_hat, at_limit)

    message = [hover] * 50 + [idle] * 20 + [hover] * 50
    x = State.at(jnp.zeros(3))
    later = stack_trees(message), jnp.asarray(DT * np.arange(1.0, len(message) + 1.0))

    @jax.jit
    def fly_once(x):
        first = observer(observer.init(x), jnp.array(0.0), x), x, hover
        return jax.lax.scan(tick, first, later)[1]

    result, at_limit = map(np.asarray, fly_once(x))
    np.testing.assert_allclose(result[51:], np.broadcast_to(D, result[51:].shape), atol=0.02)
    assert int(at_limit.sum()) == 20


def test_noise_estimate_equals_velocity_noise(key):
    for noise in (0.003, 0.03):
        _, result = observe(make(), key, ticks=1000, noise=noise)
        assert float(result[300:].mean()) == pytest.approx(noise, rel=0.1)


def test_noise_slows_estimate_without_bias(key):
    fast, _ = observe(make(wander=np.inf), key, ticks=1000, noise=0.03)
    wise, _ = observe(make(), key, ticks=1000, noise=0.03)
    assert wise[500:].std(axis=0).max() < 0.5 * fast[500:].std(axis=0).min()
    np.testing.assert_allclose(wise[500:].mean(axis=0), D, atol=0.05)


def test_error_is_close_to_best_constant_filter(key):
    """The best filter for this noise and this random walk is found by a search over time constants."""
    walk = jnp.cumsum(4.0 * DT**0.5 * random.normal(random.fold_in(key, 3), (1500, 3)), axis=0)
    observation = jnp.cumsum(DT * walk, axis=0) + 0.02 * random.normal(random.fold_in(key, 4), walk.shape)

    @eqx.filter_jit
    def error(observer):
        def tick(s, xs):
            v, t = xs
            s = observer.issue(observer(s, t, State(jnp.zeros(3), jnp.eye(3), v)), Command.hover(jnp.float64))
            return s, s.d_hat

        first = observer.init(State.at(jnp.zeros(3)))
        _, result = jax.lax.scan(tick, first, (observation, DT * jnp.arange(float(len(observation)))))
        return jnp.sqrt(jnp.mean((result - walk)[200:] ** 2))

    constant = min(error(make(tau=tau, wander=np.inf, limit=99.0)) for tau in (0.02, 0.05, 0.1, 0.2, 0.4))
    assert error(make(tau=1e-3, limit=99.0)) < 1.02 * constant


def test_irregular_intervals_are_not_disturbance():
    """The first measurement has no predecessor, and an interval with a missed tick has a different length."""
    observer, model, u = make(wander=np.inf), PointMass(DT), Command(jnp.array(12.0), jnp.array([0.5, 0.0, 0.0]))
    x = State(jnp.zeros(3), so3.exp(jnp.array([0.3, -0.3, 0.0])), jnp.array([1.0, 0.0, 0.0]))
    step = jax.jit(lambda s, t, x: observer.issue(observer(s, t, x), u))
    advance = jax.jit(lambda x: model.step(x, u, D))
    s = step(observer.init(x), jnp.array(0.0), x)
    np.testing.assert_array_equal(s.d_hat, 0.0)
    for k in range(1, 40):
        x = advance(x)
        if k in (20, 21, 30):
            continue
        before, s = s, step(s, jnp.array(DT * k), x)
        if k in (22, 31):
            np.testing.assert_array_equal(s.d_hat, before.d_hat)
        else:
            assert float(jnp.abs(s.d_hat - D).max()) <= float(jnp.abs(before.d_hat - D).max()) + 1e-6
    np.testing.assert_allclose(s.d_hat, D, atol=0.01)
