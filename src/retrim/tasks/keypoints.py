"""What a camera shows a policy that knows no state: seven points on the ground, five frames, the last commands."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Bool, Float, Key

from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, Command, State
from .camera import Camera, in_camera
from .observation import AbstractObservation
from .sight import DT, Sight

PATTERN = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5), (-0.5, 0.0), (0.0, 0.5), (0.5, 0.0))
"""The points, relative to the one below the goal [m]: a square's corners and three mid-points of its sides."""
BELOW = 1.0  # [m], from the goal to the ground
FRAMES, STRIDE, COMMANDS = 5, 3, 3  # frames 60 ms apart, as published
DEPTH = (FRAMES - 1) * STRIDE + 1
FAR = 2.5  # pixels (normalised) farther than this from where they are at the goal are cut off there
STRANGE = 5.0  # standard deviations beyond which a whitened feature says no more


class Seeing(NamedTuple):
    """What the observation remembers."""

    frames: Float[Array, "depth 14"]
    """Newest last."""
    commands: Float[Array, "3 4"]
    sight: Sight
    """Where the camera thinks that it is, to complete the points that it does not see."""
    key: Key[Array, ""]


class Keypoints(AbstractObservation[Seeing]):
    """o = [whitened pixels of five frames, which points are visible now, the last three commands]: 89 numbers.

    With ``honest`` false every point is fed, wherever it is, as in the paper's code. Else a point that the camera does
    not see is not observed: where it would be follows from those that are, and from the commands; see
    :class:`retrim.tasks.sight.Sight`.

    ``noise`` is that of a pixel, in pixels; drawn from the start and the tick, so that roll-outs repeat.
    """

    camera: Camera
    goal: Float[Array, "3"]
    omega_max: Float[Array, "3"]
    noise: Float[Array, ""]
    dropout: Float[Array, ""]
    """Probability that a visible point is missed in a frame."""
    mean: Float[Array, "70"]
    whiten: Float[Array, "70 70"]
    honest: bool = eqx.field(static=True, default=True)

    @classmethod
    def of(
        cls,
        goal: Float[Array, "3"],
        omega_max: Float[Array, "3"],
        *,
        honest: bool = True,
        noise: float = 0.0,
        dropout: float = 0.0,
        whitened: bool = True,
    ) -> "Keypoints":
        """With the whitening of random short flights about the goal (always the same ones); or with raw pixels."""
        plain = cls(
            Camera.published(), goal, omega_max, jnp.array(noise), jnp.array(dropout),
            jnp.zeros(70), jnp.eye(70), honest,
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
        """89."""
        return 14 * FRAMES + 7 + 4 * COMMANDS

    def init(self, x: State) -> Seeing:
        """As if the vehicle had come in a straight line, without turning, and hovered by its commands."""
        frames = self.history(x, jnp.zeros_like(x.p))
        bits = lax.bitcast_convert_type(jnp.sum(x.p + x.v).astype(jnp.float32), jnp.int32)
        commands = jnp.zeros((COMMANDS, 4), dtype=x.p.dtype)
        key, k_sight = random.split(random.key(bits))
        return Seeing(frames, commands, Sight.near(x, k_sight), key)

    def history(self, x: State, omega: Float[Array, "3"]) -> Float[Array, "depth 14"]:
        """Frames of a motion with constant velocity and body rates that ends in ``x``, oldest first."""
        ago = DT * jnp.arange(DEPTH - 1, -1, -1, dtype=x.p.dtype)

        def frame(s: Float[Array, ""]) -> Float[Array, "14"]:
            return self.pixels(State(x.p - s * x.v, x.R @ so3.exp(-s * omega), x.v))[0].reshape(14)

        return jax.vmap(frame)(ago)

    def stacked(self, frames: Float[Array, "depth 14"]) -> Float[Array, "70"]:
        """The five frames that are shown, newest first."""
        return frames[::-STRIDE].reshape(-1)

    def features(self, frames: Float[Array, "depth 14"]) -> Float[Array, "70"]:
        """Whitened; frames that fit no motion, as when points come into sight, are cut off."""
        return jnp.clip(self.whiten @ (self.stacked(frames) - self.mean), -STRANGE, STRANGE)

    def pixels(self, x: State) -> tuple[Float[Array, "7 2"], Bool[Array, " 7"]]:
        """Where the points appear, cut off far outside the image, and which are visible."""
        seen = jax.vmap(self.camera.project)(in_camera(x, self.ground()))
        return jnp.clip(seen.pixel, -FAR, FAR), seen.visible

    def ground(self) -> Float[Array, "7 3"]:
        """The points, world [m]."""
        flat = jnp.array(PATTERN, dtype=self.goal.dtype)
        return self.goal[None] + jnp.concatenate([flat, jnp.full((7, 1), -BELOW, dtype=flat.dtype)], axis=1)

    def __call__(
        self, memory: Seeing, t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], Seeing]:
        """One frame more."""
        key, k_noise, k_drop = random.split(memory.key, 3)
        true, visible = self.pixels(x)
        noise = (2.0 * self.noise / self.camera.size)[None] * random.normal(k_noise, (7, 2), true.dtype)
        shown = true + lax.stop_gradient(noise)
        sight = memory.sight
        if self.honest:
            visible = visible & (random.uniform(k_drop, (7,), true.dtype) >= self.dropout)
            sharpness = 2.0 * jnp.maximum(self.noise, 0.5) / self.camera.size
            sight = lax.stop_gradient(memory.sight).predicted(lax.stop_gradient(last))
            sight = sight.corrected(self.camera, self.ground(), lax.stop_gradient(shown), visible, sharpness)
            sight = lax.stop_gradient(sight)
            filled, _ = self.pixels(sight.x)
            # the value of what is known, the gradient of what is: the completion follows the true point
            shown = jnp.where(visible[:, None], shown, true + lax.stop_gradient(filled - true))
        scaled = jnp.concatenate([(last.c / STANDARD_GRAVITY - 1.0)[None], last.omega / self.omega_max])
        frames = jnp.concatenate([memory.frames, shown.reshape(1, 14)])[1:]
        commands = jnp.concatenate([memory.commands, scaled[None]])[1:]
        features = self.features(frames)
        o = jnp.concatenate([features, visible.astype(true.dtype), commands.reshape(-1)])
        return o, Seeing(frames, commands, sight, key)


def random_motion(key: Key[Array, ""], goal: Float[Array, "3"]) -> tuple[State, Float[Array, "3"]]:
    """A random state near the goal and body rates, for representation learning; the key is consumed."""
    kp, kr, ky, kv, kw = random.split(key, 5)
    p = goal + random.uniform(kp, (3,), goal.dtype, minval=-1.2, maxval=1.2)
    R = so3.rotz(0.4 * random.normal(ky, (), goal.dtype)) @ so3.exp(0.2 * random.normal(kr, (3,), goal.dtype))
    return State(p, R, 0.7 * random.normal(kv, (3,), goal.dtype)), random.normal(kw, (3,), goal.dtype)
