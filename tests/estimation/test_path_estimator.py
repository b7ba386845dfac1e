"""The posterior of the command path is exact and calibrated, and uses only the data of its own vehicle."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from path_flight import DT, LEVELS, H, Vehicles, doublets, fly, random_vehicles
from retrim.control.excitation import Excitation
from retrim.estimation.command_path import PathEstimator, describe_path, noise, posterior
from retrim.estimation.command_path.channel import Sample
from retrim.estimation.command_path.history import CommandHistory
from retrim.estimation.command_path.prior import coefficients_before
from retrim.estimation.command_path.response import mean_step_response, ringing_of
from retrim.physics.state import Command, State

PIECE = 50  # ticks of one call of the program, which flights of any length share
EVERY = 5  # ticks between two estimates, which take nearly all of the time
TRACES: list[int] = []


@cache
def estimator():
    return PathEstimator.of(DT)


@eqx.filter_jit
def estimates(estimator, s, rows, age, inertial):
    """Return the state after ``PIECE`` ticks, and the estimate after each, which is new in one of ``EVERY`` ticks."""
    TRACES.append(1)

    def tick(s, row):
        k, t, p, R, v, omega, a, u = row
        s = estimator.observe(s, t, State(p, R, v), omega if inertial else None, a if inertial else None, age)
        s = jax.lax.cond((k + 1) % EVERY == 0, lambda s: estimator.estimate_path(s), lambda s: s, s)
        return estimator.issue(s, Command.of(u)), s.estimate

    return jax.lax.scan(tick, s, rows)


def estimate(flights, i=0, *, inertial=True, start=0.0, **changes):
    """Return the estimates of flight ``i`` as NumPy arrays over time."""
    choice = {name: np.array(getattr(flights, name)[i]) for name in ("p", "R", "v", "omega", "a", "u")} | changes
    n = len(choice["u"])
    t, k = start + DT * np.arange(n), np.arange(n)
    padding = -n % PIECE  # ticks at the end that are computed and not returned
    rows = [np.concatenate([x, np.repeat(x[-1:], padding, axis=0)]) for x in (t, *choice.values())]
    rows = (np.append(k, np.zeros(padding, int)), *(x.astype(np.float32) for x in rows))
    s, parts = estimator().init(State(*(jnp.asarray(row[0]) for row in rows[2:5]))), []
    for first in range(0, n, PIECE):
        part = tuple(jnp.asarray(x[first : first + PIECE]) for x in rows)
        s, result = estimates(estimator(), s, part, jnp.float32(flights.age), inertial)
        parts.append(result)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:n], *parts)


def one_vehicle(**changes):
    """Return a vehicle in the middle of the ranges."""
    typical = {
        "delay": 0.03,
        "rate_lag": 0.06,
        "rate_damping": 0.8,
        "yaw_lag": 0.1,
        "thrust_gain": 0.8,
        "thrust_lag": 0.04,
    }
    return Vehicles(*(np.array([x]) for x in (typical | changes).values()))


@pytest.mark.parametrize(("lag", "damping"), [(0.1, 0.4), (0.05, 0.7), (0.08, 1.0), (0.03, 1.2), (0.05, 20.0)])
@pytest.mark.parametrize("width", [0.0, 0.02])
def test_step_response_solves_its_differential_equation(lag, damping, width):
    natural, times = 2.0 * damping / lag, np.linspace(0.0, 0.4, 4001)

    def A(t, y):
        return [y[1], natural**2 * (1.0 - y[0]) - 2.0 * damping * natural * y[1], y[0]]

    y = integrate.solve_ivp(A, (0.0, 0.4), [0.0, 0.0, 0.0], t_eval=times, rtol=1e-8, atol=1e-10, method="LSODA").y
    before = np.interp(times - width, times, y[2])
    expected = (y[2] - before) / width if width else y[0]
    result = mean_step_response(jnp.array(times), jnp.array(width), jnp.array(lag), jnp.array(ringing_of(damping)))
    np.testing.assert_allclose(result, expected, atol=2e-3 if damping > 5 else 5e-4)


# One program each, instead of one for each operation.
channel_before = jax.jit(posterior.channel_before, static_argnums=(0, 2))
log_likelihood = jax.jit(posterior.log_likelihood, static_argnums=3)
path_posterior = jax.jit(lambda channel, prior: posterior.path_posterior(channel, prior, None, DT))
predicted = jax.jit(lambda channel, prior: channel.predict(path_posterior(channel, prior), coefficients_before(prior)))
responses = jax.jit(lambda cells, hover: posterior.responses(cells, jnp.zeros(()), jnp.zeros(()), hover, DT))
yaw_features = jax.jit(lambda history: history.features(DT)[3:])
issue = jax.jit(CommandHistory.issue)


@jax.jit
def observe(channel, features, value, kinds, model_error):
    zero = jnp.zeros(())
    sample = Sample(value[None], jnp.zeros((1, 0)), jnp.array(True), kinds, zero, zero)
    return channel.observe(features, sample, jnp.ones(()), DT, model_error=model_error)


def _linear_channel(kind, kinds, sigma, model_error, n=60):
    """Return a channel with the sums of a linear vehicle, and the data behind the sums."""
    rng, other_rng = np.random.default_rng(3), np.random.default_rng(4)
    prior = dataclasses.replace(estimator().yaw, cells=(11, 11, 7))
    channel, history = channel_before(1, prior, DT), CommandHistory.at_hover(DT)
    cell = jnp.array([[0.03, np.log(0.07), ringing_of(0.8)]])
    h = np.asarray(responses(cell, prior.hover))[0]
    mu, wander, phi = kinds[kind]
    rows, values, extra, e_old, disturbance, step = [], [], [], rng.normal(), 0.2, 0.0
    for k in range(n):
        features = np.append(np.asarray(yaw_features(history)), 0.0)
        e = rng.normal()
        error = model_error * (k % 3 == 0)
        value = 1.1 * features @ h + disturbance + sigma * (e - mu * e_old) + error * other_rng.normal()
        e_old, disturbance, step = e, disturbance + step, phi * step + sigma * np.sqrt(wander) * rng.normal()
        rows.append(features)
        values.append(value)
        extra.append(float(error / channel.noise) ** 2)
        channel = observe(channel, jnp.array(features[None]), jnp.array(value), jnp.array(kinds), jnp.array(error))
        if k % 10 == 9:
            channel = predicted(channel, prior)
        u = np.array([0.0, 0.0, 0.0, rng.choice([-1.0, 1.0])])
        history = issue(history, jnp.array(u))
    return channel, prior, np.array(rows), np.array(values), np.array(extra)


def _brute_force(cells, kind, channel, prior, rows, values, extra):
    """Return the log likelihood of each cell by the dense covariance of all measurements, in double precision."""
    n, (mu, wander, phi) = len(values), kind
    # The step s_k is a sum of w_j with the factor phi^(k-1-j), and the disturbance b_k is the sum of earlier steps.
    step = np.array([[sum(phi ** (i - 1 - j) for i in range(j + 1, k)) for j in range(n)] for k in range(n)])
    dense = noise.DIFFUSE + wander * step @ step.T + (1.0 + mu**2) * np.eye(n) - mu * (np.eye(n, k=1) + np.eye(n, k=-1))
    dense += np.diag(extra)
    h = np.asarray(responses(cells, prior.hover))
    y = rows @ h.T
    left = values[:, None] - float(prior.gain) * y
    loading = y * float(prior.gain_spread) / float(channel.noise)
    solution = np.linalg.solve(dense, loading)
    # The covariance of each cell is ``dense`` and the square of its loading: Sherman and Morrison.
    factor = 1.0 + np.sum(loading * solution, axis=0)
    square = np.sum(left * np.linalg.solve(dense, left), axis=0) - np.sum(left * solution, axis=0) ** 2 / factor
    square += n * float(prior.floor) ** 2 + posterior.FREEDOM * float(prior.noise) ** 2
    half_log = 0.5 * (np.linalg.slogdet(dense)[1] + np.log(factor))
    return -half_log - 0.5 * (n + posterior.FREEDOM) * np.log(square)


@pytest.mark.parametrize(
    ("kinds", "kind", "sigma", "model_error"),
    [(noise.DIRECT, 0, 0.05, 0.0), (noise.DIRECT, 5, 0.05, 0.2), (noise.DIFFERENCE, 0, 0.1, 0.0)],
)
def test_posterior_of_linear_vehicle_is_exact(kinds, kind, sigma, model_error):
    channel, prior, rows, values, extra = _linear_channel(kind, kinds, sigma, model_error)
    result = path_posterior(channel, prior)
    choice = kinds[int(result.kind)]
    axes = np.linspace(0.0, 0.06, 49), np.log(np.geomspace(0.04, 0.14, 49)), np.linspace(0.01, 0.85, 29)
    grid = np.meshgrid(*axes, indexing="ij")
    cells = np.stack([x.ravel() for x in grid], axis=1)
    exact = _brute_force(jnp.array(cells, float), choice, channel, prior, rows, values, extra)
    log_prior = -0.5 * ((cells[:, 1] - np.log(float(prior.lag))) / float(prior.lag_spread)) ** 2
    weight = np.exp(exact + log_prior - np.max(exact + log_prior))
    weight /= weight.sum()
    for i in range(3):
        mean = weight @ cells[:, i]
        deviation = np.sqrt(weight @ (cells[:, i] - mean) ** 2)
        mine = float(result.weight @ result.cells[:, i])
        spread = np.sqrt(float(result.weight @ (result.cells[:, i] - mine) ** 2))
        assert abs(mine - mean) < 0.25 * deviation
        assert 0.75 < spread / deviation < 1.3
    likely = np.asarray(result.cells)[np.argsort(-np.asarray(result.weight))[:50]]
    again = _brute_force(jnp.array(likely, float), choice, channel, prior, rows, values, extra)
    here = np.asarray(log_likelihood(channel, prior, jnp.array(likely), DT))[int(result.kind)]
    np.testing.assert_allclose(here - here[0], again - again[0], atol=0.1)


@pytest.fixture(scope="module")
def many_vehicles():
    """Return estimates for 50 random vehicles, excited for a second, with the sensors ``onboard``."""
    rng = np.random.default_rng(20)
    vehicles = random_vehicles(rng, 50)
    flights = fly(rng, vehicles, LEVELS["onboard"], 1.0, doublets)
    return vehicles, [estimate(flights, i) for i in range(50)]


def test_fifty_vehicles_are_identified_within_a_second(many_vehicles):
    vehicles, result = many_vehicles
    delay, lag, gain = (
        np.array([getattr(each, name).mean[-1] for each in result]) for name in ("delay", "rate_lag", "thrust_gain")
    )
    assert np.mean(np.abs(delay - vehicles.delay) < 0.008) >= 0.97
    assert np.mean(np.abs(lag / vehicles.rate_lag - 1.0) < 0.2) >= 0.95
    assert np.mean(np.abs(gain / vehicles.thrust_gain - 1.0) < 0.02) >= 0.85


@pytest.mark.parametrize("name", ["delay", "rate_lag", "yaw_lag", "thrust_gain", "thrust_lag"])
def test_intervals_have_stated_coverage(many_vehicles, name):
    vehicles, result = many_vehicles
    low, high = (np.array([getattr(getattr(each, name), end)[-1] for each in result]) for end in ("low", "high"))
    truth = getattr(vehicles, name)
    assert 0.82 <= np.mean((low <= truth) & (truth <= high)) <= 1.0
    assert all(getattr(each, name).excited[-1] for each in result)


def test_estimate_is_invariant_to_axis_swap_and_clock_offset():
    flights = fly(np.random.default_rng(1), one_vehicle(), LEVELS["mocap"], 1.0, doublets)
    plain, later = estimate(flights), estimate(flights, start=37.0)
    u, omega = flights.u[0].copy(), flights.omega[0].copy()
    u[:, [1, 2]], omega[:, [0, 1]] = u[:, [2, 1]], omega[:, [1, 0]]
    swap = estimate(flights, u=u, omega=omega)
    for name in ("delay", "rate_lag", "rate_gain"):
        one, two, three = (getattr(each, name) for each in (plain, swap, later))
        assert abs(one.mean[-1] - two.mean[-1]) < 0.05 * one.deviation[-1]
        assert abs(one.mean[-1] - three.mean[-1]) < 0.05 * one.deviation[-1]


def test_new_values_need_no_compilation():
    """Neither of vehicles, sensors and times, nor of the memory after some ticks."""
    estimate(fly(np.random.default_rng(2), one_vehicle(delay=0.01), LEVELS["ideal"], 0.2, doublets))
    program = len(TRACES)
    assert program > 0
    estimate(fly(np.random.default_rng(3), one_vehicle(delay=0.053), LEVELS["rough"], 1.2, doublets), start=5.0)
    assert len(TRACES) == program


@pytest.mark.parametrize("inertial", [True, False])
def test_vehicle_at_rest_is_not_informative(inertial):
    """A constant push at hover is not mistaken for a thrust gain."""
    rng, n = np.random.default_rng(4), 150
    R = np.tile(np.eye(3), (n, 1, 1))
    u = np.tile([8.0, 0.0, 0.0, 0.0], (n, 1))
    quiet = {"p": 1e-4 * rng.normal(size=(n, 3)), "R": R, "v": 3e-3 * rng.normal(size=(n, 3)), "u": u}
    quiet |= {"omega": 0.02 * rng.normal(size=(n, 3)), "a": 0.2 * rng.normal(size=(n, 3))}
    flights = fly(rng, one_vehicle(), LEVELS["ideal"], n * DT)
    result = estimate(flights, inertial=inertial, **{name: quiet[name] for name in ("p", "R", "v", "omega", "a", "u")})
    for name in ("delay", "rate_lag", "rate_gain", "yaw_lag"):
        assert not getattr(result, name).excited[-1], name
    assert result.thrust_gain.deviation[-1] > 0.1
    assert "not excited" in describe_path(jax.tree.map(lambda leaf: leaf[-1], result))


def on_circle(t):
    """Return the point and the velocity on a circle of 1 m, which begins at the start of a flight."""
    turn, speed = 1.8 * t, 1.8
    return (
        np.array([np.cos(turn) - 1.0, np.sin(turn), 0.3 * np.sin(turn)]),
        speed * np.array([-np.sin(turn), np.cos(turn), 0.3 * np.cos(turn)]),
    )


@pytest.mark.parametrize(
    ("inertial", "level", "begin", "force"),
    [
        (True, "mocap", 0.0, (2.0, -2.0, 2.0)),
        (False, "mocap", 3.0, (2.0, -2.0, 2.0)),
        (True, "onboard", 3.0, (3.0, 0.0, 0.0)),
    ],
)
def test_push_does_not_change_thrust_gain(inertial, level, begin, force):
    """A vehicle that leans into a push changes its thrust together with the part of the push along the thrust."""

    def push(t):
        return np.array(force) * (t >= begin)

    rng = np.random.default_rng(9)
    vehicles = random_vehicles(rng, 6)
    flights = fly(rng, vehicles, LEVELS[level], 7.0, push=push, goal=on_circle)
    gains = [estimate(flights, i, inertial=inertial).thrust_gain for i in range(6)]
    for seconds, limit in ((5.0, 0.025), (7.0, 0.015)):
        mean, low, high = (
            np.array([getattr(each, name)[round(seconds / DT) - 1] for each in gains])
            for name in ("mean", "low", "high")
        )
        assert np.abs(mean / vehicles.thrust_gain - 1.0).max() < limit
        assert np.mean((low <= vehicles.thrust_gain) & (vehicles.thrust_gain <= high)) > 0.8


def test_turbulence_does_not_change_thrust_gain():
    """The commands react to the turbulence, and more such data do not improve the estimate of the launch."""
    rng = np.random.default_rng(11)
    vehicles, n, steps = random_vehicles(rng, 6), 6, round(6.0 / H)
    turbulence, smooth = np.zeros((steps + 1, n, 3)), np.zeros((n, 3))
    for k in range(steps):
        smooth += H / 0.1 * (np.sqrt(2.0 * 0.1 / H) * rng.normal(size=(n, 3)) - smooth)
        turbulence[k + 1] = turbulence[k] + H / 0.03 * (smooth - turbulence[k])
    flights = fly(rng, vehicles, LEVELS["mocap"], 6.0, push=lambda t: turbulence[round(t / H)])
    gains = jax.tree.map(lambda *each: np.stack(each), *(estimate(flights, i).thrust_gain for i in range(n)))
    for k in (150, 299):
        off = gains.mean[:, k] / vehicles.thrust_gain - 1.0
        assert abs(np.mean(off)) < 0.15
        assert np.mean(np.abs(off)) < 0.3
        inside = (gains.low[:, k] <= vehicles.thrust_gain) & (vehicles.thrust_gain <= gains.high[:, k])
        assert np.mean(inside) > 0.6


def test_wrong_measurements_do_not_change_estimate():
    flights = fly(np.random.default_rng(5), one_vehicle(), LEVELS["mocap"], 1.6, doublets)
    p, R, v, omega, a = (np.array(x[0]) for x in flights[:5])
    omega[[55, 62, 70]] += [8.0, -6.0, 5.0]
    v[58] += 3.0
    p[66], R[66], v[66] = p[65], R[65], v[65]
    a[[57, 73]] -= 25.0
    good, bad = estimate(flights), estimate(flights, p=p, R=R, v=v, omega=omega, a=a)
    for name in ("delay", "rate_lag", "rate_gain", "thrust_gain"):
        one, two = getattr(good, name), getattr(bad, name)
        assert abs(one.mean[-1] - two.mean[-1]) < 0.7 * one.deviation[-1], name
        assert two.deviation[-1] < 1.4 * one.deviation[-1], name


def test_estimate_follows_change_of_vehicle():
    def excite(t):
        return doublets(t % 1.0)

    before, after = one_vehicle(rate_lag=0.04), one_vehicle(rate_lag=0.1)
    flights = fly(np.random.default_rng(6), before, LEVELS["onboard"], 7.0, excite, after, 2.0)
    result = estimate(flights)
    assert result.rate_lag.mean[95] == pytest.approx(0.04, rel=0.1)
    assert result.rate_lag.mean[-1] == pytest.approx(0.1, rel=0.2)


def test_report_line():
    flights = fly(np.random.default_rng(7), one_vehicle(), LEVELS["ideal"], 1.0, doublets)
    last = jax.tree.map(lambda leaf: leaf[-1], estimate(flights))
    assert describe_path(last, (0.02, 0.015)) == (
        "thrust gain 0.80 ± 0.01; rate delay 30 ms, lag 60 ms (vehicle file: 20 ms, 15 ms)"
    )
    delay, lag = last.first_order()
    assert float(delay + lag) == pytest.approx(0.09, abs=0.002)
    assert 0.5 < float(lag) / 0.06 < 0.8


def test_excitation_is_bounded_periodic_and_finite():
    excitation, s = Excitation.of(), estimator().init(State.at(jnp.zeros(3)))
    times = jnp.arange(0.0, 0.48, 0.004)
    c = jax.vmap(lambda t: excitation(t, s.estimate).c)(times)
    v = np.cumsum(c) * 0.004
    p = np.cumsum(v) * 0.004
    assert np.abs(c).max() == 2.0
    assert np.abs(p).max() < 0.04
    assert abs(v[-1]) < 0.02
    assert abs(p[-1]) < 0.004
    flights = fly(np.random.default_rng(8), one_vehicle(), LEVELS["ideal"], 1.0, doublets)
    narrow = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), estimate(flights))
    np.testing.assert_array_equal(excitation(jnp.array(0.1), narrow).vector(), 0.0)
    np.testing.assert_array_equal(excitation(jnp.array(4.0), s.estimate).vector(), 0.0)


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match="0 < dt < memory must hold, got dt = 0"):
        PathEstimator.of(0.0)
    with pytest.raises(ValueError, match="margins must be positive"):
        Excitation.of(delay_margin=0.0)
