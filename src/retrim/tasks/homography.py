"""Points of a plane seen by a camera: from those that are visible to those that are not.

A point (X, Y) of the ground, relative to the point below the goal, lies in the direction of H [X, Y, 1]. The
estimate is recursive: what the visible points leave open stays as it was, turned by the rotation that was commanded.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..physics import so3
from ..physics.state import State
from .camera import DOWN, Camera

PATTERN = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5), (-0.5, 0.0), (0.0, 0.5), (0.5, 0.0))
"""The points, relative to the one below the goal [m]: a square's corners and three mid-points of its sides."""
MEMORY = 1e-4  # weight of the last estimate against one visible point


def pattern_homography(x: State, goal: Float[Array, "3"], below: float) -> Float[Array, "3 3"]:
    """The true one, in the state ``x``; scaled to norm one."""
    down = jnp.array(DOWN, dtype=x.p.dtype)
    to_camera = down @ x.R.T
    origin = goal - jnp.array([0.0, 0.0, below], dtype=goal.dtype) - x.p
    H = jnp.stack([to_camera[:, 0], to_camera[:, 1], to_camera @ origin], axis=1)
    return H / jnp.sqrt(jnp.sum(H**2))


def rotated(H: Float[Array, "3 3"], turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """``H`` after the body has turned by ``turn`` [rad], its own axes."""
    down = jnp.array(DOWN, dtype=H.dtype)
    return down @ so3.exp(-turn) @ down.T @ H


def completed(
    camera: Camera, H: Float[Array, "3 3"], pixels: Float[Array, "7 2"], visible: Bool[Array, " 7"]
) -> tuple[Float[Array, "3 3"], Float[Array, "7 2"]]:
    """The estimate after a frame, and where it says that all points appear.

    Each visible point says b x (H X) = 0 for its direction b: linear in the nine numbers of H.
    """
    flat = jnp.array(PATTERN, dtype=H.dtype)
    X = jnp.concatenate([flat, jnp.ones((7, 1), dtype=H.dtype)], axis=1)
    b = jax.vmap(camera.bearing)(jnp.clip(pixels, -1.0, 1.0))
    weight = visible.astype(H.dtype)
    cross = jax.vmap(so3.hat)(b)  # b x y = hat(b) y
    A = (cross[:, :, :, None] * X[:, None, None, :]).reshape(21, 9) * jnp.repeat(weight, 3)[:, None]
    normal = A.T @ A + MEMORY * jnp.eye(9, dtype=H.dtype)
    h = jnp.linalg.solve(normal, MEMORY * H.reshape(9)).reshape(3, 3)
    # a step of inverse iteration: it shrinks what contradicts the points, and not what they leave open
    h = h / jnp.maximum(jnp.sqrt(jnp.sum(h**2)), 1e-12)
    return h, jax.vmap(lambda x: camera.project(h @ x).pixel)(X)
