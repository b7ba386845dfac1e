"""The largest pace: at the computed factors, commands reach the limits of the vehicle and do not exceed them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from retrim.config.loading import load
from retrim.config.pacing import pace_limits, training_tables
from retrim.control import pace, paced_flight
from retrim.control.pace import STEP, PaceLimits, largest_growth, points_ahead
from retrim.control.paced_flight import ideal_step
from retrim.physics import large, small
from retrim.tasks.paced_reference import Clock, PacedReference, at_pace
from retrim.tasks.shapes import circle, figure8, star

UP = np.array([0.0, 0.0, 9.81])
# One program each, instead of one for each operation.
largest_factors = jax.jit(pace.largest_factors)
feasible_share = jax.jit(paced_flight.feasible_share)
slow_pace = jax.jit(paced_flight.slow_pace)


def limits(thrust=30.0, rates=(8.0, 8.0, 4.0), lag=0.0, corner=0.05):
    return PaceLimits(jnp.array(thrust), jnp.array(rates), jnp.full(3, lag), jnp.array(corner), jnp.array(10.0))


@jax.jit
def points_of(reference, pace=1.0, phase=4.0):
    clock = Clock(jnp.array(0.0), jnp.asarray(phase, float), jnp.asarray(pace, float), jnp.array(0.0))
    return points_ahead(reference, clock)[1]


def stationary(points):
    return jnp.zeros_like(points.p)


@pytest.mark.parametrize(
    ("push", "thrust", "pace"),
    [((0.0, 0.0, 0.0), 14.0, 1.0), ((3.0, -2.0, 1.0), 40.0, 2.0), ((0.0, 3.0, -3.0), 20.0, 0.4)],
)
def test_thrust_at_the_factor_is_the_limit(push, thrust, pace):
    """Without limits on rates and corners, |factor^2 a + g - d| is the limit, unless the lift is the limit."""
    bounds = limits(thrust, (1e6,) * 3, corner=1e9)
    points = points_of(circle(), pace)
    d = jnp.broadcast_to(jnp.array(push)[None], points.p.shape)
    factors = largest_factors(points, bounds, d)
    needed = np.linalg.norm(np.asarray(factors)[:, None] ** 2 * np.asarray(points.a) + UP - push, axis=1)
    np.testing.assert_allclose(needed, thrust, rtol=1e-6)


@jax.jit
def factors_along(reference, bounds, share):
    phases = jnp.arange(0.0, 3.0, STEP) + 4.0
    points = jax.vmap(lambda phase: at_pace(reference(phase), share, jnp.zeros(())))(phases)
    return largest_factors(points, bounds, stationary(points), STEP / share)


def test_factors_are_inverse_to_the_pace():
    """The same path at twice the pace has half the factors for thrust, and for a corner."""
    for bounds in (limits(20.0, (1e6,) * 3, corner=1e9), limits(1e6, (1e6,) * 3)):
        reference = star() if float(bounds.thrust) > 1e5 else figure8()
        slow, fast = (factors_along(reference, bounds, jnp.array(share)) for share in (0.5, 1.0))
        np.testing.assert_allclose(slow.min() / fast.min(), 2.0, rtol=1e-2)


def test_corner_is_cut_by_permitted_distance():
    """A vehicle that turns with the acceleration a and cuts a jump of the velocity by e can absorb sqrt(8 a e)."""
    reference = star()
    bounds = limits(1e6, (1e6,) * 3)
    phases = jnp.arange(3.0, 9.0, STEP)
    points = jax.jit(jax.vmap(reference))(phases)
    factors = largest_factors(points, bounds, stationary(points))
    v = np.asarray(points.v)
    jump = np.linalg.norm(np.diff(v, axis=0), axis=1).max()
    np.testing.assert_allclose(float(factors.min()) * jump, np.sqrt(8.0 * 10.0 * 0.05), rtol=1e-3)


@pytest.mark.parametrize("name", ["thrust", "rates", "lag", "d"])
def test_weaker_vehicle_has_slower_pace(name):
    points = points_of(figure8())
    first = largest_factors(points, limits(), stationary(points))
    changed = {"thrust": limits(thrust=15.0), "rates": limits(rates=(3.0, 3.0, 4.0)), "lag": limits(lag=0.2)}
    d = jnp.broadcast_to(jnp.array([[0.0, 0.0, -12.0]]), points.p.shape) if name == "d" else stationary(points)
    second = largest_factors(points, changed.get(name, limits(thrust=23.0)), d)
    assert (np.asarray(second) <= np.asarray(first) + 1e-9).all()
    assert float(second.mean()) < 0.97 * float(first.mean())


def test_pace_grows_to_first_limit():
    tau, factors = jnp.array([0.0, 0.5, 1.0]), jnp.array([2.0, 0.8, 0.9])
    growth = largest_growth(tau, factors, jnp.array(1.0))
    np.testing.assert_allclose(growth, np.log(0.8) / 0.5)
    np.testing.assert_allclose(np.exp(growth * 0.5), 0.8)
    assert float(largest_growth(tau, factors, jnp.array(0.5))) < float(growth)


@partial(jax.jit, static_argnames="dt")
def ideal_flight(reference, bounds, dt):
    def step(clock, _):
        point = PacedReference(reference, clock)(clock.t)
        return ideal_step(reference, bounds, clock, jnp.array(1.0), dt), (clock, point)

    return lax.scan(step, Clock.at_pace(slow_pace(reference)), None, length=1500)[1]


@pytest.mark.parametrize("make", [circle, figure8, star])
@pytest.mark.parametrize("vehicle", [small, large])
def test_ideal_flight_stays_within_limits(make, vehicle):
    """The pace grows until a limit is reached; thrust and rates from position differences remain below it."""
    reference, dt = make(), 0.02
    bounds = pace_limits(load("track/retrim"), vehicle())

    clocks, points = jax.tree.map(np.asarray, ideal_flight(reference, bounds, dt))
    assert (np.diff(clocks.phase) > 0.0).all()
    assert float(clocks.pace.max()) > 1.5 * float(clocks.pace[0])
    full = vehicle()
    smooth = np.linalg.norm(np.diff(points.v, axis=0), axis=1) / dt < 1.1 * np.linalg.norm(points.a, axis=1)[1:] + 3.0
    thrust = np.linalg.norm(np.diff(points.v, axis=0) / dt + UP, axis=1)
    assert (thrust[smooth] <= float(full.command_max.c)).all()
    assert (np.abs(points.u[:, 1:3]) <= np.asarray(full.omega_max)[:2]).all()
    if make is not star:
        assert smooth.mean() > 0.99
        rates = np.abs(points.u[1:, 1:3]).max(1)
        used = np.maximum(thrust / float(full.command_max.c), rates / float(full.omega_max[0]))
        assert used.max() > 0.6  # the pace is not needlessly slow
    else:
        jumps = np.linalg.norm(np.diff(points.v, axis=0), axis=1)
        assert jumps.max() <= 1.25 * np.sqrt(8.0 * 10.0 * 0.05)


def test_first_lap_is_slow_with_known_share():
    reference, bounds = figure8(), pace_limits(load("track/retrim"), large())
    pace = slow_pace(reference)
    points = jax.jit(jax.vmap(reference))(jnp.linspace(0.0, 8.0, 400))
    assert float(pace) * float(jnp.linalg.norm(points.v, axis=1).max()) <= 1.0 + 1e-6
    assert 0.0 < float(feasible_share(reference, bounds, pace)) < 0.3
    assert float(feasible_share(reference, bounds, 100.0 * pace)) == 1.0


def test_training_tables_contain_slow_and_fast_laps():
    slow, fast = training_tables(figure8(), pace_limits(load("track/retrim"), large()))
    speeds = [np.linalg.norm(np.asarray(table.rows[:, 3:6]), axis=1) for table in (slow, fast)]
    for speed in speeds:
        assert speed[:100].max() < 0.35 * speed[-200:].max()
    assert speeds[0].max() < speeds[1].max()
    np.testing.assert_allclose(np.asarray(fast.distance(fast.rows[700, :3])), 0.0, atol=1e-6)
