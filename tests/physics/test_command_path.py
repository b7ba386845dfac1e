"""The command path: delay, thrust lag and rate loop in one object, compared with closed forms and fine simulations."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random
from scipy.linalg import expm

from helpers import check_slope, random_command, stack_trees
from retrim.physics import ActuatorResponse, ActuatorState, Command, CommandPath, CommandQueue
from retrim.physics.command_path import queue_length, whole_steps

DT = 0.02
STEP = Command(jnp.array(12.0), jnp.array([1.0, -2.0, 0.5]))
REST = ActuatorState.at(Command(jnp.array(9.81), jnp.zeros(3)))


def commands(key, n):
    return stack_trees([random_command(k) for k in random.split(key, n)])


@eqx.filter_jit
def follow(path, us, start, dt=DT):
    """Return means over each tick and states at its end, for commands that are constant over a tick."""

    def tick(s, u):
        mean, s = path(s, u, dt)
        return s, (mean, s.actuators)

    return lax.scan(tick, path.init(start, dt), us)[1]


@eqx.filter_jit
def advance(response, s, u, time):
    """Return the integral of the response over a duration, and the state at its end."""
    away, end = response(s, u, time)
    return jax.tree.map(lambda target, each: time * target + each, response.target(u), away), end


@eqx.filter_jit
def step_response(response, times):
    return jax.vmap(lambda t: advance(response, REST, STEP, t))(times)


# ---- one response


@pytest.mark.parametrize("lag", [0.005, 0.06, 0.4])
def test_first_order_step(lag):
    times = np.linspace(0.0, 0.5, 26)
    total, s = step_response(ActuatorResponse.of(lag, lag), jnp.asarray(times))
    rise = 1.0 - np.exp(-times / lag)
    np.testing.assert_allclose(s.command.c, 9.81 + 2.19 * rise, rtol=1e-12)
    np.testing.assert_allclose(s.command.omega, rise[:, None] * np.asarray(STEP.omega), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(total.c, 12.0 * times - 2.19 * lag * rise, rtol=1e-12)
    np.testing.assert_allclose(total.omega[:, 1], -2.0 * (times - lag * rise), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("zeta", [0.4, 0.5, 0.7, 0.95, 0.999999, 1.0, 1.000001, 1.05, 1.2, 3.0])
def test_second_order_step(zeta):
    """The closed form is that of textbooks, for damping ratios below and above one."""
    lag, times = 0.08, np.linspace(0.0, 0.6, 61)
    _, s = step_response(ActuatorResponse.of(0.0, lag, inverse_damping=1.0 / zeta), jnp.asarray(times))
    omega_n = 2.0 * zeta / lag
    root = np.sqrt(complex(1.0 - zeta**2))
    if abs(zeta - 1.0) < 1e-9:
        remainder = np.exp(-omega_n * times) * (1.0 + omega_n * times)
    else:
        swing = np.cos(omega_n * root * times) + zeta / root * np.sin(omega_n * root * times)
        remainder = np.real(np.exp(-zeta * omega_n * times) * swing)
    # the closed form is inaccurate near 1
    np.testing.assert_allclose(s.command.omega[:, 0], 1.0 - remainder, atol=2e-10)
    overshoot = float(s.command.omega[:, 0].max()) - 1.0
    expected = np.exp(-np.pi * zeta / np.sqrt(1.0 - zeta**2)) if zeta < 1.0 else 0.0
    assert overshoot == pytest.approx(expected, abs=5e-3)


def matrix_exponential(response, state, u, h, axis):
    """Return rate, slope and integral about an axis from the exponential of the loop's matrix."""
    tau, kappa, gain = (float(x[axis]) for x in (response.rate_lag, response.inverse_damping, response.rate_gain))
    target, sigma = gain * float(u.omega[axis]), (0.5 * tau * kappa) ** 2
    matrix = np.zeros((4, 4))  # of [w, w', integral, 1]
    matrix[0, 1], matrix[1], matrix[2, 0] = 1.0, [-1.0 / sigma, -tau / sigma, 0.0, target / sigma], 1.0
    start = [float(state.command.omega[axis]), float(state.slope[axis]) / tau, 0.0, 1.0]
    w, slope, turn, _ = expm(h * matrix) @ np.array(start)
    return w, tau * slope, turn


@pytest.mark.parametrize("h", [1e-4, 0.002, 0.02, 0.2])
def test_response_equals_matrix_exponential(h):
    """The start is any state with a slope and a gain; three dampings are tested at once."""
    response = ActuatorResponse.of(
        0.03, jnp.array([0.05, 0.12, 0.3]), inverse_damping=jnp.array([2.5, 1.02, 0.6]), rate_gain=0.8
    )
    state = ActuatorState(Command(jnp.array(8.0), jnp.array([0.4, -0.7, 0.2])), jnp.array([0.5, -1.0, 2.0]))
    total, end = advance(response, state, STEP, jnp.array(h))
    for axis in range(3):
        result = (end.command.omega[axis], end.slope[axis], total.omega[axis])
        np.testing.assert_allclose(result, matrix_exponential(response, state, STEP, h, axis), rtol=1e-9, atol=1e-11)


