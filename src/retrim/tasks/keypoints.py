"""Observation from a camera: pixels of seven keypoints on the ground in five frames, and the last three commands."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Bool, Float, Key

from ..estimation.camera import PATTERN, Camera, in_camera
from ..physics import so3
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import STANDARD_GRAVITY, Command, State
from .motions import NEAR, Motions
from .observation import POSITION_SCALE, VELOCITY_SCALE, AbstractObservation

Statistics = tuple[Float[Array, "70"], Float[Array, "70 70"]]
"""Mean and whitening matrix of the pixels."""
GOAL_HEIGHT = 1.0  # [m], from the goal to the ground
FRAMES, COMMANDS = 5, 3
FRAME_TIME = 0.06  # [s] between frames, as published
PIXEL_LIMIT = 2.5  # limit at which normalised pixel coordinates are clipped
FEATURE_LIMIT = 5.0  # whitened features are clipped at this many standard deviations


class KeypointMemory(NamedTuple):
    """Memory of the observation."""

    frames: Float[Array, "depth 14"]
    """Pixels at the last few ticks, newest last."""
    commands: Float[Array, "3 4"]
    key: Key[Array, ""]


class Keypoints(AbstractObservation[KeypointMemory]):
    """o = [whitened pixels of five frames, current visibility of the points, last three commands]: 89 numbers.

    Every point is observed wherever it is, as in the paper's code. :class:`retrim.tasks.OccludedKeypoints` uses only
    the points that a camera can see.

    ``noise`` is the standard deviation of a pixel coordinate [px]. It is drawn from a key that depends on the start, so
    roll-outs are repeatable.
    """

    camera: Camera
    goal: Float[Array, "3"]
    omega_max: Float[Array, "3"]
    noise: Float[Array, ""]
    mean: Float[Array, "70"]
    whiten: Float[Array, "70 70"]
    dt: float = eqx.field(static=True, default=0.02)

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the time between frames is not a whole number of ticks."""
        if abs(FRAME_TIME / self.dt - round(FRAME_TIME / self.dt)) > 1e-6:
            raise ValueError(f"Keypoints: dt = {self.dt} s must divide the frame time, {FRAME_TIME} s")

    @property
    def stride(self) -> int:
        """Number of ticks between two frames."""
        return round(FRAME_TIME / self.dt)

    @property
    def depth(self) -> int:
        """Number of ticks whose pixels are in the memory."""
        return (FRAMES - 1) * self.stride + 1

    @classmethod
    def of(
        cls,
        goal: Float[Array, "3"],
        omega_max: Float[Array, "3"],
        *,
        noise: float = 0.0,
        whitened: bool = True,
        dt: float = 0.02,
    ) -> "Keypoints":
        """Return the observation; by default, pixels are whitened with statistics of fixed random short motions."""
        plain = cls(Camera.published(), goal, omega_max, jnp.array(noise), jnp.zeros(70), jnp.eye(70), dt)
        if not whitened:
            return plain
        x, y, z = (float(value) for value in goal)
        statistics = _whitening_at((x, y, z), dt, jax.config.values["jax_enable_x64"])
        whitened_: Keypoints = eqx.tree_at(lambda o: (o.mean, o.whiten), plain, statistics)
        return whitened_

    @property
    def size(self) -> int:
        """Length of the observation: 89."""
        return 14 * FRAMES + 7 + 4 * COMMANDS

    def init(self, x: State) -> KeypointMemory:
        """Return the memory of a vehicle that has moved in a straight line, without turning, under hover commands.

        The memory is that of one tick ago, since the first call adds the frame for ``x``.
        """
        commands = jnp.zeros((COMMANDS, 4), dtype=x.p.dtype)
        before = State(x.p - self.dt * x.v, x.R, x.v)
        return KeypointMemory(self.history(before, jnp.zeros_like(x.p)), commands, random.split(key_of(x))[0])

    def history(self, x: State, omega: Float[Array, "3"]) -> Float[Array, "depth 14"]:
        """Return the frames of a motion with constant velocity and body rates that ends in ``x``, oldest first."""
        ago = self.dt * jnp.arange(self.depth - 1, -1, -1, dtype=x.p.dtype)

        def frame(s: Float[Array, ""]) -> Float[Array, "14"]:
            return self.pixels(State(x.p - s * x.v, x.R @ so3.exp(-s * omega), x.v))[0].reshape(14)

        return jax.vmap(frame)(ago)

    def at_rest(self, x: State) -> Float[Array, " o"]:
        """Return the observation at rest, without noise."""
        return AbstractObservation.at_rest(dataclasses.replace(self, noise=jnp.zeros_like(self.noise)), x)

    def in_frame(self, frame: EffectiveGravityFrame) -> "Keypoints":
        """Return the observation of a camera in ``frame``, in which the ground is level."""
        return dataclasses.replace(self, goal=frame.vector(self.goal))

    def stacked(self, frames: Float[Array, "depth 14"]) -> Float[Array, "70"]:
        """Return the five frames of the observation, newest first."""
        return frames[:: -self.stride].reshape(-1)

    def features(self, frames: Float[Array, "70"]) -> Float[Array, "70"]:
        """Return the whitened frames, clipped where they do not fit any motion, such as when points come into sight."""
        return jnp.clip(self.whiten @ (frames - self.mean), -FEATURE_LIMIT, FEATURE_LIMIT)

    def pixels(self, x: State) -> tuple[Float[Array, "7 2"], Bool[Array, " 7"]]:
        """Return the projections of the points, clipped far outside the image, and whether each is visible."""
        projections = jax.vmap(self.camera.project)(in_camera(x, self.ground()))
        return jnp.clip(projections.pixel, -PIXEL_LIMIT, PIXEL_LIMIT), projections.visible

    def ground(self) -> Float[Array, "7 3"]:
        """Return the keypoints on the ground in the world frame [m]."""
        flat = jnp.array(PATTERN, dtype=self.goal.dtype)
        return self.goal[None] + jnp.concatenate([flat, jnp.full((7, 1), -GOAL_HEIGHT, dtype=flat.dtype)], axis=1)

    @property
    def measures_state(self) -> bool:
        """False: only images are measured."""
        return False

    @property
    def has_frame_in_memory(self) -> bool:
        """True: all images in the memory belong to one frame."""
        return True

    def state_examples(
        self, motions: Motions
    ) -> Callable[[Key[Array, ""]], tuple[Float[Array, " o"], Float[Array, "15"]]]:
        """Return a function that draws an observation of a random motion, and the scaled state [p, R, v]."""

        def sample(key: Key[Array, ""]) -> tuple[Float[Array, " o"], Float[Array, "15"]]:
            x, omega = motions.draw(key, self.goal)
            features = self.features(self.stacked(self.history(x, omega)))
            _, visible = self.pixels(x)
            still = jnp.zeros(self.size - features.shape[0] - 7, dtype=x.p.dtype)
            state = jnp.concatenate([(x.p - self.goal) / POSITION_SCALE, x.R.reshape(9), x.v / VELOCITY_SCALE])
            return jnp.concatenate([features, visible.astype(x.p.dtype), still]), state

        return sample

    def image(self, x: State) -> tuple[Float[Array, "7 2"], Bool[Array, " 7"]]:
        """Return the pixels of the seven keypoints and their visibility."""
        return self.pixels(x)

    def __call__(
        self, memory: KeypointMemory, t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], KeypointMemory]:
        """Return the observation after one more frame."""
        key, k_noise, _ = random.split(memory.key, 3)  # three keys, for the same noise as OccludedKeypoints
        true, visible = self.pixels(x)
        pixels_with_noise = true + lax.stop_gradient(self.deviation(k_noise, true.dtype))
        frames = jnp.concatenate([memory.frames, pixels_with_noise.reshape(1, 14)])[1:]
        commands = jnp.concatenate([memory.commands, self.scaled(last)[None]])[1:]
        o = jnp.concatenate([self.features(self.stacked(frames)), visible.astype(true.dtype), commands.reshape(-1)])
        return o, KeypointMemory(frames, commands, key)

    def deviation(self, key: Key[Array, ""], dtype: Any) -> Float[Array, "7 2"]:
        """Return the noise of a frame, normalised; the key is consumed."""
        return (2.0 * self.noise / self.camera.size)[None] * random.normal(key, (7, 2), dtype)

    def command(self, scaled: Float[Array, "4"]) -> Command:
        """Return the command from its scaled numbers; the inverse of :meth:`scaled`."""
        return Command((scaled[0] + 1.0) * STANDARD_GRAVITY, scaled[1:] * self.omega_max)

    def scaled(self, u: Command) -> Float[Array, "4"]:
        """Return a command as numbers: thrust relative to hover, in units of g, and shares of the largest rates."""
        return jnp.concatenate([(u.c / STANDARD_GRAVITY - 1.0)[None], u.omega / self.omega_max])


