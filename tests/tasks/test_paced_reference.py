"""A reference at the pace of a clock: the same path, with the derivatives of the new function of time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import call
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.tasks import Reference
from retrim.tasks.paced_reference import PACE_CHANGE_TIME, Clock, PacedReference, pace_references, set_clock
from retrim.tasks.shapes import figure8


def loop(t):
    return [np.sin(t), 0.5 * np.sin(2 * t), 1.0 + 0.2 * np.cos(t), 0.3 * np.sin(t)]


@pytest.fixture(scope="module")
def reference():
    return Reference.of(loop, seconds=2 * np.pi, lap=0.0, points=4096)


def clock(t=2.0, phase=1.0, pace=1.7, growth=0.4):
    return Clock(*(jnp.array(value) for value in (t, phase, pace, growth)))


@eqx.filter_jit
def points(reference, times):
    return jax.vmap(reference)(times)


def test_unit_pace_equals_reference(reference):
    times = np.linspace(0.0, 6.0, 50)
    same = points(PacedReference(reference, Clock.at_pace(jnp.ones(()))), times)
    for leaf, other in zip(same, points(reference, times), strict=True):
        np.testing.assert_allclose(leaf, other, atol=2e-3)


def test_derivatives_equal_finite_differences(reference):
    """Central differences of the position and of the heading, while the pace changes."""
    h, times = 1e-2, np.linspace(1.95, 2.3, 8)
    paced = PacedReference(reference, clock())
    here, before, after = (points(paced, times + k * h) for k in (0, -1, 1))
    np.testing.assert_allclose((after.p - before.p) / (2 * h), here.v, atol=2e-3)
    np.testing.assert_allclose((after.v - before.v) / (2 * h), here.a, atol=5e-3)
    np.testing.assert_allclose((after.a - before.a) / (2 * h), here.jerk, atol=2e-2)
    np.testing.assert_allclose((after.heading - before.heading) / (2 * h), here.heading_rate, atol=2e-3)
    thrust = np.linalg.norm(np.asarray(here.a) + np.array([0.0, 0.0, 9.81]), axis=1)
    np.testing.assert_allclose(here.u[:, 0], thrust, rtol=1e-4)


def test_phase_is_integral_of_pace():
    c, times = clock(growth=-1.5), np.linspace(2.0, 4.0, 2001)
    pace, phase = call(lambda c, t: (jax.vmap(c.pace_at)(t), jax.vmap(c.phase_at)(t)), c, times)
    assert float(pace.min()) > 0.0  # also for a clock without a successor
    np.testing.assert_allclose(phase, 1.0 + np.concatenate([[0.0], np.cumsum(pace[1:] + pace[:-1]) * 5e-4]), atol=1e-5)
    later = times > 2.0 + PACE_CHANGE_TIME
    np.testing.assert_allclose(pace[later], pace[-1])


def test_new_clock_continues_old_one(reference):
    """Position and velocity are continuous when the growth changes."""
    old, t = clock(), jnp.array(2.2)
    new = Clock(t, old.phase_at(t), old.pace_at(t), jnp.array(-2.0))
    before, after = (call(PacedReference(reference, each), t) for each in (old, new))
    np.testing.assert_allclose(before.p, after.p, atol=1e-12)
    np.testing.assert_allclose(before.v, after.v, atol=1e-12)


def test_laps_and_joins_are_flight_times(reference):
    paced = PacedReference(reference, clock(growth=0.0))
    np.testing.assert_allclose(paced.lap[1] - paced.lap[0], 2 * np.pi / 1.7)
    np.testing.assert_allclose(call(paced, paced.lap[1]).p, call(reference, reference.lap[1]).p, atol=1e-6)
    assert paced.joins.shape == reference.joins.shape


def test_frames_and_paces_commute(reference):
    """A rotated paced reference has the rotated position at the same times, with the derivatives of the path."""
    frame = EffectiveGravityFrame.of(jnp.array([1.0, -2.0, 0.5]))
    paced = PacedReference(reference, clock())
    t, h = jnp.array(2.1), 1e-2
    framed = paced.in_frame(frame)
    here = call(framed, t)
    np.testing.assert_allclose(here.p, frame.vector(call(paced, t).p), atol=1e-12)
    change = (call(framed, t + h).p - call(framed, t - h).p) / (2 * h)
    np.testing.assert_allclose(change, here.v, atol=2e-3)
    assert float(framed.distance(here.p)) < 1e-3


def test_clocks_of_tree_are_set_together():
    tree = {"a": figure8(), "b": [figure8().in_frame(EffectiveGravityFrame.of(jnp.zeros(3)))], "c": jnp.ones(3)}
    paced = set_clock(pace_references(tree, Clock.at_pace(jnp.ones(()))), clock())
    assert float(paced["a"].clock.pace) == float(paced["b"][0].reference.clock.pace) == 1.7
    assert jax.tree.structure(set_clock(paced, clock(pace=1.0))) == jax.tree.structure(paced)
