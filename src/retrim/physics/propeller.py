"""Model propellers with blade-element momentum theory (NeuroBEM, arXiv 2106.08015).

Numbers in brackets refer to the equations of that paper. The air velocity at the hub is ``v_hor`` in the rotor's plane
and ``v_ver`` along its axis, **positive when descending**. All speeds are in m/s, rotor speeds in rad/s. Flapping is
left out, since it has no visible effect below 3 m/s.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

AIR_DENSITY = 1.204  # [kg/m^3], at 20 degrees Celsius
OMEGA_FLOOR = 10.0  # [rad/s]; below this speed, the model is not valid
V_HOR_FLOOR = 1e-6  # [m/s]; keeps square roots differentiable at hover

# Gauss-Legendre quadrature on [0, 1] with six points: abscissae and weights.
_RADII = (0.0337652428984, 0.1693953067669, 0.3806904069584, 0.6193095930416, 0.8306046932331, 0.9662347571016)
_RADII_W = (0.0856622461896, 0.1803807865241, 0.2339569672863, 0.2339569672863, 0.1803807865241, 0.0856622461896)
# Eight equally spaced azimuths; the integrands depend only on sin(psi), so only five values differ.
_SIN_PSI = (-1.0, -0.7071067811865476, 0.0, 0.7071067811865476, 1.0)
_SIN_PSI_W = (0.125, 0.25, 0.25, 0.25, 0.125)


class Propeller(eqx.Module):
    """Geometry and section coefficients; angles in rad, lengths in m."""

    radius: Float[Array, ""]
    blades: Float[Array, ""]
    pitch: Float[Array, ""]
    """Blade pitch theta0 at the root."""
    twist: Float[Array, ""]
    """Twist theta1 from root to tip."""
    chord_root: Float[Array, ""]
    chord_tip: Float[Array, ""]
    lift: Float[Array, ""]
    """Lift coefficient cl0 [-]."""
    drag: Float[Array, ""]
    """Drag coefficient cd0 [-]."""
    camber: Float[Array, ""]
    """Coefficient eps in cl = cl0 (sin alpha cos alpha + eps) [-]."""

    @property
    def area(self) -> Float[Array, ""]:
        """Area of the rotor disk [m^2]."""
        return jnp.pi * self.radius**2


def five_inch() -> Propeller:
    """Return the 5.1 in, three-blade propeller that the Agilicious platform publishes for its blade-element model."""
    return Propeller(
        radius=jnp.array(0.06477),
        blades=jnp.array(3.0),
        pitch=jnp.array(0.40055306),
        twist=jnp.array(-0.139626),
        chord_root=jnp.array(0.017),
        chord_tip=jnp.array(0.008),
        lift=jnp.array(4.797071),
        drag=jnp.array(4.168863),
        camber=jnp.array(0.07),
    )


def three_inch() -> Propeller:
    """Return a proposed propeller for the paper's small quadrotor, whose own propeller is unpublished.

    This is the 5.1 in propeller with a scaled radius and chord. The coefficient cd0 is chosen so that hover gives the
    published c_T = 2.05e-7 N s^2 and kappa = 0.00804 m.
    """
    big, radius = five_inch(), jnp.array(0.03903)
    scale = radius / big.radius
    return Propeller(
        radius=radius,
        blades=big.blades,
        pitch=big.pitch,
        twist=big.twist,
        chord_root=scale * big.chord_root,
        chord_tip=scale * big.chord_tip,
        lift=big.lift,
        drag=jnp.array(5.5664),
        camber=big.camber,
    )


class BladeForces(NamedTuple):
    """Forces of one rotor."""

    thrust: Float[Array, ""]
    """Thrust T along the axis [N]."""
    in_plane: Float[Array, ""]
    """Force H against the motion of the hub in the rotor's plane [N]."""
    torque: Float[Array, ""]
    """Torque Q about the axis [Nm]."""


class Inflow(eqx.Module):
    """Induced velocities of one rotor, kept from one millisecond to the next as the start of the iteration."""

    v_i: Float[Array, ""]
    """Induced velocity that solves the momentum balance [m/s]."""
    v_h: Float[Array, ""]
    """Induced velocity with ``v_ver`` set to zero, which the vortex-ring rule uses [m/s]."""

    @classmethod
    def above(cls, dtype: jnp.dtype) -> "Inflow":
        """Return a start above every root, from which Newton's method finds the largest one; see :func:`solve_root`."""
        return cls(jnp.array(40.0, dtype=dtype), jnp.array(40.0, dtype=dtype))


