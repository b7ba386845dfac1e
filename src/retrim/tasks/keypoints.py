"""Observation from a camera: pixels of seven keypoints on the ground in five frames, and the last commands."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Bool, Float, Key

from ..estimation.camera import Camera, in_camera
from ..estimation.pose_filter import PoseFilter
from ..physics import so3
from ..physics.felt_frame import FeltFrame
from ..physics.state import STANDARD_GRAVITY, Command, State
from .observation import AbstractObservation

PATTERN = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5), (-0.5, 0.0), (0.0, 0.5), (0.5, 0.0))
"""The points, relative to the one below the goal [m]: a square's corners and three mid-points of its sides."""
BELOW = 1.0  # [m], from the goal to the ground
FRAMES, COMMANDS = 5, 3
FRAME_TIME = 0.06  # [s] between frames, as published
FAR = 2.5  # pixels (normalised) farther than this from where they are at the goal are cut off there
FEATURE_LIMIT = 5.0  # whitened features are clipped at this many standard deviations


class KeypointMemory(NamedTuple):
    """Memory of the observation."""

    frames: Float[Array, "depth 14"]
    """Newest last."""
    commands: Float[Array, "3 4"]
    pose: PoseFilter
    """Estimated pose, to predict occluded keypoints."""
    poses: State
    """Estimated poses of the frames."""
    key: Key[Array, ""]


