"""Error-state extended Kalman filter of the camera's pose, used to predict occluded keypoints.

The filter knows the ground pattern, the commands and Eq. (1) of the paper; it never sees the state. While no point is
visible it predicts; one visible point already corrects it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from ..physics import so3
from ..physics.dynamics import PointMass
from ..physics.state import Command, State
from .camera import Camera, in_camera

START = (0.1, 0.05, 0.2)  # uncertainty of the pose at hand-over: m, rad, m/s
DRIFT = (0.0, 0.5, 3.0)  # what Eq. (1) misses: rates [rad/s] and acceleration [m/s^2], held over a tick
GATE = 4.0  # a point farther off than so many standard deviations corrects no more than one there


class PoseFilter(eqx.Module):
    """Estimated state, and the covariance of its error: position (world), attitude (body), velocity (world)."""

    x: State
    P: Float[Array, "9 9"]

    @classmethod
    def near(cls, x: State, key: Key[Array, ""]) -> "PoseFilter":
        """Return a filter initialised near ``x``, to 10 cm, 3 degrees and 0.2 m/s; the key is consumed."""
        std = jnp.repeat(jnp.array(START, dtype=x.p.dtype), 3)
        off = std * jax.random.normal(key, (9,), x.p.dtype)
        return cls(_moved(x, off), jnp.diag(std**2))

    def predicted(self, u: Command, dt: float) -> "PoseFilter":
        """Return the filter ``dt`` seconds later; ``u`` is the command that acted during that time."""
        x, zero = self.x, jnp.zeros((3, 3), dtype=self.P.dtype)
        eye = jnp.eye(3, dtype=self.P.dtype)
        lean = -dt * u.c * x.R @ so3.hat(jnp.array([0.0, 0.0, 1.0], dtype=self.P.dtype))
        F = jnp.concatenate(
            [
                jnp.concatenate([eye, zero, dt * eye], axis=1),
                jnp.concatenate([zero, so3.exp(-dt * u.omega), zero], axis=1),
                jnp.concatenate([zero, lean, eye], axis=1),
            ]
        )
        drift = dt * jnp.repeat(jnp.array(DRIFT, dtype=self.P.dtype), 3)
        return PoseFilter(PointMass(dt).step(x, u, jnp.zeros_like(x.p)), F @ self.P @ F.T + jnp.diag(drift**2))

    def corrected(
        self,
        camera: Camera,
        ground: Float[Array, "7 3"],
        pixels: Float[Array, "7 2"],
        visible: Bool[Array, " 7"],
        noise: Float[Array, "2"],
    ) -> "PoseFilter":
        """Return the filter corrected by the visible ``pixels``, by sequential scalar updates.

        Args:
            camera: The camera model.
            ground: Keypoints, world [m].
            pixels: Measured projections (normalised image coordinates).
            visible: Which of them were measured.
            noise: Their standard deviation per axis (normalised).
        """

        def expected(off: Float[Array, "9"]) -> Float[Array, "14"]:
            here = in_camera(_moved(self.x, off), ground)
            return jax.vmap(lambda P: camera.project(P).pixel)(here).reshape(14)

        zero = jnp.zeros(9, dtype=self.P.dtype)
        H, z = jax.jacfwd(expected)(zero), (pixels.reshape(14) - expected(zero))
        seen = jnp.repeat(visible, 2).astype(z.dtype)
        r = jnp.tile(noise**2, 7)
        off, P = zero, self.P
        for i in range(14):  # scalar updates need no matrix inverse
            Ph = P @ H[i]
            s = H[i] @ Ph + r[i]
            miss = z[i] - H[i] @ off
            miss = jnp.clip(miss, -GATE * jnp.sqrt(s), GATE * jnp.sqrt(s))
            gain = seen[i] * Ph / s
            off, P = off + gain * miss, P - jnp.outer(gain, Ph)
        return PoseFilter(_moved(self.x, off), 0.5 * (P + P.T))


def _moved(x: State, off: Float[Array, "9"]) -> State:
    return State(x.p + off[:3], x.R @ so3.exp(off[3:6]), x.v + off[6:])
