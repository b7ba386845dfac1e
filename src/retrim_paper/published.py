"""Compares the blade-element plant's figures with published ones."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from retrim.physics.bem import FRAME_FACTOR, IN_PLANE_GAIN
from retrim.physics.propeller import BladeForces, Inflow, Propeller, five_inch, rotor, three_inch, vortex_ring

GOLDEN_HOVER = (
    (1800.0, 5.13804),
    (1850.0, 5.42739),
    (1900.0, 5.72464),
    (1950.0, 6.02982),
)  # rad/s, N: Agilicious


def compare_published() -> list[dict[str, Any]]:
    """Return our figures next to the published ones."""
    big, little = five_inch(), three_inch()
    still = SteadyRotor(big, 1109.15, 0.0, 0.0)
    low = SteadyRotor(little, 1548.8, 0.0, 0.0)
    side = SteadyRotor(big, 1109.15, 3.0, 0.0)
    up, down = SteadyRotor(big, 1109.15, 0.0, -0.5), SteadyRotor(big, 1109.15, 0.0, 0.0)
    damping = FRAME_FACTOR * 4 * (down.thrust - up.thrust) / 0.5 / 0.752
    return [
        _row("thrust coefficient, 5.1 in, hover [1e-6 N s^2]", 1e6 * still.thrust / 1109.15**2, 1.5625, "thrust map"),
        _row("induced velocity, 5.1 in, 1109 rad/s [m/s]", still.v_i, 7.79, "recomputed"),
        _row("torque over thrust, 5.1 in, hover [m]", still.torque / still.thrust, 0.0117, "recomputed"),
        _row("thrust coefficient, 3.07 in, hover [1e-7 N s^2]", 1e7 * low.thrust / 1548.8**2, 2.05, "authors' code"),
        _row("torque over thrust, 3.07 in, hover [m]", low.torque / low.thrust, 0.00804, "authors' code"),
        _row(
            "edgewise rotor drag, kingfisher, 3 m/s [1/s]",
            4 * IN_PLANE_GAIN * side.in_plane / 0.752 / 3.0,
            0.24,
            "recomputed",
        ),
        _row("axial damping, kingfisher, climbing [1/s]", damping, 0.37, "recomputed"),
        *(
            _row(f"thrust, {int(w)} rad/s [N]", SteadyRotor(big, w, 0.0, 0.0).thrust, T, "Agilicious")
            for w, T in GOLDEN_HOVER
        ),
    ]


class SteadyRotor:
    """Forces and induced velocity of one rotor in steady air."""

    def __init__(self, prop: Propeller, omega: float, v_hor: float, v_ver: float) -> None:
        forces, inflow = steady_rotor(prop, jnp.array(omega), jnp.array(v_hor), jnp.array(v_ver))
        self.thrust, self.in_plane, self.torque = (float(f) for f in forces)
        self.v_i = float(vortex_ring(inflow, jnp.array(v_ver)))


@eqx.filter_jit
def steady_rotor(prop: Propeller, omega: Array, v_hor: Array, v_ver: Array) -> tuple[BladeForces, Inflow]:
    """Return the forces and the inflow of a rotor in steady air.

    Args:
        prop: Propeller of the rotor.
        omega: Rotor speed [rad/s].
        v_hor: Air speed in the rotor plane [m/s].
        v_ver: Speed along the rotor axis, positive when descending [m/s].
    """
    return rotor(prop, omega, v_hor, v_ver, Inflow.above(omega.dtype), steps=16)


def _row(what: str, ours: float, theirs: float, source: str) -> dict[str, Any]:
    return {"what": what, "ours": ours, "published": theirs, "source": source}
