"""Targets of the residual: to the digit, under the command that acted; what a gap and a settling lag take away."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import random_field_flight, replaced, residual_targets
from retrim.learn import Window
from retrim.physics import Command, Lagged, PointMass, State

DT = 0.02


def linear_drag(x, u):
    return -0.4 * x.v + jnp.array([0.5, 0.0, 0.2])


def paused(window, at, seconds=7.0):
    """The same ticks, with ``seconds`` lost between the ticks ``at - 1`` and ``at``."""
    return replaced(window, t=window.t.at[at:].add(seconds))


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_targets_are_exact_when_the_delay_is_right(delay, key):
    window = random_field_flight(linear_drag, key, n=20, delay_ticks=delay)
    rows = residual_targets(window, PointMass(DT), delay_ticks=delay)
    assert rows.a_res.shape == (19 - delay, 3)
    assert rows.valid.all()
    np.testing.assert_allclose(rows.a_res, jax.vmap(linear_drag)(rows.x, rows.u), atol=1e-10)
    for wrong in {max(delay - 1, 0), delay + 1} - {delay}:
        other = residual_targets(window, PointMass(DT), delay_ticks=wrong)
        assert float(jnp.abs(other.a_res - jax.vmap(linear_drag)(other.x, other.u)).max()) > 0.1


def test_a_row_holds_the_state_at_its_tick_and_the_command_that_acted(key):
    window = random_field_flight(linear_drag, key, n=20, delay_ticks=2)
    rows = residual_targets(window, PointMass(DT), delay_ticks=2)
    np.testing.assert_array_equal(rows.x.p, window.x.p[2:19])
    np.testing.assert_array_equal(rows.u.c, window.u.c[:17])


@pytest.mark.parametrize("delay", [0, 1])
def test_measured_accelerations_take_the_place_of_differences(delay, key):
    """Noise of the velocity then leaves the targets alone; without the measurement it is magnified by 1 / dt."""
    window = random_field_flight(linear_drag, key, n=20, delay_ticks=delay)
    clean = residual_targets(window, PointMass(DT), delay_ticks=delay)
    measured = jnp.concatenate([jnp.diff(window.x.v, axis=0) / DT, jnp.zeros((1, 3))])
    rows = residual_targets(window, PointMass(DT), delay_ticks=delay, a_gt=measured)
    np.testing.assert_allclose(rows.a_res, clean.a_res, atol=1e-10)
    noisy = eqx.tree_at(lambda w: w.x.v, window, window.x.v + 0.1 * jax.random.normal(key, (20, 3)))
    aided = residual_targets(noisy, PointMass(DT), delay_ticks=delay, a_gt=measured)
    np.testing.assert_allclose(aided.a_res, clean.a_res, atol=1e-10)
    assert float(jnp.abs(residual_targets(noisy, PointMass(DT), delay_ticks=delay).a_res - clean.a_res).max()) > 1.0


def test_a_window_must_be_longer_than_the_delay(key):
    with pytest.raises(ValueError, match="window of 3 ticks is too short for a delay of 2"):
        residual_targets(random_field_flight(linear_drag, key, n=3), PointMass(DT), delay_ticks=2)


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_a_gap_in_time_masks_the_rows_that_straddle_it(delay, key):
    """Seven seconds between the ticks 11 and 12: row k takes the ticks k to k + delay + 1, so delay + 1 rows go."""
    window = paused(random_field_flight(linear_drag, key, n=30, delay_ticks=delay), at=12)
    rows = residual_targets(window, PointMass(DT), delay_ticks=delay)
    straddling = [k for k in range(29 - delay) if k < 12 <= k + delay + 1]
    assert len(straddling) == delay + 1
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(rows.valid)), straddling)


def test_jitter_of_the_clock_masks_nothing(key):
    """A tick may be up to a quarter longer or shorter; one that was lost may not."""
    window = random_field_flight(linear_drag, key, n=30)
    jittery = replaced(window, t=window.t + 0.1 * DT * jnp.sin(jnp.arange(30.0)))
    assert residual_targets(jittery, PointMass(DT)).valid.all()
    lost = residual_targets(paused(window, at=12, seconds=DT), PointMass(DT))
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(lost.valid)), [11])


@pytest.mark.parametrize("tau", [0.033, 0.1])
@pytest.mark.parametrize("filling", [0, 9])
def test_rows_wait_until_the_lag_has_settled(tau, filling, key):
    """The first ceil(3 tau / dt) valid rows: until then the lag still remembers the hover that it assumed."""
    window = random_field_flight(linear_drag, key, n=60, delay_ticks=1)
    window = replaced(window, valid=jnp.arange(60) >= filling)
    settled = residual_targets(window, Lagged(PointMass(DT), jnp.array(tau)), delay_ticks=1).valid
    plain = residual_targets(window, PointMass(DT), delay_ticks=1).valid
    assert int(jnp.argmax(plain)) == filling  # without a lag every valid row counts
    assert int(plain.sum()) == 58 - filling
    ticks = math.ceil(3.0 * tau / DT - 0.01)
    np.testing.assert_array_equal(np.flatnonzero(settled), np.arange(filling + ticks, 58))


# ---- windows


def test_a_window_of_columns_and_back(key):
    """From the columns of a log; what it holds is what was given, and every tick counts."""
    flown = random_field_flight(linear_drag, key, n=10)
    columns = [np.asarray(a) for a in (flown.t, flown.x.p, flown.x.R, flown.x.v, flown.u.c, flown.u.omega)]
    window = Window.of(*columns)
    jax.tree.map(np.testing.assert_array_equal, window, flown)
    assert window.valid.all()
    again = Window.of(window.t, window.x.p, window.x.R, window.x.v, window.u.c, window.u.omega)
    jax.tree.map(np.testing.assert_array_equal, again, window)


@pytest.mark.parametrize("age", [0.0, 0.01, 0.04])
@pytest.mark.parametrize("delay", [0, 1])
def test_a_row_whose_command_lies_beyond_a_gap_does_not_count(age, delay, key):
    """A tick is missing: whatever counts is true, and what does not reach over the gap counts."""
    n, whole = 40, math.ceil(age / DT)
    u = jax.vmap(Command)(9.81 + 2.0 * jax.random.normal(key, (n,)), jnp.zeros((n, 3)))
    v = jnp.cumsum(DT * (jnp.roll(u.c, delay).at[:delay].set(9.81) - 9.81))
    # States of the beginning of each tick, as far back as they are old; between two of them thrust is constant.
    t = DT * np.arange(n)
    seen = np.interp(t - age, t, np.concatenate([[0.0], v[:-1]]))
    x = jax.vmap(lambda v: State(jnp.zeros(3), jnp.eye(3), v * jnp.array([0.0, 0.0, 1.0])))(jnp.asarray(seen))
    window = Window(jnp.asarray(t), x, u, jnp.ones(n, dtype=bool), jnp.full(n, age))
    gone = jax.tree.map(lambda leaf: jnp.delete(leaf, 20, axis=0), window)
    rows = residual_targets(gone, PointMass(DT), delay_ticks=delay)
    assert float(jnp.abs(rows.a_res[np.asarray(rows.valid)]).max()) < 1e-9
    every = residual_targets(window, PointMass(DT), delay_ticks=delay)
    assert int(every.valid.sum()) - int(rows.valid.sum()) == 2 + delay + whole


@pytest.mark.parametrize("age", [0.0, 0.005, 0.01, 0.02, 0.03])
@pytest.mark.parametrize("delay", [0, 1])
def test_a_late_measurement_is_paired_with_the_command_that_acted_then(age, delay, key):
    """Of states that are 0 to 30 ms old, at a tick of 20 ms: the targets are those of the world, to a few per cent."""
    n, fine, d = 40, 4, jnp.array([0.5, -0.2, 0.3])
    k_c, k_w = jax.random.split(key)
    u = jax.vmap(Command)(9.81 + jax.random.normal(k_c, (n,)), 0.5 * jax.random.normal(k_w, (n, 3)))
    model = PointMass(DT / fine)

    def tick(x, i):
        late = jnp.maximum(i // fine - delay, 0)
        return model.step(x, jax.tree.map(lambda leaf: leaf[late], u), d), x

    _, x = jax.lax.scan(tick, State.at(jnp.array([0.0, 0.0, 1.0])), jnp.arange(n * fine))
    seen = np.maximum(fine * np.arange(n) - round(age / DT * fine), 0)
    states = jax.tree.map(lambda leaf: leaf[seen], x)
    window = Window(DT * jnp.arange(float(n)), states, u, jnp.ones(n, dtype=bool), jnp.full(n, age))
    rows = residual_targets(window, PointMass(DT), delay_ticks=delay)
    told = (rows.a_res - d[None])[np.asarray(rows.valid)]
    assert int((~rows.valid).sum()) == math.ceil(age / DT)
    untold = residual_targets(replaced(window, age=None), PointMass(DT), delay_ticks=delay).a_res - d[None]
    assert float(jnp.abs(told).mean()) < 0.03
    assert float(jnp.abs(untold).mean()) > 0.1 or age == 0.0
    if age == 0.0:
        np.testing.assert_array_equal(told, untold)
