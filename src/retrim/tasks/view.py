"""Hover that keeps the keypoints in sight, since points outside the image can be used only from memory."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.camera import in_camera
from ..physics.state import Command, State
from .hover import L2Hover
from .keypoints import Keypoints

EDGE = 0.9  # share of half an image within which points are kept
LARGEST_DISTANCE = 4.0  # multiple of half an image at which a point's distance is clipped
WEIGHT = 10.0  # weight of a point half an image outside, compared with 8 for a metre from the goal


class ViewHover(L2Hover):
    """Hover with a reward for keeping keypoints in the image; its observation is :class:`Keypoints`."""

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward of :class:`L2Hover` minus 10 times the mean distance by which points leave the image."""
        observation: Keypoints = self.observation  # type: ignore[assignment]  # a field of the base class
        pixels = jax.vmap(observation.camera.project)(in_camera(x, observation.ground())).pixel
        outside = jax.nn.relu(jnp.abs(jnp.clip(pixels, -LARGEST_DISTANCE, LARGEST_DISTANCE)) - EDGE)
        return super().reward(t, x, u) - WEIGHT * jnp.mean(jnp.sum(outside, axis=1))
