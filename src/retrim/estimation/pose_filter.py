"""Estimate the camera's pose and the disturbance with an error-state extended Kalman filter.

The filter uses the ground pattern, the commands and Eq. (1) of the paper, but not the state. With an inertial unit, it
needs neither the commands nor the vehicle. While no point is visible, the filter only predicts; one visible point is
enough for a correction. Errors in Eq. (1) are modelled as a slow acceleration.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Key

from ..physics import so3
from ..physics.actuators import apply_lag
from ..physics.dynamics import PointMass
from ..physics.state import STANDARD_GRAVITY, Command, State
from .camera import Camera, in_camera

START = (0.1, 0.05, 0.2)  # uncertainty of the pose at hand-over: m, rad, m/s
PUSH = 1.0  # [m/s^2], uncertainty of the disturbance at hand-over
DRIFT = (0.0, 0.5, 1.0)  # further errors in Eq. (1): rates [rad/s] and acceleration [m/s^2], held over a tick
WANDER = 1.0  # [m/s^2] after one second, random walk of the disturbance
ITERATIONS = 3  # a first estimate may be far off, so the projection is linearised again at the last result
LEAST_NOISE = 0.5  # [px], smallest noise that the filter assumes for a camera
GATE = 4.0  # standard deviations; a point farther off corrects no more than one at this distance


class PoseFilter(eqx.Module):
    """Estimate and error covariance: position (world), attitude (body), velocity and disturbance (world)."""

    x: State
    d: Float[Array, "3"]
    """Disturbance, world [m/s^2]."""
    P: Float[Array, "12 12"]
    acting: Command
    """Command at the actuators."""

    @classmethod
    def near(cls, x: State, key: Key[Array, ""]) -> "PoseFilter":
        """Return a filter initialised near ``x``, within about 10 cm, 3 degrees and 0.2 m/s; the key is consumed."""
        std = jnp.repeat(jnp.array(START, dtype=x.p.dtype), 3)
        off = std * jax.random.normal(key, (9,), x.p.dtype)
        push = jnp.full(3, PUSH, dtype=x.p.dtype)
        return cls(
            _perturb(x, off), jnp.zeros_like(x.p), jnp.diag(jnp.concatenate([std, push]) ** 2), Command.hover(x.p.dtype)
        )

    def predict(self, u: Command, dt: float, tau: Float[Array, ""] | Command | None = None) -> "PoseFilter":
        """Return the filter ``dt`` seconds later.

        Args:
            u: Command that reached the actuators during that time.
            dt: Time step [s].
            tau: Time constants of the actuators [s]; None for actuators without lag.
        """
        x, dtype = self.x, self.P.dtype
        u, end = (u, u) if tau is None else apply_lag(self.acting, u, dt, tau)
        zero, eye = jnp.zeros((3, 3), dtype=dtype), jnp.eye(3, dtype=dtype)
        lean = -dt * u.c * x.R @ so3.hat(jnp.array([0.0, 0.0, 1.0], dtype=dtype))
        F = jnp.block(
            [
                [eye, zero, dt * eye, zero],
                [zero, so3.exp(-dt * u.omega), zero, zero],
                [zero, lean, eye, dt * eye],
                [zero, zero, zero, eye],
            ]
        )
        drift = dt * jnp.repeat(jnp.array(DRIFT, dtype=dtype), 3)
        walk = jnp.full(3, dt**0.5 * WANDER, dtype=dtype)
        Q = jnp.diag(jnp.concatenate([drift, walk]) ** 2)
        return PoseFilter(PointMass(dt).step(x, u, self.d), self.d, F @ self.P @ F.T + Q, end)

    def predict_by_unit(
        self,
        omega: Float[Array, "3"],
        force: Float[Array, "3"],
        dt: float,
        noise: tuple[Float[Array, ""], Float[Array, ""]],
    ) -> "PoseFilter":
        """Return the filter ``dt`` seconds later, by an inertial unit in place of the commands and Eq. (1).

        The disturbance keeps its estimate, since the unit measures its effect.

        Args:
            omega: Mean body rates during that time [rad/s].
            force: Mean specific force during that time, in the body axes at its end [m/s^2].
            dt: Time step [s].
            noise: Standard deviation per axis of these rates [rad/s] and of this force [m/s^2].
        """
        x, dtype = self.x, self.P.dtype
        zero, eye = jnp.zeros((3, 3), dtype=dtype), jnp.eye(3, dtype=dtype)
        R = x.R @ so3.exp(dt * omega)
        a = so3.act(R, force) - jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype=dtype)
        turn = so3.exp(-dt * omega)
        lean = -dt * R @ so3.hat(force) @ turn
        F = jnp.block(
            [[eye, zero, dt * eye, zero], [zero, turn, zero, zero], [zero, lean, eye, zero], [zero] * 3 + [eye]]
        )
        exact = jnp.zeros(3, dtype=dtype)
        rate_noise, force_noise = (jnp.full(3, value, dtype=dtype) for value in noise)
        steps = dt * jnp.concatenate([exact, rate_noise, force_noise, exact])
        after = State(x.p + dt * x.v + 0.5 * dt**2 * a, R, x.v + dt * a)
        return PoseFilter(after, self.d, F @ self.P @ F.T + jnp.diag(steps**2), self.acting)

    def correct(
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
            visible: Whether each pixel was measured.
            noise: Standard deviation of the pixels per axis (normalised).
        """

        def expected(off: Float[Array, "12"]) -> Float[Array, "14"]:
            here = in_camera(_perturb(self.x, off), ground)
            return jax.vmap(lambda P: camera.project(P).pixel)(here).reshape(14)

        is_visible = jnp.repeat(visible, 2).astype(pixels.dtype)
        r = jnp.tile(noise**2, 7)
        here = (jnp.zeros(12, dtype=self.P.dtype), self.P)

        def scalar(carry: tuple[Array, Array], row: tuple[Array, ...]) -> tuple[tuple[Array, Array], None]:
            """Correct with one coordinate of a pixel, which does not need a matrix inverse."""
            (off, P), (h, level, r, is_visible) = carry, row
            Ph = P @ h
            s = h @ Ph + r
            limit = GATE * jnp.sqrt(s)
            gain = is_visible * Ph / s
            return (off + gain * jnp.clip(level - h @ off, -limit, limit), P - jnp.outer(gain, Ph)), None

        def look(_: Array, before: tuple[Array, Array]) -> tuple[Array, Array]:
            off, _ = before
            H = jax.jacfwd(expected)(off)
            level = pixels.reshape(14) - expected(off) + H @ off
            return lax.scan(scalar, here, (H, level, r, is_visible))[0]

        off, P = lax.fori_loop(0, ITERATIONS, look, here)
        return PoseFilter(_perturb(self.x, off), self.d + off[9:], 0.5 * (P + P.T), self.acting)


def assumed_noise(camera: Camera, noise: Float[Array, ""]) -> Float[Array, "2"]:
    """Return the normalised standard deviation that the filter assumes for pixels with a noise of ``noise`` [px]."""
    return 2.0 * jnp.maximum(noise, LEAST_NOISE) / camera.size


def _perturb(x: State, off: Float[Array, " n"]) -> State:
    return State(x.p + off[:3], x.R @ so3.exp(off[3:6]), x.v + off[6:9])
