"""Which field of a log is what, in which unit and frame: a small TOML file."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from ...config.validation import read_toml, validated

STRICT = ConfigDict(extra="forbid")
Fields = Annotated[tuple[str, ...], Field(min_length=1, max_length=9)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
SPEEDS = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6}
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295}
RATES = {"rad/s": 1.0, "deg/s": 0.017453292519943295}
ACCELERATIONS = {"m/s^2": 1.0, "g": 9.80665}


@dataclass(frozen=True, config=STRICT)
class Time:
    """Of CSV and NPZ files; other formats have their own."""

    field: str
    unit: Literal["s", "ms", "us", "ns"] = "s"
    age: str | None = None
    """The field that says how old position, velocity and attitude were then, in the same unit."""


@dataclass(frozen=True, config=STRICT)
class Position:
    """Of the vehicle in the world."""

    fields: Fields
    unit: Literal["m", "cm", "mm"] = "m"


@dataclass(frozen=True, config=STRICT)
class Velocity:
    """Of the vehicle."""

    fields: Fields
    unit: Literal["m/s", "cm/s", "mm/s", "km/h"] = "m/s"
    axes: Literal["world", "body"] = "world"


@dataclass(frozen=True, config=STRICT)
class Attitude:
    """Of the vehicle in the world."""

    fields: Fields
    form: Literal["xyzw", "wxyz", "matrix", "roll pitch yaw"]
    """Order of a quaternion; a rotation matrix row by row; or angles about the axes x, y, z."""
    unit: Literal["rad", "deg"] = "rad"
    """Of angles."""
    turns: Literal["body to world", "world to body"] = "body to world"


@dataclass(frozen=True, config=STRICT)
class Thrust:
    """The command of collective thrust."""

    fields: Fields
    unit: Literal["m/s^2", "g", "N", "share"]
    """Mass-normalised; in newtons; or a share of the autopilot's own scale."""
    positive: Literal["up", "down"] = "up"
    mass: Positive | None = None
    """[kg], for newtons."""
    hover: Positive | str | None = None
    """For a share: the share at hover, or the field that holds it; by default it is found from the flight."""

    @property
    def scale(self) -> float | None:
        """Mass-normalised thrust of one unit [m/s^2]; None for a share, which the flight or ``hover`` tells."""
        return {"m/s^2": 1.0, "g": ACCELERATIONS["g"], "N": 1.0 / (self.mass or 1.0)}.get(self.unit)

    @model_validator(mode="after")
    def _complete(self) -> "Thrust":
        if (self.unit == "N") != (self.mass is not None):
            raise ValueError('mass [kg] goes with unit = "N", and only with it')
        if self.hover is not None and self.unit != "share":
            raise ValueError('hover goes with unit = "share"')
        return self


@dataclass(frozen=True, config=STRICT)
class BodyRates:
    """Commanded or measured."""

    fields: Fields
    unit: Literal["rad/s", "deg/s"] = "rad/s"


@dataclass(frozen=True, config=STRICT)
class Acceleration:
    """Measured acceleration; by default it is the derivative of the velocity."""

    fields: Fields
    unit: Literal["m/s^2", "g"] = "m/s^2"
    axes: Literal["world", "body"] = "body"
    gravity: Literal["felt", "removed"] = "felt"
    """Felt, as by an accelerometer, which shows one g upwards at rest; or removed, the derivative of the velocity."""


@dataclass(frozen=True, config=STRICT)
class Frames:
    """Axes of the log."""

    world: Literal["ENU", "NED"] = "ENU"
    """z upwards, or z downwards; which way x points does not matter."""
    body: Literal["FLU", "FRD"] = "FLU"
    """Forward, left, up; or forward, right, down."""


@dataclass(frozen=True, config=STRICT)
class Part:
    """Which part of the log is used [s] since its beginning."""

    start: float = 0.0
    end: float | None = None


