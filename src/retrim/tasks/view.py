"""Hover that keeps its keypoints in sight: what is out of the image must be flown from memory."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.camera import in_camera
from ..physics.state import Command, State
from .hover import L2Hover
from .keypoints import Keypoints

EDGE = 0.9  # of half an image: a point is kept within
FARTHEST = 4.0  # of half an image: from here on a point is no farther out
WEIGHT = 10.0  # of a point half an image outside, beside a weight of 8 for a metre from the goal


class ViewHover(L2Hover):
    """Hover with a reward for keeping keypoints in the image; its observation is :class:`Keypoints`."""

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward of :class:`L2Hover` - 10 times how far points are outside the image, on average."""
        seen: Keypoints = self.observation  # type: ignore[assignment]  # a field of the base class
        pixels = jax.vmap(seen.camera.project)(in_camera(x, seen.ground())).pixel
        outside = jax.nn.relu(jnp.abs(jnp.clip(pixels, -FARTHEST, FARTHEST)) - EDGE)
        return super().reward(t, x, u) - WEIGHT * jnp.mean(jnp.sum(outside, axis=1))
