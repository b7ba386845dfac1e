"""The load filter estimates direction, mass and length of a hidden load, and zero mass without a load."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import call
from loads import DT, angle_between, flight
from retrim.estimation.slung_load import STEEPEST, Load, LoadEstimate
from retrim.physics import SlungLoad, so3
from retrim.physics.state import STANDARD_GRAVITY

G = np.array([0.0, 0.0, -STANDARD_GRAVITY])


@jax.jit
def estimates(rows):
    def tick(s, row):
        a, v = (row.v - row.before) / DT, 0.5 * (row.v + row.before)
        s = s.predict(a, DT).correct(row.missed, a, v, row.thrust, jnp.array(0.0), jnp.array(True), DT)
        return s, s

    return lax.scan(tick, LoadEstimate.start(rows.missed.dtype), rows)[1]


def directions(s):
    return jax.vmap(lambda z: Load.of(z).direction)(s.z)


@pytest.mark.parametrize(("share", "length"), [(0.1, 0.5), (0.2, 0.3), (0.3, 0.5), (0.4, 1.0), (0.5, 0.7)])
def test_mass_length_and_direction_converge_in_seconds(share, length, key):
    rows = flight(share, length, key=key, noise=0.1)
    s = estimates(rows)
    end = Load.of(s.z[-1])
    assert float(end.share) == pytest.approx(share, abs=0.02 + 0.1 * share)
    assert float(end.length) == pytest.approx(length, rel=0.08)
    errors = angle_between(directions(s), rows.direction)
    assert np.degrees(errors[150:]).max() < 6.0
    assert np.degrees(errors[300:]).mean() < 3.0
    assert float(end.drag) == pytest.approx(0.3, abs=0.1)
    deviation = np.sqrt(np.asarray(s.P[-1, 7, 7]))
    assert abs(float(end.share) - share) < 4.0 * deviation  # the stated uncertainty is consistent


def test_mass_is_zero_and_finite_without_load(key):
    rows = flight(1e-6, key=key, noise=0.1, ticks=3000)
    s = estimates(rows)
    assert float(s.z[-1, 7]) < 0.01
    pulls = jax.vmap(lambda z: Load.of(z).pull(jnp.zeros(3)))(s.z)
    assert float(jnp.abs(pulls[100:]).max()) < 0.3
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(s))
    eigenvalues = np.linalg.eigvalsh(np.asarray(s.P[-1]))
    assert eigenvalues.min() > -1e-9
    np.testing.assert_allclose(s.z[-1, 4:6], [0.3, -0.2], atol=0.15)


def test_release_and_pick_up_are_detected_within_a_second():
    s = estimates(flight(0.3, picked=4.0, dropped=8.0, ticks=600))
    share, t = np.asarray(s.z[:, 7]), DT * np.arange(1, 601)
    assert share[t < 4.0][-1] < 0.03
    assert share[(t > 5.0) & (t < 8.0)] == pytest.approx(0.3, abs=0.08)
    assert share[t > 9.0].max() < 0.06


def test_estimate_is_equivariant_to_heading(key):
    rows = flight(0.3, key=key, noise=0.1, ticks=100)
    turn = so3.rotz(jnp.array(0.8))
    about = lambda a: a @ turn.T  # noqa: E731
    turned = dataclasses.replace(
        rows,
        missed=about(rows.missed),
        before=about(rows.before),
        v=about(rows.v),
        thrust=about(rows.thrust),
    )
    one, other = estimates(rows), estimates(turned)
    np.testing.assert_allclose(directions(other), np.asarray(directions(one)) @ np.asarray(turn).T, atol=1e-7)
    np.testing.assert_allclose(other.z[:, 7:], one.z[:, 7:], atol=1e-7)


def test_model_equals_simulated_load_and_cable_force():
    rows = flight(0.3, ticks=20, push=(0.0, 0.0, 0.0), drag=0.0)
    q = np.asarray(rows.direction)
    rate = (q[9] - q[7]) / (2.0 * DT)
    load = Load(jnp.asarray(q[8, :2]), jnp.asarray(rate[:2]), *map(jnp.asarray, (np.zeros(3), 0.3, 0.5, 0.0, 0.0)))
    np.testing.assert_allclose(load.direction, q[8], atol=1e-12)
    np.testing.assert_allclose(load.rate, rate, atol=0.01)
    for k in range(9, 12):
        a = (rows.v[k] - rows.before[k]) / DT
        np.testing.assert_allclose(load.after(0.5 * DT, a).pull(a), rows.missed[k], atol=0.03)
        load = load.after(DT, a)
        np.testing.assert_allclose(load.direction, q[k], atol=0.002)


def test_step_is_second_order_and_free_swing_conserves_energy():
    load = Load(jnp.array([0.5, 0.1]), jnp.array([0.3, -1.0]), *map(jnp.asarray, (np.zeros(3), 0.3, 0.5, 0.0, 0.0)))
    still = jnp.zeros(3)

    def end(n):
        result = load
        for _ in range(n):
            result = result.after(0.4 / n, still)
        return np.concatenate([result.n, result.w])

    exact = end(256)
    errors = [np.abs(end(n) - exact).max() for n in (8, 16, 32)]
    assert errors[0] / errors[1] > 3.3
    assert errors[1] / errors[2] > 3.3
    energy = lambda l: 0.5 * 0.25 * l.rate @ l.rate + STANDARD_GRAVITY * 0.5 * l.direction[2]  # noqa: E731
    after = load
    for _ in range(200):
        after = after.after(0.002, still)
    assert float(energy(after)) == pytest.approx(float(energy(load)), abs=1e-4)


def test_cable_does_not_push_and_estimates_stay_bounded():
    down = Load(jnp.zeros(2), jnp.zeros(2), *map(jnp.asarray, (np.zeros(3), 0.3, 0.5, 0.0, 0.0)))
    np.testing.assert_allclose(down.pull(jnp.zeros(3)), 0.3 * G)
    np.testing.assert_array_equal(
        down.pull(jnp.array([0.0, 0.0, -15.0])), 0.0
    )  # the vehicle falls faster than the load
    wild = random.normal(random.key(2), (200, 3)) * 30.0
    s = LoadEstimate.start(wild.dtype)

    @jax.jit
    def tick(s, missed):
        s = s.predict(missed, DT).correct(missed, missed, missed, missed, jnp.array(0.0), jnp.array(True), DT)
        return s, s

    _, path = lax.scan(tick, s, wild)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(path))
    assert float(jnp.linalg.norm(path.z[:, :2], axis=1).max()) <= STEEPEST + 1e-6
    assert float(path.z[:, 7].min()) >= 0.0
    bad, _ = tick(s, jnp.array([jnp.nan, 0.0, 0.0]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(bad))


def test_missed_tick_changes_only_prediction():
    start = LoadEstimate.start(jnp.zeros(()).dtype)
    s = call(lambda s, a: s.predict(a, DT), start, jnp.array([1.0, 0.0, 0.0]))
    missed = jnp.array([5.0, 5.0, 5.0])
    after = call(lambda s, a: s.correct(a, a, a, a, jnp.array(0.0), jnp.array(False), DT), s, missed)
    np.testing.assert_allclose(after.z, s.z, atol=1e-12)
    np.testing.assert_allclose(after.P, s.P, atol=1e-12)
    assert float(after.surprise) == float(s.surprise)


def test_single_precision_suffices():
    with jax.enable_x64(False):
        rows = flight(0.3)
        s = estimates(rows)
        assert s.z.dtype == jnp.float32
        assert float(s.z[-1, 7]) == pytest.approx(0.3, abs=0.05)
        assert SlungLoad.of(0.3).share.dtype == jnp.float32
