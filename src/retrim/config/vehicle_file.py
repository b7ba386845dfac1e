"""Vehicles from TOML files: what a builder can measure or look up; the rest follows by stated rules."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal

import jax.numpy as jnp
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from ..physics.state import STANDARD_GRAVITY
from ..physics.vehicle import Vehicle, kingfisher, small
from .validation import read_toml, validated

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Three = tuple[Positive, Positive, Positive]
INCH = 0.0254  # [m]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class VehicleSpec:
    """A quadrotor in X configuration."""

    name: str
    mass: Annotated[float, Field(gt=0.005, le=50.0, strict=True)]
    """All-up mass [kg]."""
    inertia: Three
    """Diagonal of the inertia, body frame [kg m^2]."""
    arm: tuple[Positive, Positive]
    """Distance of the rotors from the centre along body x and y [m]."""
    thrust_max: Positive
    """Static thrust of all four rotors together [N]."""
    rates_max: Three
    """Largest body rates that the rate controller accepts [rad/s]."""
    motor_tau: Annotated[float, Field(gt=0, le=0.5, strict=True)]
    """Time constant of the motors [s]."""
    rate_lag: Three | None = None
    """Time constants of the body rates behind their commands: roll, pitch, yaw [s]; those of the preset by default.
    Policies are trained for them, and for a thrust that follows as the motors do."""
    command_delay: Annotated[float, Field(ge=0, le=0.2, strict=True)] | None = None
    """Between a command and its effect [s]; that of the preset by default. Policies are trained for it, in whole ticks,
    and learners pair accelerations with the commands that caused them."""
    propeller: Literal["3 inch", "5 inch"] | None = None
    """Blade geometry that is scaled to the vehicle; the nearer one by default."""
    propeller_diameter: Positive | None = None
    """[inch]; by default 0.9 times the distance of neighbouring rotors, and 0.3 to 1.3 times it."""
    drag_area: Three | None = None
    """c A of the body along its axes [m^2]; by default the kingfisher's, by arm squared."""

    @model_validator(mode="after")
    def _possible(self) -> "VehicleSpec":
        """Raise if no such vehicle can exist."""
        weight = self.mass * STANDARD_GRAVITY
        if self.thrust_max <= 1.2 * weight:
            raise ValueError(
                f"thrust_max = {self.thrust_max} N must exceed 1.2 times the weight of {weight:.2f} N, or nothing is "
                f"left to steer with"
            )
        a, b, c = sorted(self.inertia)
        if a + b < 0.999 * c:
            raise ValueError(f"inertia = {self.inertia}: no body has one moment larger than the sum of the others")
        reach = math.hypot(*self.arm)
        if max(self.inertia) > 3.0 * self.mass * reach**2:
            raise ValueError(
                f"inertia = {self.inertia} kg m^2 is too large for {self.mass} kg within {reach:.3f} m of the centre; "
                f"is it in g cm^2 or kg mm^2?"
            )
        apart = 2.0 * min(self.arm) / INCH
        if self.propeller_diameter is not None and not 0.3 * apart <= self.propeller_diameter <= 1.3 * apart:
            raise ValueError(
                f"propeller_diameter = {self.propeller_diameter:g} does not fit rotors that are {apart:.3g} inches "
                f"apart; is it in inches, and arm in m?"
            )
        return self

    def build(self) -> Vehicle:
        """Return the vehicle.

        The propeller is a published one, scaled: chord and radius by the diameter; rotor speeds so that a quarter of
        ``thrust_max`` is reached at 90 % of the largest speed. Drag torque over thrust and rotor inertia follow the
        diameter (to the powers 1 and 5).
        """
        reach = math.hypot(*self.arm)
        inches = self.propeller_diameter or 0.9 * 2.0 * min(self.arm) / INCH
        kind = self.propeller or ("3 inch" if inches < 4.0 else "5 inch")
        like = small() if kind == "3 inch" else kingfisher()
        scale = inches / (3.07 if kind == "3 inch" else 5.1)
        blade = like.propeller
        scaled = dataclasses.replace(
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
            propeller=scaled,
            rate_lag=None if self.rate_lag is None else jnp.array(self.rate_lag),
            esc=dataclasses.replace(esc, base=esc.base * ratio, linear=esc.linear * ratio, root=esc.root * ratio),
        )


def read_vehicle(path: Path) -> VehicleSpec:
    """Read a vehicle file.

    Raises:
        ConfigError: The file cannot be read, or a value is missing, unknown or impossible.
    """
    tables = read_toml(path)
    tables.setdefault("name", path.stem)
    return validated(VehicleSpec, tables, source=str(path))
