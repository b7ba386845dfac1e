"""Build vehicles from TOML files of values that can be measured or looked up; fixed rules give all other values."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal

import jax.numpy as jnp
from pydantic import AfterValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from ..errors import ConfigError
from ..physics.state import STANDARD_GRAVITY
from ..physics.step_response import step_responses
from ..physics.vehicle import Vehicle, kingfisher, small
from .names import Plain, plain_from
from .units import Positive, Three, at_most, likely
from .validation import read_toml, validate

INCH = 0.0254  # [m]
MILLI = (("ms", 1e-3),)
Rate = Annotated[
    float,
    Field(ge=0.1, allow_inf_nan=False, strict=True),
    AfterValidator(at_most(40.0, "rad/s", ("deg/s", math.pi / 180.0))),
]
Damping = Annotated[float, Field(ge=0.1, le=10.0, strict=True)]
Lag = Annotated[Positive, AfterValidator(at_most(2.0, "s", *MILLI))]


OVERSHOOT, SLOWEST = 0.6, (0.25, 0.25, 1.5)
"""Limits of the step response of the rates: the largest overshoot, and the longest time to 63 % for each axis [s]."""
LONGEST_ARM = 2.0  # [m]
LIFT_RANGE = (1.6, 20.0)
"""Smallest and largest ratio of the total rotor thrust to the weight."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class VehicleSpec:
    """A quadrotor in X configuration."""

    name: Plain
    mass: Annotated[float, Field(gt=0.005, strict=True), AfterValidator(at_most(50.0, "kg", ("g", 1e-3)))]
    """All-up mass [kg]."""
    inertia: Three
    """Diagonal of the inertia tensor, body frame [kg m^2]."""
    arm: tuple[Positive, Positive]
    """Distances of the rotors from the centre along body x and y [m]."""
    thrust_max: Positive
    """Static thrust of all four rotors together [N]."""
    rates_max: tuple[Rate, Rate, Rate]
    """Largest body rates that the rate controller accepts: roll, pitch, yaw [rad/s]."""
    motor_tau: Annotated[float, Field(gt=0, strict=True), AfterValidator(at_most(0.5, "s", *MILLI))]
    """Time constant of the motors [s]."""
    rate_lag: tuple[Lag, Lag, Lag] | None = None
    """Time constants with which the body rates follow commands: roll, pitch, yaw [s]; by default, those of the
    simulated rate loop, which depend on the motors. Policies are trained for these time constants, and for a thrust
    with the time constant of the motors."""
    rate_damping: tuple[Damping, Damping, Damping] | None = None
    """Damping ratios of the rate loops: roll, pitch, yaw; by default, the loops are first-order. With damping ratios,
    ``rate_lag`` is 2 zeta / omega_n."""
    command_delay: Annotated[float, Field(ge=0, strict=True), AfterValidator(at_most(0.2, "s", *MILLI))] | None = None
    """Time between a command and its effect [s]; by default, that of the preset. Policies are trained for this delay,
    in whole ticks. Learners use the delay to pair accelerations with the commands that caused them."""
    propeller: Literal["3 inch", "5 inch"] | None = None
    """Blade geometry that is scaled to the vehicle; by default, the one whose diameter is closer."""
    propeller_diameter: Positive | None = None
    """Propeller diameter [inch]: 0.3 to 1.3 times the distance between adjacent rotors; by default 0.9 times."""
    drag_area: Three | None = None
    """Drag area c A of the body along its axes [m^2]; by default, that of the kingfisher, scaled by the squared arm."""

    @model_validator(mode="after")
    def _possible(self) -> "VehicleSpec":
        """Raise an error if no such vehicle can exist."""
        weight, thrust = self.mass * STANDARD_GRAVITY, self.thrust_max
        if thrust <= 1.2 * weight:
            raise ValueError(
                f"thrust_max = {thrust} N must exceed 1.2 times the weight of {weight:.2f} N, or no "
                f"thrust is left for control{likely(self._thrust_units(), *LIFT_RANGE)}"
            )
        if thrust < LIFT_RANGE[0] * weight:
            raise ValueError(
                f"thrust_max = {thrust} N is {thrust / weight:.2f} times the weight of {weight:.2f} N, and quadrotors "
                f"have {LIFT_RANGE[0]:g} times and more{likely(self._thrust_units(), *LIFT_RANGE)}"
            )
        if thrust > LIFT_RANGE[1] * weight:
            raise ValueError(
                f"thrust_max = {thrust} N is {thrust / weight:.3g} times the weight of {weight:.2f} N, and no "
                f"quadrotor has more than {LIFT_RANGE[1]:g} times{likely(self._thrust_units(), *LIFT_RANGE)}"
            )
        a, b, c = sorted(self.inertia)
        if a + b < 0.999 * c:
            raise ValueError(f"inertia = {self.inertia}: no body has one moment larger than the sum of the others")
        reach = math.hypot(*self.arm)
        if max(self.arm) > LONGEST_ARM:
            x, y = self.arm
            units = (
                (f"is it in {name}? write [{m * x:g}, {m * y:g}]", a / (self.mass * (m * reach) ** 2))
                for name, m in (("cm", 0.01), ("mm", 0.001))
            )
            raise ValueError(f"arm = {self.arm} must be at most {LONGEST_ARM:g} m{likely(units, 0.03, 3.0)}")
        if c > 3.0 * self.mass * reach**2:
            raise ValueError(
                f"inertia = {self.inertia} kg m^2 is too large for {self.mass} kg within {reach:.3f} m of the centre; "
                f"is it in g cm^2 or kg mm^2?"
            )
        if a < 0.01 * self.mass * reach**2:
            raise ValueError(
                f"inertia = {self.inertia} kg m^2 is too small for {self.mass} kg with rotors {reach:.3g} m from the "
                f"centre, which have about {0.2 * self.mass * reach**2:.2g}; is it in kg m^2, and arm in m?"
            )
        apart = 2.0 * min(self.arm) / INCH
        if self.propeller_diameter is not None and not 0.3 * apart <= self.propeller_diameter <= 1.3 * apart:
            raise ValueError(
                f"propeller_diameter = {self.propeller_diameter:g} does not fit rotors that are {apart:.3g} inches "
                f"apart; is it in inches, and arm in m?"
            )
        usual = 0.031 * (reach / 0.125) ** 2
        if self.drag_area is not None and max(self.drag_area) > 20.0 * usual:
            raise ValueError(
                f"drag_area = {self.drag_area} m^2 is too large for rotors {reach:.3g} m from the centre, which have "
                f"about {usual:.2g}; is it in cm^2?"
            )
        return self

    def _thrust_units(self) -> tuple[tuple[str, float], ...]:
        """Return questions about the unit of ``thrust_max`` and ``mass``, each with its ratio of thrust to weight."""
        ratio = self.thrust_max / (self.mass * STANDARD_GRAVITY)
        gram = STANDARD_GRAVITY / 1000.0
        return (
            (f"is it the thrust of one rotor? four have {4.0 * self.thrust_max:.4g} N", 4.0 * ratio),
            (f"is it in g? {self.thrust_max:g} g are {self.thrust_max * gram:.4g} N", ratio * gram),
            (f"is it in kg? {self.thrust_max:g} kg are {self.thrust_max * 1000.0 * gram:.4g} N", ratio * 1000.0 * gram),
            (f"is mass in g? {self.mass:g} g are {self.mass / 1000.0:.4g} kg", ratio * 1000.0),
        )

    def build(self) -> Vehicle:
        """Return the vehicle.

        The propeller is a scaled copy of a published one. Its chord and radius scale with the diameter. The rotor
        speeds are chosen so that a rotor reaches a quarter of ``thrust_max`` at 90 % of its largest speed. The ratio of
        drag torque to thrust scales with the diameter, and the rotor inertia with the fifth power of the diameter.
        """
        reach = math.hypot(*self.arm)
        inches = self.propeller_diameter or 0.9 * 2.0 * min(self.arm) / INCH
        kind = self.propeller or ("3 inch" if inches < 4.0 else "5 inch")
        like = small() if kind == "3 inch" else kingfisher()
        scale = inches / (3.07 if kind == "3 inch" else 5.1)
        blade = like.propeller
        propeller = dataclasses.replace(
            blade,
            radius=scale * blade.radius,
            chord_root=scale * blade.chord_root,
            chord_tip=scale * blade.chord_tip,
        )
        coefficient = like.thrust_coefficient * scale**4
        fastest = jnp.sqrt(self.thrust_max / 4.0 / coefficient) / 0.9
        esc = like.esc
        ratio = fastest / like.motor_max
        drag = jnp.array(self.drag_area) if self.drag_area else (reach / 0.125) ** 2 * kingfisher().drag_area
        return Vehicle(
            mass=jnp.array(self.mass),
            inertia=jnp.array(self.inertia),
            arm=jnp.array(self.arm),
            thrust_max=jnp.array(self.thrust_max),
            omega_max=jnp.array(self.rates_max),
            motor_tau=jnp.array(self.motor_tau),
            motor_min=like.motor_min * ratio,
            motor_max=fastest,
            rotor_inertia=like.rotor_inertia * scale**5,
            thrust_coefficient=coefficient,
            torque_ratio=like.torque_ratio * scale,
            drag_area=drag,
            propeller=propeller,
            rate_lag=None if self.rate_lag is None else jnp.array(self.rate_lag),
            rate_damping=None if self.rate_damping is None else jnp.array(self.rate_damping),
            esc=dataclasses.replace(esc, base=esc.base * ratio, linear=esc.linear * ratio, root=esc.root * ratio),
        )


