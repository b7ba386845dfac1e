"""In-flight observation of keypoints in a camera image; some points are outside the image, noisy or missed."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Bool, Float, Key

from ..estimation.pose_filter import PoseFilter, assumed_noise
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State
from .keypoints import COMMANDS, Keypoints, key_of
from .observation import AbstractObservation
from .state_estimate import StateEstimate


class OccludedMemory(NamedTuple):
    """Memory of :class:`OccludedKeypoints`."""

    commands: Float[Array, "3 4"]
    """Commands in the world frame, newest last."""
    pose: PoseFilter
    poses: State
    """Current estimates of the poses at the last few ticks, newest last."""
    key: Key[Array, ""]


class OccludedKeypoints(AbstractObservation[OccludedMemory]):
    """The observation of :class:`Keypoints`, reconstructed from a camera image.

    A point outside the image is not observed, and a point inside it is missed with probability ``dropout``. A filter
    estimates the pose from the other points and the commands. The policy receives the image that corresponds to the
    estimated pose. Each correction also changes the past images, so the correction does not look like motion.

    Use this observation only in flight, since gradients do not pass through the filter.
    """

    full: Keypoints
    """The training observation; its ``noise`` is the camera's noise."""
    dropout: Float[Array, ""]
    """Probability that a visible point is missed in a frame."""
    lag: Command | None = None
    """Actuator time constants in the filter [s]; None for actuators without lag."""
    frame: EffectiveGravityFrame | None = None
    """Frame of the observed image; the filter and ``full`` remain in the world frame."""
    delay_ticks: int = eqx.field(static=True, default=0)
    """The plant's declared command delay [ticks]; the filter predicts with the command that acted."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the delay is longer than the memory."""
        if not 0 <= self.delay_ticks <= COMMANDS:
            raise ValueError(f"OccludedKeypoints: delay_ticks = {self.delay_ticks} must be 0 to {COMMANDS}")

    @property
    def size(self) -> int:
        """Length of the observation: 89."""
        return self.full.size

    @property
    def measures_state(self) -> bool:
        """False: only images are measured."""
        return False

    @property
    def state_estimator(self) -> Callable[[OccludedMemory], StateEstimate]:
        """Function that returns the estimate of the pose filter, in the world frame."""
        return lambda memory: StateEstimate(memory.pose.x, memory.pose.d)

    def image(self, x: State) -> tuple[Float[Array, "7 2"], Bool[Array, " 7"]]:
        """Return the pixels of the seven keypoints and their visibility."""
        return self.full.pixels(x)

    def in_frame(self, frame: EffectiveGravityFrame) -> "OccludedKeypoints":
        """Return the observation of a camera in ``frame``, in which the ground is level."""
        return dataclasses.replace(self, frame=frame)

    def init(self, x: State) -> OccludedMemory:
        """Return the memory of a vehicle that has moved in a straight line, without turning, under hover commands.

        The memory is that of one tick ago, since the first call adds the frame for ``x``.
        """
        key, k_pose = random.split(key_of(x))
        pose = PoseFilter.near(State(x.p - self.full.dt * x.v, x.R, x.v), k_pose)
        poses = jax.vmap(lambda s: State(pose.x.p - s * pose.x.v, pose.x.R, pose.x.v))(self._ago(x))
        return OccludedMemory(jnp.zeros((COMMANDS, 4), dtype=x.p.dtype), pose, poses, key)

    def __call__(
        self, memory: OccludedMemory, t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], OccludedMemory]:
        """Return the observation after one more frame."""
        full, frame = self.full, self.frame
        if frame is not None:  # the camera is in the world
            x, last = frame.world_state(x), frame.world_command(last)
        x, last, memory = lax.stop_gradient((x, last, memory))
        command = last if self.delay_ticks == 0 else full.command(memory.commands[-self.delay_ticks])
        key, k_noise, k_drop = random.split(memory.key, 3)
        true, inside = full.pixels(x)
        is_visible = inside & (random.uniform(k_drop, (7,), true.dtype) >= self.dropout)
        sharpness = assumed_noise(full.camera, full.noise)
        prior = memory.pose.predict(command, full.dt, self.lag)
        pose = prior.correct(
            full.camera, full.ground(), true + full.deviation(k_noise, true.dtype), is_visible, sharpness
        )
        poses = self._correct(memory.poses, prior.x, pose.x)
        commands = jnp.concatenate([memory.commands, full.scaled(last)[None]])[1:]
        o = self._observe(poses, commands)
        return o, OccludedMemory(commands, pose, poses, key)

    def _observe(self, poses: State, commands: Float[Array, "3 4"]) -> Float[Array, " o"]:
        """Return the observation for these poses and commands, in the frame."""
        full, frame = self.full, self.frame
        there = jax.tree.map(lambda leaf: leaf[:: -full.stride], poses)  # newest first
        if frame is not None:
            full = full.in_frame(frame)
            there = jax.vmap(frame.state)(there)
            commands = jax.vmap(lambda row: full.scaled(frame.command(full.command(row))))(commands)
        pixels, visible = jax.vmap(full.pixels)(there)
        features = full.features(pixels.reshape(-1))
        return jnp.concatenate([features, visible[0].astype(features.dtype), commands.reshape(-1)])

    def _correct(self, poses: State, prior: State, new: State) -> State:
        """Return the past poses, moved by the correction from ``prior`` to ``new``, followed by ``new``."""
        turn, dp, dv = new.R @ prior.R.T, new.p - prior.p, new.v - prior.v

        def move(x: State, ago: Float[Array, ""]) -> State:
            return State(x.p + dp - ago * dv, turn @ x.R, x.v + dv)

        before: State = jax.vmap(move)(poses, self._ago(new) + self.full.dt)
        poses = jax.tree.map(lambda old, now: jnp.concatenate([old, now[None]])[1:], before, new)
        return poses

    def _ago(self, x: State) -> Float[Array, " depth"]:
        """Return the ages of the poses in the memory, newest last [s]."""
        return self.full.dt * jnp.arange(self.full.depth - 1, -1, -1, dtype=x.p.dtype)