def test_second_order_converges_to_first_order():
    times = jnp.linspace(0.001, 0.3, 50)
    plain = step_response(ActuatorResponse.of(0.05, 0.07), times)
    for kappa, off in ((1e-2, 1e-3), (1e-4, 1e-7)):
        nearly = step_response(ActuatorResponse.of(0.05, 0.07, inverse_damping=kappa), times)
        for a, b in zip(jax.tree.leaves(nearly), jax.tree.leaves(plain), strict=True):
            np.testing.assert_allclose(a, b, atol=off)


def test_zero_lag_is_identity():
    total, end = advance(ActuatorResponse.of(), REST, STEP, jnp.array(DT))
    jax.tree.map(np.testing.assert_array_equal, end, ActuatorState.at(STEP))
    np.testing.assert_allclose(total.vector(), DT * STEP.vector(), rtol=1e-15)


def test_zero_duration_changes_nothing():
    response = ActuatorResponse.of(0.03, 0.05, inverse_damping=1.4)
    state = ActuatorState(STEP, jnp.array([0.5, -1.0, 2.0]))
    total, end = advance(response, state, Command(jnp.array(5.0), jnp.ones(3)), jnp.array(0.0))
    jax.tree.map(np.testing.assert_array_equal, end, state)
    np.testing.assert_array_equal(total.vector(), 0.0)


def test_steps_compose():
    response = ActuatorResponse.of(0.03, 0.05, inverse_damping=1.4)
    one, end = advance(response, REST, STEP, jnp.array(0.05))
    half, middle = advance(response, REST, STEP, jnp.array(0.02))
    rest, after = advance(response, middle, STEP, jnp.array(0.03))
    np.testing.assert_allclose(half.vector() + rest.vector(), one.vector(), rtol=1e-12)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(end), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11)


def test_gains_scale_final_value():
    response = ActuatorResponse.of(0.02, 0.03, thrust_gain=0.7, rate_gain=jnp.array([1.2, 0.9, 0.5]))
    _, end = advance(response, REST, STEP, jnp.array(5.0))
    assert float(end.command.c) == pytest.approx(8.4)
    np.testing.assert_allclose(end.command.omega, [1.2, -1.8, 0.25], rtol=1e-12)


# ---- the queue


@pytest.mark.parametrize("ticks", [0, 1, 2, 5, 10])
def test_whole_ticks_equal_queue(ticks, key):
    """Bit for bit: a command acts after that many ticks, and hover commands act before."""
    us = commands(key, 30)
    path = CommandPath.of(ticks * DT)

    def tick(queue, u):
        queue = queue.push(u)
        return queue, queue.arrival(path.delay, DT)

    start = CommandQueue.of(Command.hover(float), DT)
    result = jax.jit(lambda us: lax.scan(tick, start, us)[1])(us).omega
    expected = np.concatenate([np.zeros((ticks, 3)), us.omega])[:30]
    np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("dt", [0.002, 0.01, 0.02, 0.03])
def test_whole_ticks_are_exact_in_every_precision(dt, dtype):
    n = np.arange(queue_length(dt))
    np.testing.assert_array_equal(jax.jit(whole_steps, static_argnums=1)(jnp.asarray(n * dt, dtype), dt), n)


def test_fractional_delay_is_mean_of_two_commands(key):
    us = commands(key, 12)
    mean, _ = follow(CommandPath.of(0.026), us, Command.hover(float))
    late = np.concatenate([np.full(2, 9.81), us.c])
    np.testing.assert_allclose(mean.c, (0.7 * late[1:] + 0.3 * late[:-1])[:12], rtol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.0037, 0.02, 0.0333, 0.117, 0.2])
@pytest.mark.parametrize("kappa", [0.0, 0.9, 2.5])
def test_path_equals_fine_simulation(delay, kappa, key):
    """The simulation takes 20 exact steps per tick; in each, one command acts, or two in succession."""
    us = commands(key, 25)
    response = ActuatorResponse.of(0.04, jnp.array([0.03, 0.08, 0.2]), inverse_damping=kappa, rate_gain=1.1)
    mean, states = follow(CommandPath.of(delay, response), us, Command.hover(float))
    switches = DT * np.arange(25) + delay
    edges = np.unique(np.round(np.concatenate([switches, np.arange(0.0, 0.5001, 0.001)]), 12))
    edges = edges[(edges >= 0.0) & (edges <= 0.5 + 1e-9)]
    s, total = ActuatorState.at(Command.hover(float)), np.zeros(4)
    hover, issued = (jax.tree.map(np.asarray, u) for u in (Command.hover(float), us))
    for begin, end in itertools.pairwise(edges):
        k = int(np.sum(switches <= begin + 1e-9)) - 1
        u = hover if k < 0 else jax.tree.map(lambda leaf, k=k: leaf[k], issued)
        part, s = advance(response, s, u, end - begin)
        total += np.append(part.c, part.omega)
        tick = round(end / DT) - 1
        if abs(end - DT * (tick + 1)) < 1e-9:
            np.testing.assert_allclose(mean.c[tick], total[0] / DT, rtol=1e-9)
            np.testing.assert_allclose(mean.omega[tick], total[1:] / DT, atol=1e-9)
            np.testing.assert_allclose(states.command.omega[tick], s.command.omega, atol=1e-9)
            np.testing.assert_allclose(states.slope[tick], s.slope, atol=1e-9)
            total = np.zeros(4)