def blade_forces(
    prop: Propeller,
    omega: Float[Array, ""],
    v_hor: Float[Array, ""],
    v_ver: Float[Array, ""],
    v_i: Float[Array, ""],
) -> BladeForces:
    """Evaluate the blade-element integrals [6-15] at the induced velocity ``v_i``."""
    dtype = v_i.dtype
    x, wx = jnp.array(_RADII, dtype=dtype)[:, None], jnp.array(_RADII_W, dtype=dtype)[:, None]
    sin_psi, wpsi = jnp.array(_SIN_PSI, dtype=dtype)[None, :], jnp.array(_SIN_PSI_W, dtype=dtype)[None, :]
    r = prop.radius * x
    theta = prop.pitch + prop.twist * x
    chord = prop.chord_root + (prop.chord_tip - prop.chord_root) * x
    U_T = omega * r + v_hor * sin_psi  # [6]
    U_P = v_ver - v_i  # [7]
    # With phi = atan2(U_P, U_T) [8] and alpha = theta + phi [9], U sin(alpha) and U cos(alpha) need no arctangent:
    U_sin, U_cos = jnp.sin(theta) * U_T + jnp.cos(theta) * U_P, jnp.cos(theta) * U_T - jnp.sin(theta) * U_P
    U2 = U_T**2 + U_P**2
    per_U = lax.rsqrt(U2 + 1e-9)
    dL = chord * prop.lift * (U_sin * U_cos + prop.camber * U2)  # [10, 12]
    dD = chord * prop.drag * U_sin**2  # [11, 12]
    axial = (dL * U_T + dD * U_P) * per_U
    tangential = (dD * U_T - dL * U_P) * per_U
    scale = 0.5 * prop.blades * AIR_DENSITY * prop.radius * wx * wpsi
    return BladeForces(  # [13-15]
        jnp.sum(scale * axial), jnp.sum(scale * tangential * sin_psi), jnp.sum(scale * r * tangential)
    )


def solve_root(
    prop: Propeller,
    omega: Float[Array, ""],
    v_hor: Float[Array, ""],
    v_ver: Float[Array, ""],
    start: Float[Array, ""],
    *,
    steps: int,
) -> Float[Array, ""]:
    """Solve for the largest root v_i of T(v_i) = 2 rho A v_i sqrt(v_hor^2 + (v_ver - v_i)^2) [5], by Newton's method.

    Above the largest root, the balance is decreasing and concave, so Newton iterates approach the root
    monotonically. From a start just below the root, the first iterate jumps above the root. The gradient is that of the
    root: by the implicit function theorem, one differentiable step from the root suffices. Gradients do not flow
    through ``start``.
    """
    disk = 2.0 * AIR_DENSITY * prop.area

    def step(v: Float[Array, ""]) -> Float[Array, ""]:
        v = lax.stop_gradient(v)
        thrust, lift_slope = jax.jvp(
            lambda v: blade_forces(prop, omega, v_hor, v_ver, v).thrust, (v,), (jnp.ones_like(v),)
        )
        speed = jnp.sqrt(v_hor**2 + (v_ver - v) ** 2)
        momentum_slope = disk * (speed + v * (v - v_ver) / speed)
        slope = jnp.minimum(lift_slope, 0.0) - jnp.maximum(momentum_slope, 0.1 * disk)  # neither flat nor rising
        return jnp.clip(v - (thrust - disk * v * speed) / lax.stop_gradient(slope), -20.0, 60.0)

    v = start
    if steps > 2:  # the loop compiles as fast as one step
        v = lax.fori_loop(0, steps - 2, lambda _, v: step(v), v)
    for _ in range(min(steps, 2)):
        v = step(v)
    return v


def vortex_ring(inflow: Inflow, v_ver: Float[Array, ""]) -> Float[Array, ""]:
    """Return the induced velocity [m/s] from the momentum balance or, in slow descent, the empirical rule [18, 19]."""
    v_i, v_h = inflow.v_i, inflow.v_h
    x = v_ver / v_h
    ring = v_h * (1.0 + x * (1.125 + x * (-1.372 + x * (1.718 - 0.655 * x))))
    inside = (v_ver >= 0.01 * v_i) & (v_ver <= 2.0 * v_i)
    return jnp.where(inside, jnp.minimum(jnp.maximum(v_i, ring), 2.0 * v_h), v_i)


def rotor(
    prop: Propeller,
    omega: Float[Array, ""],
    v_hor: Float[Array, ""],
    v_ver: Float[Array, ""],
    inflow: Inflow,
    *,
    steps: int = 2,
) -> tuple[BladeForces, Inflow]:
    """Return the forces of one rotor and its inflow, after ``steps`` Newton iterations for each root.

    From the inflow one millisecond earlier, two iterations are exact to float32 precision in any usual manoeuvre. From
    :meth:`Inflow.above`, use 16 iterations.
    """
    omega, v_hor = jnp.maximum(omega, OMEGA_FLOOR), jnp.maximum(v_hor, V_HOR_FLOOR)
    result = Inflow(
        solve_root(prop, omega, v_hor, v_ver, inflow.v_i, steps=steps),
        solve_root(prop, omega, v_hor, jnp.zeros_like(v_ver), inflow.v_h, steps=steps),
    )
    return blade_forces(prop, omega, v_hor, v_ver, vortex_ring(result, v_ver)), result


@eqx.filter_jit
def hover_coefficient(prop: Propeller, omega: Float[Array, ""]) -> Float[Array, ""]:
    """Return c_T = T / omega^2 of a rotor in still air [N s^2]; it does not depend on the rotor speed."""
    zero = jnp.zeros_like(omega)
    forces, _ = rotor(prop, omega, zero, zero, Inflow.above(omega.dtype), steps=16)
    return forces.thrust / omega**2