def key_of(x: State) -> Key[Array, ""]:
    """Return the noise key for a flight that starts in ``x``."""
    return random.key(lax.bitcast_convert_type(jnp.sum(x.p + x.v).astype(jnp.float32), jnp.int32))


@functools.cache
def _whitening_at(goal: tuple[float, float, float], dt: float, x64: bool) -> Statistics:
    """Return the statistics of :func:`_whitening`, computed once per process, goal, tick and precision."""
    plain = Keypoints.of(jnp.array(goal, float), jnp.ones(3), whitened=False, dt=dt)
    result: Statistics = _whitening(plain)
    return result


@eqx.filter_jit
def _whitening(plain: Keypoints) -> Statistics:
    """Return the mean and whitening matrix of the frames of a fixed set of random short motions."""
    keys = random.split(random.key(0), 20000)
    frames = jax.vmap(lambda k: plain.stacked(plain.history(*NEAR.draw(k, plain.goal))))(keys)
    mean = jnp.mean(frames, axis=0)
    centred = frames - mean[None]
    # The symmetric matrix is unique, so a policy is the same on every machine; the floor is one pixel's variance.
    lam, V = jnp.linalg.eigh(centred.T @ centred / frames.shape[0])
    scale = (jnp.maximum(lam, 0.0) + 1e-5) ** -0.5
    return mean, (V * scale[None]) @ V.T