def check_flyable(vehicle: Vehicle) -> None:
    """Raise an error if the simulated rate loop cannot control the vehicle.

    Raises:
        ValueError: A step response of the rates overshoots too much or rises too slowly; the message states its values.
    """
    for axis, result, slowest in zip(("roll", "pitch", "yaw"), step_responses(vehicle), SLOWEST, strict=True):
        if result.overshoot > OVERSHOOT or result.rise > slowest:
            raise ValueError(
                f"the {axis} rate cannot be controlled: a step of 1 rad/s overshoots by {result.overshoot:.0%} "
                f"and reaches 63 % after {result.rise:.2g} s, and {OVERSHOOT:.0%} and {slowest:g} s can be flown; the "
                f"motors are too slow (motor_tau = {float(vehicle.motor_tau):g} s), or the thrust too small for arm "
                f"and inertia"
            )


def read_vehicle(path: Path) -> VehicleSpec:
    """Read a vehicle file.

    Raises:
        ConfigError: The file cannot be read, a value is missing, unknown or impossible, or the rate loop cannot control
            the vehicle.
    """
    tables = read_toml(path)
    tables.setdefault("name", plain_from(path.stem))
    spec = validate(VehicleSpec, tables, source=str(path))
    try:
        check_flyable(spec.build())
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    return spec
