"""A shifted reference: the sum of a path and a Fourier series, with the derivatives of the sum."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import at, call
from retrim.tasks import Reference
from retrim.tasks.paced_reference import Clock, PacedReference, pace_references
from retrim.tasks.shapes import figure8
from retrim.tasks.shifted_reference import HARMONICS, ShiftedReference, basis, set_shift, shift_references

SHIFT = 0.02 * jnp.asarray(np.random.default_rng(0).normal(size=(3, 1 + 2 * HARMONICS)))


@pytest.fixture(scope="module")
def reference():
    return figure8()


def test_zero_shift_equals_reference(reference):
    times = np.linspace(0.0, 12.0, 60)
    shifted, plain = at(ShiftedReference.of(reference), times), at(reference, times)
    for leaf, other in zip(shifted, plain, strict=True):
        np.testing.assert_allclose(leaf, other, atol=1e-2)  # the command of a row is interpolated
    np.testing.assert_allclose(shifted.p, plain.p, atol=1e-12)


def test_functions_are_periodic_with_correct_derivatives(reference):
    t, h, lap = 4.3, 1e-4, np.asarray(reference.lap)
    times = np.array([t, t - h, t + h, t + lap[1] - lap[0]])
    orders = [jax.jit(jax.vmap(partial(basis, reference.lap, order=k)))(times) for k in range(4)]
    for (here, before, after, later), (expected, *_) in itertools.pairwise(np.asarray(orders)):
        np.testing.assert_allclose((after - before) / (2 * h), expected, rtol=1e-4, atol=1e-2)
        np.testing.assert_allclose(later, here, rtol=1e-6, atol=1e-6)


def test_velocity_and_command_belong_to_shifted_path(reference):
    shifted, h = set_shift({"a": ShiftedReference.of(reference)}, SHIFT)["a"], 1e-4
    for t in (4.0, 5.7):
        here, before, after = (call(shifted, jnp.array(t + k * h)) for k in (0, -1, 1))
        np.testing.assert_allclose((after.p - before.p) / (2 * h), here.v, atol=5e-2)
        thrust = np.linalg.norm(np.asarray(here.a) + np.array([0.0, 0.0, 9.81]))
        np.testing.assert_allclose(here.u[0], thrust, rtol=1e-9)


def test_path_without_laps_is_not_shifted():
    once = Reference.of(lambda t: [np.sin(t), 0.0, 1.0], seconds=3.0)
    shifted = set_shift(ShiftedReference.of(once), SHIFT)
    np.testing.assert_array_equal(call(shifted, jnp.array(1.0)).p, call(once, jnp.array(1.0)).p)


def test_pace_applies_to_shifted_path(reference):
    """The shift is a function of the phase, so its position is constant when the pace changes."""
    clock = Clock(jnp.array(0.0), jnp.array(4.0), jnp.array(2.0), jnp.array(0.0))
    tree = set_shift(pace_references(shift_references([reference]), clock), SHIFT)
    assert isinstance(tree[0], PacedReference)
    shifted = set_shift(ShiftedReference.of(reference), SHIFT)
    np.testing.assert_allclose(call(tree[0], jnp.array(0.3)).p, call(shifted, jnp.array(4.6)).p, atol=1e-12)