@dataclass(frozen=True, config=STRICT)
class LogMap:
    """Which field of a log is what."""

    position: Position
    velocity: Velocity
    attitude: Attitude
    thrust: Thrust
    rates: BodyRates | None = None
    """Commanded body rates."""
    measured_rates: BodyRates | None = None
    """From a gyroscope; by default they follow from the attitudes."""
    acceleration: Acceleration | None = None
    time: Time | None = None
    frames: Frames = Frames()
    part: Part = Part()

    @model_validator(mode="after")
    def _fitting(self) -> "LogMap":
        if self.part.end is not None and self.part.end <= self.part.start:
            raise ValueError(f"part.end = {self.part.end} s must be after part.start = {self.part.start} s")
        return self


KNOWN: dict[str, dict[str, object]] = {
    "retrim-csv": {
        "time": {"field": "t", "age": "age"},
        "position": {"fields": ["x0", "x1", "x2"]},
        "velocity": {"fields": ["x12", "x13", "x14"]},
        "attitude": {"fields": [f"x{i}" for i in range(3, 12)], "form": "matrix"},
        "thrust": {"fields": ["c"], "unit": "m/s^2"},
        "rates": {"fields": ["omega0", "omega1", "omega2"]},
    },
    "retrim-npz": {
        "time": {"field": "t", "age": "age"},
        "position": {"fields": ["p_measured"]},
        "velocity": {"fields": ["v_measured"]},
        "attitude": {"fields": ["R_measured"], "form": "matrix"},
        "thrust": {"fields": ["u[0]"], "unit": "m/s^2"},
        "rates": {"fields": ["u[1:4]"]},
    },
    "retrim-mcap": {
        "position": {"fields": ["/measured/pose.pose.position"]},
        "velocity": {"fields": ["/measured/velocity.twist.linear"]},
        "attitude": {"fields": ["/measured/pose.pose.orientation"], "form": "xyzw"},
        "thrust": {"fields": ["/command.twist.linear.z"], "unit": "m/s^2"},
        "rates": {"fields": ["/command.twist.angular"]},
    },
    "px4": {
        "position": {"fields": [f"vehicle_local_position.{axis}" for axis in "xyz"]},
        "velocity": {"fields": [f"vehicle_local_position.v{axis}" for axis in "xyz"]},
        "attitude": {"fields": ["vehicle_attitude.q"], "form": "wxyz"},
        "thrust": {"fields": ["vehicle_rates_setpoint.thrust_body[2]"], "unit": "share", "positive": "down"},
        "rates": {"fields": [f"vehicle_rates_setpoint.{axis}" for axis in ("roll", "pitch", "yaw")]},
        "measured_rates": {"fields": ["vehicle_angular_velocity.xyz"]},
        "frames": {"world": "NED", "body": "FRD"},
    },
    "mavros": {
        "position": {"fields": ["/mavros/local_position/odom.pose.pose.position"]},
        "velocity": {"fields": ["/mavros/local_position/odom.twist.twist.linear"], "axes": "body"},
        "attitude": {"fields": ["/mavros/local_position/odom.pose.pose.orientation"], "form": "xyzw"},
        "thrust": {"fields": ["/mavros/setpoint_raw/attitude.thrust"], "unit": "share"},
        "rates": {"fields": ["/mavros/setpoint_raw/attitude.body_rate"]},
        "measured_rates": {"fields": ["/mavros/local_position/odom.twist.twist.angular"]},
    },
}
"""Maps by name: of what retrim and usual autopilots write."""


def read_map(source: str | Path) -> LogMap:
    """Return a map by name, or from a TOML file.

    Raises:
        ConfigError: The file cannot be read, or a value is missing, unknown or impossible.
    """
    if str(source) in KNOWN:
        return validated(LogMap, KNOWN[str(source)], source=f"map {source}")
    return validated(LogMap, read_toml(Path(source)), source=str(source))
