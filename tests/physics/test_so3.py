"""Axioms of SO(3), including near the identity, and gradients at singular points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retrim.physics import so3

exp, log, mul = jax.jit(so3.exp), jax.jit(so3.log), jax.jit(so3.mul)
SCALES = [1.0, 1e-2, 1e-4, 1e-7, 0.0]
vectors = st.tuples(*[st.floats(-1.7, 1.7)] * 3).map(np.array)  # shorter than pi


@pytest.mark.parametrize("scale", SCALES)
@settings(max_examples=20, deadline=None)
@given(w=vectors)
def test_exp_is_a_rotation(scale, w):
    R = np.asarray(exp(scale * w))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)


@pytest.mark.parametrize("scale", SCALES)
@settings(max_examples=20, deadline=None)
@given(w=vectors)
def test_log_inverts_exp(scale, w):
    w = scale * w
    np.testing.assert_allclose(log(exp(w)), w, rtol=1e-8, atol=1e-15)


@settings(max_examples=20, deadline=None)
@given(w=vectors, a=st.floats(-1, 1), b=st.floats(-1, 1))
def test_one_parameter_subgroup(w, a, b):
    np.testing.assert_allclose(mul(exp(a * w), exp(b * w)), exp((a + b) * w), atol=1e-14)
    np.testing.assert_allclose(exp(-w), np.asarray(exp(w)).T, atol=1e-15)


@settings(max_examples=20, deadline=None)
@given(w=vectors, v=vectors, y=vectors)
def test_adjoint_and_products(w, v, y):
    w, v, y = (jnp.asarray(u) for u in (w, v, y))
    R = so3.exp(w)
    np.testing.assert_allclose(so3.mul(so3.mul(R, so3.exp(v)), R.T), so3.exp(so3.act(R, v)), atol=1e-13)
    np.testing.assert_allclose(so3.hat(w) @ y, jnp.cross(w, y), atol=1e-14)
    np.testing.assert_allclose(so3.vee(so3.hat(w)), w, atol=1e-15)
    np.testing.assert_allclose(so3.act(R, y), R @ y, atol=1e-14)


def test_exp_equals_matrix_exponential():
    w = jnp.array([0.4, -1.1, 0.7])
    np.testing.assert_allclose(so3.exp(w), jax.scipy.linalg.expm(so3.hat(w)), atol=1e-14)


@pytest.mark.parametrize("scale", SCALES)
def test_derivative_at_and_near_zero(scale):
    w = scale * np.array([0.3, -0.5, 0.2])
    J, step = np.asarray(slope(w)), 1e-6
    assert np.isfinite(J).all()
    for i, e in enumerate(step * np.eye(3)):
        np.testing.assert_allclose(J[:, :, i], (exp(w + e) - exp(w - e)) / (2 * step), atol=1e-9)
    assert np.isfinite(slope_there_and_back(w)).all()


slope = jax.jit(jax.jacobian(so3.exp))
slope_there_and_back = jax.jit(jax.jacobian(lambda w: so3.log(so3.exp(w))))


def test_second_derivative_is_finite_at_zero():
    assert np.isfinite(jax.jit(jax.hessian(lambda w: so3.exp(w)[0, 1]))(jnp.zeros(3))).all()


def test_elementary_rotations():
    q = jnp.array(jnp.pi / 2)
    np.testing.assert_allclose(so3.act(so3.rotz(q), jnp.array([1.0, 0, 0])), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(so3.act(so3.rotx(q), jnp.array([0, 1.0, 0])), [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(so3.act(so3.roty(q), jnp.array([0, 0, 1.0])), [1, 0, 0], atol=1e-15)
