"""Model a wide-angle camera that looks straight down, with the double-sphere model (Usenko et al. 2018)."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..physics.state import State

DOWN = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
"""Body to camera: the camera's z looks along body -z; camera x is body -y, camera y is body -x."""
PATTERN = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5), (-0.5, 0.0), (0.0, 0.5), (0.5, 0.0))
"""Keypoints on the ground [m]: the corners of a square and three mid-points of its sides."""
D_MIN = 0.05  # smallest denominator of the projection, for points far off the axis or behind the camera


class Projection(NamedTuple):
    """A point in the image."""

    pixel: Float[Array, "2"]
    """Normalised coordinates; the image is [-1, 1] x [-1, 1]."""
    visible: Bool[Array, ""]
    """True if the point is in front of the camera, where the model holds, and inside the image."""


class Camera(eqx.Module):
    """Intrinsic parameters of a camera."""

    xi: Float[Array, ""]
    alpha: Float[Array, ""]
    focal: Float[Array, "2"]
    """Focal lengths [px]."""
    centre: Float[Array, "2"]
    """Principal point [px]."""
    size: Float[Array, "2"]
    """Image size [px]."""

    @classmethod
    def published(cls) -> "Camera":
        """Return the camera that the paper's authors describe: 1280 x 720 px, about 120 degrees across."""
        return cls(
            xi=jnp.array(-0.007441148905788614),
            alpha=jnp.array(0.6138265280850498),
            focal=jnp.array([599.87676296874, 449.2911037186814]),
            centre=jnp.array([632.1317557077697, 388.2472267118482]),
            size=jnp.array([1280.0, 720.0]),
        )

    def project(self, P: Float[Array, "3"]) -> Projection:
        """Project a point in camera coordinates [m]; the result and its gradient are finite for every point."""
        d1 = jnp.sqrt(jnp.sum(P**2) + 1e-12)
        z1 = self.xi * d1 + P[2]
        d2 = jnp.sqrt(P[0] ** 2 + P[1] ** 2 + z1**2 + 1e-12)
        D = self.alpha * d2 + (1.0 - self.alpha) * z1
        pixel = 2.0 * (self.focal * P[:2] / jnp.maximum(D, D_MIN * d1) + self.centre) / self.size - 1.0
        w1 = jnp.where(self.alpha <= 0.5, self.alpha / (1.0 - self.alpha), (1.0 - self.alpha) / self.alpha)
        w2 = (w1 + self.xi) / jnp.sqrt(2.0 * w1 * self.xi + self.xi**2 + 1.0)
        holds = (P[2] > -w2 * d1) & (P[2] > 0.0) & (D_MIN * d1 < D)
        return Projection(pixel, holds & jnp.all(jnp.abs(pixel) <= 1.0))


def in_camera(x: State, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Map world points [m] to the coordinates of a camera at the body's origin."""
    down = jnp.array(DOWN, dtype=x.p.dtype)
    return (points - x.p[None]) @ x.R @ down.T