class Keypoints(AbstractObservation[KeypointMemory]):
    """o = [whitened pixels of five frames, which points are visible now, the last three commands]: 89 numbers.

    Without ``occlusion`` every point is observed, wherever it is, as in the paper's code. With it, a point outside the
    image is not observed; it is predicted by :class:`retrim.estimation.PoseFilter` from visible points and commands.

    ``noise`` is the standard deviation of a pixel coordinate [px]. It is drawn from a key that follows from the start,
    so that roll-outs repeat.
    """

    camera: Camera
    goal: Float[Array, "3"]
    omega_max: Float[Array, "3"]
    noise: Float[Array, ""]
    dropout: Float[Array, ""]
    """Probability that a visible point is missed in a frame."""
    mean: Float[Array, "70"]
    whiten: Float[Array, "70 70"]
    occlusion: bool = eqx.field(static=True, default=True)
    dt: float = eqx.field(static=True, default=0.02)
    delay_ticks: int = eqx.field(static=True, default=0)
    """Declared command delay of the plant [ticks]: the filter predicts under the command that acted."""
    frame: FeltFrame | None = None
    """With occlusion: what is observed is what a camera would show in this frame; ``goal`` stays in the world."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if frames are no whole number of ticks apart, or the delay outlasts the memory."""
        if abs(FRAME_TIME / self.dt - round(FRAME_TIME / self.dt)) > 1e-6:
            raise ValueError(f"Keypoints: dt = {self.dt} s must divide the frame time, {FRAME_TIME} s")
        if not 0 <= self.delay_ticks <= COMMANDS:
            raise ValueError(f"Keypoints: delay_ticks = {self.delay_ticks} must be 0 to {COMMANDS}")

    @property
    def stride(self) -> int:
        """Ticks between two frames."""
        return round(FRAME_TIME / self.dt)

    @property
    def depth(self) -> int:
        """Ticks of pixels that are remembered."""
        return (FRAMES - 1) * self.stride + 1

    @classmethod
    def of(
        cls,
        goal: Float[Array, "3"],
        omega_max: Float[Array, "3"],
        *,
        occlusion: bool = True,
        noise: float = 0.0,
        dropout: float = 0.0,
        whitened: bool = True,
        dt: float = 0.02,
        delay_ticks: int = 0,
    ) -> "Keypoints":
        """Build the observation, by default with pixels whitened over random short motions (always the same ones)."""
        plain = cls(
            Camera.published(), goal, omega_max, jnp.array(noise), jnp.array(dropout),
            jnp.zeros(70), jnp.eye(70), occlusion, dt, delay_ticks,
        )  # fmt: skip
        if not whitened:
            return plain
        key = random.key(0)
        frames = jax.vmap(lambda k: plain.stacked(plain.history(*random_motion(k, goal))))(random.split(key, 20000))
        mean = jnp.mean(frames, axis=0)
        centred = frames - mean[None]
        # symmetric: unique, so that a policy means the same on every machine; the floor is one pixel's variance
        lam, V = jnp.linalg.eigh(centred.T @ centred / frames.shape[0])
        scale = (jnp.maximum(lam, 0.0) + 1e-5) ** -0.5
        whitened_: Keypoints = eqx.tree_at(lambda o: (o.mean, o.whiten), plain, (mean, (V * scale[None]) @ V.T))
        return whitened_

    @property
    def size(self) -> int:
        """Length of the observation: 89."""
        return 14 * FRAMES + 7 + 4 * COMMANDS

    def occluded(self, dropout: float) -> "Keypoints":
        """Return the same observation with occlusion, where visible points are missed with probability ``dropout``."""
        return dataclasses.replace(self, occlusion=True, dropout=jnp.array(dropout))

    def init(self, x: State) -> KeypointMemory:
        """Return the memory of a vehicle that came in a straight line, without turning, under hover commands."""
        frames = self.history(x, jnp.zeros_like(x.p))
        bits = lax.bitcast_convert_type(jnp.sum(x.p + x.v).astype(jnp.float32), jnp.int32)
        commands = jnp.zeros((COMMANDS, 4), dtype=x.p.dtype)
        key, k_pose = random.split(random.key(bits))
        return KeypointMemory(frames, commands, PoseFilter.near(x, k_pose), self._past(x), key)

    def history(self, x: State, omega: Float[Array, "3"]) -> Float[Array, "depth 14"]:
        """Return the frames of a motion with constant velocity and body rates that ends in ``x``, oldest first."""
        ago = self.dt * jnp.arange(self.depth - 1, -1, -1, dtype=x.p.dtype)

        def frame(s: Float[Array, ""]) -> Float[Array, "14"]:
            return self.pixels(State(x.p - s * x.v, x.R @ so3.exp(-s * omega), x.v))[0].reshape(14)

        return jax.vmap(frame)(ago)

    def _past(self, x: State) -> State:
        """Return the poses of a motion with constant velocity that ends in ``x``, oldest first; the last one only if
        nothing is occluded, for none is needed then."""
        ago = self.dt * jnp.arange(self.depth - 1 if self.occlusion else 0, -1, -1, dtype=x.p.dtype)
        return jax.vmap(lambda s: State(x.p - s * x.v, x.R, x.v))(ago)

    def in_frame(self, frame: FeltFrame) -> "Keypoints":
        """Return what a camera would show in ``frame``, in which the ground is level.

        Where points are occluded, the picture is moved by what an estimated pose says of it; else by the true one.
        """
        if self.occlusion:
            return dataclasses.replace(self, frame=frame)
        return dataclasses.replace(self, goal=frame.vector(self.goal))

    def _moved_to(self, frame: FeltFrame, frames: Float[Array, "depth 14"], poses: State) -> Float[Array, "depth 14"]:
        """Return frames of the world as they would be in ``frame``; those that are not observed stay."""
        inside = dataclasses.replace(self, goal=frame.vector(self.goal), frame=None)

        def move(pixels: Float[Array, "14"], x: State) -> Float[Array, "14"]:
            by = inside.pixels(frame.state(x))[0] - self.pixels(x)[0]
            return jnp.clip(pixels + by.reshape(14), -FAR, FAR)

        at = jnp.arange(self.depth - 1, -1, -self.stride)
        moved = jax.vmap(move)(frames[at], jax.tree.map(lambda leaf: leaf[at], poses))
        return frames.at[at].set(moved)

    def stacked(self, frames: Float[Array, "depth 14"]) -> Float[Array, "70"]:
        """Return the five frames of the observation, newest first."""
        return frames[:: -self.stride].reshape(-1)

    def features(self, frames: Float[Array, "depth 14"]) -> Float[Array, "70"]:
        """Return whitened frames, clipped where they fit no motion, as when points come into sight."""
        return jnp.clip(self.whiten @ (self.stacked(frames) - self.mean), -FEATURE_LIMIT, FEATURE_LIMIT)

    def pixels(self, x: State) -> tuple[Float[Array, "7 2"], Bool[Array, " 7"]]:
        """Return the projections of the points, clipped far outside the image, and which are visible."""
        seen = jax.vmap(self.camera.project)(in_camera(x, self.ground()))
        return jnp.clip(seen.pixel, -FAR, FAR), seen.visible

    def ground(self) -> Float[Array, "7 3"]:
        """Return the points, world [m]."""
        flat = jnp.array(PATTERN, dtype=self.goal.dtype)
        return self.goal[None] + jnp.concatenate([flat, jnp.full((7, 1), -BELOW, dtype=flat.dtype)], axis=1)

    def __call__(
        self, memory: KeypointMemory, t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], KeypointMemory]:
        """Return the observation after one more frame."""
        key, k_noise, k_drop = random.split(memory.key, 3)
        frame, issued = self.frame, last
        if frame is not None:  # the camera is in the world
            x, issued = frame.world_state(x), frame.world_command(last)
        true, visible = self.pixels(x)
        noise = (2.0 * self.noise / self.camera.size)[None] * random.normal(k_noise, (7, 2), true.dtype)
        shown = true + lax.stop_gradient(noise)
        pose, poses = memory.pose, memory.poses
        if self.occlusion:
            visible = visible & (random.uniform(k_drop, (7,), true.dtype) >= self.dropout)
            sharpness = 2.0 * jnp.maximum(self.noise, 0.5) / self.camera.size
            acted = issued
            if self.delay_ticks > 0:
                acted = self._command(memory.commands[-self.delay_ticks])
                acted = acted if frame is None else frame.world_command(acted)
            pose = lax.stop_gradient(memory.pose).predicted(lax.stop_gradient(acted), self.dt)
            pose = pose.corrected(self.camera, self.ground(), lax.stop_gradient(shown), visible, sharpness)
            pose = lax.stop_gradient(pose)
            filled, _ = self.pixels(pose.x)
            # The value is the predicted pixel, the gradient that of the true one.
            shown = jnp.where(visible[:, None], shown, true + lax.stop_gradient(filled - true))
            poses = jax.tree.map(lambda old, new: jnp.concatenate([old, new[None]])[1:], poses, pose.x)
        scaled = jnp.concatenate([(last.c / STANDARD_GRAVITY - 1.0)[None], last.omega / self.omega_max])
        frames = jnp.concatenate([memory.frames, shown.reshape(1, 14)])[1:]
        commands = jnp.concatenate([memory.commands, scaled[None]])[1:]
        features = self.features(frames if frame is None else self._moved_to(frame, frames, poses))
        o = jnp.concatenate([features, visible.astype(true.dtype), commands.reshape(-1)])
        return o, KeypointMemory(frames, commands, pose, poses, key)

    def _command(self, scaled: Float[Array, "4"]) -> Command:
        """Return the command that was remembered as ``scaled``."""
        return Command((scaled[0] + 1.0) * STANDARD_GRAVITY, scaled[1:] * self.omega_max)


def random_motion(key: Key[Array, ""], goal: Float[Array, "3"]) -> tuple[State, Float[Array, "3"]]:
    """Draw a random state near the goal, and body rates, for encoder pretraining; the key is consumed."""
    kp, kr, ky, kv, kw = random.split(key, 5)
    p = goal + random.uniform(kp, (3,), goal.dtype, minval=-1.2, maxval=1.2)
    R = so3.rotz(0.4 * random.normal(ky, (), goal.dtype)) @ so3.exp(0.2 * random.normal(kr, (3,), goal.dtype))
    return State(p, R, 0.7 * random.normal(kv, (3,), goal.dtype)), random.normal(kw, (3,), goal.dtype)
