"""Compute the hat map, exponential and logarithm of SO(3), with finite gradients at zero rotation.

A rotation ``R`` maps body to world coordinates. The direction of a rotation vector is the axis; its length
is the angle [rad].
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

_SMALL = 1e-6  # [rad^2]; below this value, the Taylor series is exact to rounding, even in float32


def hat(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the skew-symmetric matrix ``[w]x``, so that ``hat(w) @ y == cross(w, y)``."""
    x, y, z = w
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def vee(W: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the inverse of :func:`hat`, applied to the skew-symmetric part of a matrix."""
    return 0.5 * jnp.stack([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])


def exp(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the rotation by the rotation vector ``w`` [rad] (Rodrigues' formula)."""
    square = jnp.sum(w * w)
    small = square < _SMALL
    safe = jnp.where(small, jnp.ones_like(square), square)  # double where: no square root near zero, in either branch
    angle = jnp.sqrt(safe)
    a = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    b = jnp.where(small, 0.5 - square / 24.0, (1.0 - jnp.cos(angle)) / safe)
    cos = 1.0 - b * square
    return cos * jnp.eye(3, dtype=w.dtype) + a * hat(w) + b * jnp.outer(w, w)  # [w]x^2 = w w^T - |w|^2 I


def mul(A: Float[Array, "3 3"], B: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return ``A @ B`` by sums of products.

    Under ``vmap`` on a CPU, this is several times faster than a batched product.
    """
    return jnp.sum(A[:, :, None] * B[None, :, :], axis=1)


def act(A: Float[Array, "3 3"], y: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return ``A @ y`` by sums of products, as in :func:`mul`."""
    return jnp.sum(A * y[None, :], axis=1)


def log(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the rotation vector [rad] of ``R``, with a length below pi: the inverse of :func:`exp`.

    The direction is ill-conditioned within about 1e-3 rad of a half turn.
    """
    axis_sin = vee(R)  # axis * sin(angle)
    square = jnp.sum(axis_sin * axis_sin)
    cos = 0.5 * (jnp.trace(R) - 1.0)
    small = (square < _SMALL) & (cos > 0.0)
    sin = jnp.sqrt(jnp.where(small, jnp.ones_like(square), jnp.maximum(square, 1e-30)))
    near_zero = 1.0 + square / 6.0  # angle / sin(angle), as a series in sin(angle)
    return jnp.where(small, near_zero, jnp.arctan2(sin, cos) / sin) * axis_sin


def rotx(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation about the x axis by ``angle`` [rad]."""
    return exp(jnp.stack([angle, jnp.zeros_like(angle), jnp.zeros_like(angle)]))


def roty(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation about the y axis by ``angle`` [rad]."""
    return exp(jnp.stack([jnp.zeros_like(angle), angle, jnp.zeros_like(angle)]))


def rotz(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation about the z axis by ``angle`` [rad]."""
    return exp(jnp.stack([jnp.zeros_like(angle), jnp.zeros_like(angle), angle]))
