"""Targets of the residual: exact, for the acting command; rows excluded by a gap or by the settling of a lag."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import first_order, random_field_flight, replace_fields, residual_targets
from retrim.learn import Window
from retrim.physics import Command, LaggedModel, PointMass, State

DT = 0.02


def linear_drag(x, u):
    return -0.4 * x.v + jnp.array([0.5, 0.0, 0.2])


drag = jax.jit(jax.vmap(linear_drag))


def pause(window, at, seconds=7.0):
    """Return the same ticks, with ``seconds`` missing between the ticks ``at - 1`` and ``at``."""
    return replace_fields(window, t=window.t + seconds * (np.arange(window.t.size) >= at))


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_targets_are_exact_for_correct_delay(delay, key):
    window = random_field_flight(linear_drag, key, n=30, delay_ticks=delay)
    rows = residual_targets(window, PointMass(DT), delay_ticks=delay)
    assert rows.a_res.shape == (29 - delay, 3)
    assert np.all(rows.valid)
    np.testing.assert_allclose(rows.a_res, drag(rows.x, rows.u), atol=1e-10)
    for wrong in {max(delay - 1, 0), delay + 1} - {delay}:
        other = residual_targets(window, PointMass(DT), delay_ticks=wrong)
        assert np.abs(np.asarray(other.a_res) - np.asarray(drag(other.x, other.u))).max() > 0.1


def test_row_has_state_at_its_tick_and_acting_command(key):
    window = random_field_flight(linear_drag, key, n=30, delay_ticks=2)
    rows = residual_targets(window, PointMass(DT), delay_ticks=2)
    np.testing.assert_array_equal(rows.x.p, np.asarray(window.x.p)[2:29])
    np.testing.assert_array_equal(rows.u.c, np.asarray(window.u.c)[:27])


@pytest.mark.parametrize("delay", [0, 1])
def test_measured_accelerations_replace_differences(delay, key):
    """Noise of the velocity then has no effect; without the measurement it is multiplied by 1 / dt."""
    window = random_field_flight(linear_drag, key, n=30, delay_ticks=delay)
    clean = residual_targets(window, PointMass(DT), delay_ticks=delay)
    measurement = jnp.asarray(np.append(np.diff(window.x.v, axis=0) / DT, np.zeros((1, 3)), axis=0))
    rows = residual_targets(window, PointMass(DT), delay_ticks=delay, a_gt=measurement)
    np.testing.assert_allclose(rows.a_res, clean.a_res, atol=1e-10)
    noisy = eqx.tree_at(lambda w: w.x.v, window, window.x.v + 0.1 * jax.random.normal(key, (30, 3)))
    with_aid = residual_targets(noisy, PointMass(DT), delay_ticks=delay, a_gt=measurement)
    np.testing.assert_allclose(with_aid.a_res, clean.a_res, atol=1e-10)
    without_aid = residual_targets(noisy, PointMass(DT), delay_ticks=delay)
    assert np.abs(np.asarray(without_aid.a_res) - np.asarray(clean.a_res)).max() > 1.0


def test_window_must_be_longer_than_delay(key):
    short = jax.tree.map(lambda leaf: jnp.asarray(leaf[:3]), random_field_flight(linear_drag, key, n=30))
    with pytest.raises(ValueError, match="window of 3 ticks is too short for a delay of 2"):
        residual_targets(short, PointMass(DT), delay_ticks=2)


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_gap_in_time_excludes_rows_across_it(delay, key):
    """Seven seconds between the ticks 11 and 12: row k uses the ticks k to k + delay + 1, so delay + 1 rows are
    excluded.
    """
    window = pause(random_field_flight(linear_drag, key, n=30, delay_ticks=delay), at=12)
    rows = residual_targets(window, PointMass(DT), delay_ticks=delay)
    straddling = [k for k in range(29 - delay) if k < 12 <= k + delay + 1]
    assert len(straddling) == delay + 1
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(rows.valid)), straddling)


def test_clock_jitter_excludes_no_rows(key):
    """A tick may be up to a quarter longer or shorter; a missed tick is excluded."""
    window = random_field_flight(linear_drag, key, n=30)
    jittery = replace_fields(window, t=window.t + 0.1 * DT * jnp.sin(jnp.arange(30.0)))
    assert residual_targets(jittery, PointMass(DT)).valid.all()
    gap = residual_targets(pause(window, at=12, seconds=DT), PointMass(DT))
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(gap.valid)), [11])


@pytest.mark.parametrize("tau", [0.033, 0.1])
@pytest.mark.parametrize("filling", [0, 9])
def test_rows_before_lag_has_settled_are_excluded(tau, filling, key):
    """The first ceil(3 tau / dt) valid rows still depend on the assumed initial hover."""
    window = random_field_flight(linear_drag, key, n=30, delay_ticks=1)
    window = replace_fields(window, valid=jnp.arange(30) >= filling)
    valid = residual_targets(window, LaggedModel(PointMass(DT), first_order(tau)), delay_ticks=1).valid
    plain = residual_targets(window, PointMass(DT), delay_ticks=1).valid
    assert np.argmax(plain) == filling  # without a lag every valid row counts
    assert np.sum(plain) == 28 - filling
    ticks = math.ceil(3.0 * tau / DT - 0.01)
    np.testing.assert_array_equal(np.flatnonzero(valid), np.arange(filling + ticks, 28))


# ---- windows


def test_window_from_columns_survives_round_trip(key):
    """The columns are those of a log; the window contains the given values, and every tick counts."""
    flight = random_field_flight(linear_drag, key, n=30)
    columns = [np.asarray(a) for a in (flight.t, flight.x.p, flight.x.R, flight.x.v, flight.u.c, flight.u.omega)]
    window = Window.of(*columns)
    jax.tree.map(np.testing.assert_array_equal, window, flight)
    assert window.valid.all()
    again = Window.of(window.t, window.x.p, window.x.R, window.x.v, window.u.c, window.u.omega)
    jax.tree.map(np.testing.assert_array_equal, again, window)


@pytest.mark.parametrize("age", [0.0, 0.01, 0.04])
@pytest.mark.parametrize("delay", [0, 1])
def test_row_whose_command_is_beyond_gap_is_excluded(age, delay):
    """One tick is missing: all valid rows are exact, and rows that do not cross the gap are valid."""
    n, whole, draw = 40, math.ceil(age / DT), np.random.default_rng(0)
    c = 9.81 + 2.0 * draw.normal(size=n)
    v = np.cumsum(DT * (np.append(np.full(delay, 9.81), c)[:n] - 9.81))
    # States before the beginning of each tick by their age; the thrust is constant between two of them.
    t, zero = DT * np.arange(n), np.zeros((n, 3))
    observation = np.interp(t - age, t, np.concatenate([[0.0], v[:-1]]))
    setup = Window.of(t, zero, np.tile(np.eye(3), (n, 1, 1)), observation[:, None] * np.array([0.0, 0.0, 1.0]), c, zero)
    window = replace_fields(setup, age=jnp.full(n, age))
    loss = jax.tree.map(lambda leaf: jnp.asarray(np.delete(leaf, 20, axis=0)), window)
    rows = residual_targets(loss, PointMass(DT), delay_ticks=delay)
    assert np.abs(np.asarray(rows.a_res)[np.asarray(rows.valid)]).max() < 1e-9
    every = residual_targets(window, PointMass(DT), delay_ticks=delay)
    assert np.sum(every.valid) - np.sum(rows.valid) == 2 + delay + whole


FINE, PUSH = 4, (0.5, -0.2, 0.3)


@jax.jit
def fly_finely(key, delay):
    """Return commands of 40 ticks, and states at every quarter of a tick under ``PUSH``."""
    k_c, k_w = jax.random.split(key)
    u = jax.vmap(Command)(9.81 + jax.random.normal(k_c, (40,)), 0.5 * jax.random.normal(k_w, (40, 3)))
    model = PointMass(DT / FINE)

    def tick(x, i):
        late = jnp.maximum(i // FINE - delay, 0)
        return model.step(x, jax.tree.map(lambda leaf: leaf[late], u), jnp.array(PUSH)), x

    return u, jax.lax.scan(tick, State.at(jnp.array([0.0, 0.0, 1.0])), jnp.arange(40 * FINE))[1]


@pytest.mark.parametrize("age", [0.0, 0.005, 0.01, 0.02, 0.03])
@pytest.mark.parametrize("delay", [0, 1])
def test_late_measurement_is_paired_with_its_acting_command(age, delay, key):
    """For states that are 0 to 30 ms old at a tick of 20 ms, the targets agree with the world within a few per cent."""
    u, x = fly_finely(key, delay)
    observation = np.maximum(FINE * np.arange(40) - round(age / DT * FINE), 0)
    states = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[observation]), x)
    window = Window(DT * jnp.arange(40.0), states, u, jnp.ones(40, dtype=bool), jnp.full(40, age))
    rows = residual_targets(window, PointMass(DT), delay_ticks=delay)
    message = (np.asarray(rows.a_res) - np.array(PUSH))[np.asarray(rows.valid)]
    assert np.sum(~np.asarray(rows.valid)) == math.ceil(age / DT)
    untold = residual_targets(replace_fields(window, age=None), PointMass(DT), delay_ticks=delay).a_res - np.array(
        [PUSH]
    )
    assert np.abs(message).mean() < 0.03
    assert np.abs(untold).mean() > 0.1 or age == 0.0
    if age == 0.0:
        np.testing.assert_array_equal(message, untold)
