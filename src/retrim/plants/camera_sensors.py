"""Sensors: a camera above keypoints on the ground, an inertial unit, and the filter that estimates the state from both.

The filter needs neither commands nor the vehicle's parameters, so every policy and controller that needs a state can
fly from keypoints, also with unknown vehicles.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Float, Key

from ..errors import PlantError
from ..estimation.camera import PATTERN, Camera, in_camera
from ..estimation.pose_filter import PoseFilter, assumed_noise
from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, State
from .sensors import AbstractSensors

# Errors of the mean rates [rad/s] and of the mean force [m/s^2] of a tick, beyond the noise of the inertial unit.
RATE_ERROR, FORCE_ERROR = 0.1, 0.3


class CameraMemory(eqx.Module):
    """Memory of the camera sensors."""

    pose: PoseFilter
    omega: Float[Array, "3"]
    """Measured body rates at the end of the tick [rad/s]."""
    a: Float[Array, "3"]
    """Measured mean acceleration in the tick, turned to the world frame by the estimated attitude [m/s^2]."""


class CameraSensors(AbstractSensors[CameraMemory]):
    """One camera frame and one measurement of the inertial unit per tick."""

    camera: Camera
    ground: Float[Array, "points 3"]
    """Keypoints, world [m]."""
    pixel_noise: Float[Array, ""]
    """Standard deviation of a pixel coordinate [px]."""
    dropout: Float[Array, ""]
    """Probability that a point inside the image is missed."""
    gyro: Float[Array, ""]
    """Standard deviation of the body rates per axis [rad/s]."""
    accelerometer: Float[Array, ""]
    """Standard deviation of the specific force per axis [m/s^2]."""

    @classmethod
    def of(
        cls, *, pixel_noise: float = 1.0, dropout: float = 0.05, gyro: float = 0.02, accelerometer: float = 0.2
    ) -> "CameraSensors":
        """Build sensors with the published camera above the pattern of seven points around the origin.

        Args:
            pixel_noise: Standard deviation of a pixel coordinate [px].
            dropout: Probability that a point inside the image is missed.
            gyro: Standard deviation of the body rates per axis [rad/s].
            accelerometer: Standard deviation of the specific force per axis [m/s^2].

        Raises:
            ValueError: A deviation is negative, or the probability is not in [0, 1).
        """
        for name, value in {"pixel_noise": pixel_noise, "gyro": gyro, "accelerometer": accelerometer}.items():
            if not value >= 0.0:
                raise ValueError(f"CameraSensors.{name} must not be negative, got {value}")
        if not 0.0 <= dropout < 1.0:
            raise ValueError(f"CameraSensors.dropout must be in [0, 1), got {dropout}")
        ground = jnp.array([(x, y, 0.0) for x, y in PATTERN])
        return cls(Camera.published(), ground, *map(jnp.array, (pixel_noise, dropout, gyro, accelerometer)))

    @property
    def period(self) -> int:
        """Time between the true states that the sensors receive: 1 ms. The last one of a tick defines the frame."""
        return 1

    def init(self, x: State, key: Key[Array, ""]) -> CameraMemory:
        """Return a filter that begins within about 10 cm, 3 degrees and 0.2 m/s of ``x``, after its first frame."""
        k_pose, k_frame = random.split(key)
        zero = jnp.zeros_like(x.p)
        return CameraMemory(self._correct(PoseFilter.near(x, k_pose), x, k_frame), zero, zero)

    def sample(
        self,
        memory: CameraMemory,
        xs: State,
        omega: Float[Array, "3"] | None,
        a: Float[Array, "3"],
        dt: float,
        key: Key[Array, ""],
    ) -> CameraMemory:
        """Return the memory after a tick: predict by the inertial unit, and correct by the frame at its end.

        Raises:
            PlantError: The plant has no body rates.
        """
        if omega is None:
            raise PlantError("CameraSensors need an inertial unit, and this plant has no body rates")
        x: State = jax.tree.map(lambda leaf: leaf[-1], xs)
        dtype, gravity = a.dtype, jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=a.dtype)
        k_gyro, k_accelerometer, k_frame = random.split(key, 3)
        rates = omega + self.gyro.astype(dtype) * random.normal(k_gyro, (3,), dtype)
        deviation = self.accelerometer.astype(dtype) * random.normal(k_accelerometer, (3,), dtype)
        force = so3.act(x.R.T, a - gravity) + deviation
        noise = jnp.hypot(self.gyro, RATE_ERROR), jnp.hypot(self.accelerometer, FORCE_ERROR)
        prior = memory.pose.predict_by_unit(0.5 * (memory.omega + rates), force, dt, noise)
        pose = self._correct(prior, x, k_frame)
        return CameraMemory(pose, rates, so3.act(pose.x.R, force) + gravity)

    def state(self, memory: CameraMemory) -> State:
        """Return the state that the filter estimates."""
        return memory.pose.x

    def inertial(
        self, memory: CameraMemory, omega: Float[Array, "3"], a: Float[Array, "3"], key: Key[Array, ""]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Return the measured body rates, and the acceleration by the estimated attitude."""
        del omega, a, key
        return memory.omega, memory.a

    def _correct(self, prior: PoseFilter, x: State, key: Key[Array, ""]) -> PoseFilter:
        """Return the filter after a frame of a vehicle in the true state ``x``; the key is consumed."""
        camera, dtype = self.camera, x.p.dtype
        ground = self.ground.astype(dtype)
        k_noise, k_dropout = random.split(key)
        points: Any = jax.vmap(camera.project)(in_camera(x, ground))
        off = (2.0 * self.pixel_noise / camera.size).astype(dtype)
        pixels = points.pixel + off[None] * random.normal(k_noise, points.pixel.shape, dtype)
        is_visible = points.visible & (random.uniform(k_dropout, points.visible.shape, dtype) >= self.dropout)
        sharpness = assumed_noise(camera, self.pixel_noise).astype(dtype)
        return prior.correct(camera, ground, pixels, is_visible, sharpness)