def test_delay_beyond_queue_is_clipped(key):
    us = commands(key, 20)
    longest, longer = (follow(CommandPath.of(delay), us, Command.hover(float))[0] for delay in (0.2, 0.35))
    jax.tree.map(np.testing.assert_array_equal, longer, longest)


# ---- as a value


def mixture(path, us, start, weights):
    means, states = follow(path, us, start)
    return sum(jnp.sum(weights[0] * leaf[-1]) for leaf in jax.tree.leaves((means, states))) + jnp.sum(means.c)


@jax.jit
def cost(arguments):
    return mixture(*arguments, jnp.array([0.7], arguments[1].c.dtype))


slope_of_cost = jax.jit(jax.grad(cost))


@pytest.mark.parametrize("kappa", [0.3, 0.97, 1.0, 1.03, 2.0])
def test_gradients_equal_finite_differences(kappa, key):
    """Gradients with respect to commands, start, delay, lags, gains and damping, including near-critical damping."""
    response = ActuatorResponse.of(0.05, jnp.array([0.03, 0.06, 0.2]), inverse_damping=kappa, thrust_gain=1.1)
    arguments = (CommandPath.of(0.033, response), commands(key, 8), random_command(random.key(5)))
    slope = check_slope(cost, arguments, key, h=2e-7, rel=1e-5)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))
    assert abs(float(slope[0].delay)) > 1e-3
    assert float(jnp.abs(slope[0].response.inverse_damping).min()) > 1e-6


@pytest.mark.parametrize(
    ("lag", "kappa", "delay"), [(0.0, 0.0, 0.0), (0.05, 0.0, 0.02), (1e-7, 3.0, 0.2), (5.0, 1.0, 0.1)]
)
def test_gradients_are_finite_at_boundaries(lag, kappa, delay, key):
    response = ActuatorResponse.of(lag, lag, inverse_damping=kappa)
    arguments = (CommandPath.of(delay, response), commands(key, 5), Command.hover(float))
    for dtype in (jnp.float64, jnp.float32):
        cast = jax.tree.map(lambda leaf, dtype=dtype: leaf.astype(dtype), arguments)
        slope = slope_of_cost(cast)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))


def test_new_path_needs_no_compilation(key):
    traces = []

    @eqx.filter_jit
    def fly(path, us):
        traces.append(path)
        return follow(path, us, Command.hover(float))

    us = commands(key, 5)
    for delay, lag, kappa, gain in (
        (0.0, 0.0, 0.0, 1.0),
        (0.02, 0.05, 0.5, 0.7),
        (0.0371, 0.25, 2.5, 1.4),
        (0.1, 1.0, 1.0, 1.0),
    ):
        fly(CommandPath.of(delay, ActuatorResponse.of(lag, lag, inverse_damping=kappa, thrust_gain=gain)), us)
    fly(CommandPath.of(jnp.array(0.05), ActuatorResponse.of(rate_lag=jnp.array([0.1, 0.1, 0.3]))), us)
    assert len(traces) == 1


def test_batch_equals_members(key):
    us = commands(key, 15)
    paths = [
        CommandPath.of(delay, ActuatorResponse.of(0.03, lag, inverse_damping=kappa))
        for delay, lag, kappa in ((0.0, 0.02, 0.0), (0.05, 0.1, 1.0), (0.0333, 0.2, 2.5))
    ]
    together = eqx.filter_jit(jax.vmap(lambda path: follow(path, us, Command.hover(float))))(stack_trees(paths))
    for i, path in enumerate(paths):
        alone = follow(path, us, Command.hover(float))
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-13, atol=1e-15)


def test_single_precision_is_close(key):
    us = commands(key, 30)
    path = CommandPath.of(0.047, ActuatorResponse.of(0.05, 0.08, inverse_damping=1.7))
    exactly = follow(path, us, Command.hover(float))
    low = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (path, us))
    result = follow(*low, Command.hover(jnp.float32))
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(exactly), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_settling_time_is_that_of_roll_and_pitch():
    response = ActuatorResponse.of(0.02, jnp.array([0.05, 0.06, 1.0]))
    assert float(response.settling_time) == pytest.approx(0.18)
    ringing = dataclasses.replace(response, inverse_damping=jnp.full(3, 2.5))
    assert float(ringing.settling_time) == pytest.approx(0.18 * 3.125)
