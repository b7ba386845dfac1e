"""Maps a log's fields to quantities, units and frames, using a small TOML file.

A field may have a sign, for example ``-pitch``. It may have alternatives, for example
``stabilizer.thrust|controller.cmd_thrust``; the first one in the log is used.
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from .axes import check_body, check_world, left_handed

STRICT = ConfigDict(extra="forbid")


def check_flag(name: str) -> str:
    """Return a flag if it is valid: the name of a field that is non-zero when set, or ``field==number``."""
    _, sign, number = name.partition("==")
    if sign:
        try:
            float(number)
        except ValueError as error:
            raise ValueError(f"{number[:20]!r} is not a number; a flag is a field, or field==number") from error
    return name


Name = Annotated[str, Field(min_length=1, max_length=200)]
Fields = Annotated[tuple[Name, ...], Field(min_length=1, max_length=9)]
Flag = Annotated[Name, AfterValidator(check_flag)]
Flags = Annotated[tuple[Flag, ...], Field(max_length=9)]
World = Annotated[str, AfterValidator(check_world)]
Body = Annotated[str, AfterValidator(check_body)]
Seconds = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Share = Annotated[float, Field(ge=0, le=1, strict=True)]
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
SPEEDS = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6}
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295}
RATES = {"rad/s": 1.0, "deg/s": 0.017453292519943295, "mrad/s": 1e-3}
ACCELERATIONS = {"m/s^2": 1.0, "g": 9.80665}


@dataclass(frozen=True, config=STRICT)
class Time:
    """Time field of CSV and NPZ files; in ULogs and bags, the time field of each topic that contains it."""

    field: Name
    unit: Literal["s", "ms", "us", "ns"] = "s"
    age: str | None = None
    """Field with the age of the position, velocity and attitude at that time, in the same unit."""


@dataclass(frozen=True, config=STRICT)
class Position:
    """The vehicle's position in the world."""

    fields: Fields
    unit: Literal["m", "cm", "mm"] = "m"
    valid: Flags = ()
    """Fields that are non-zero while the samples are valid, if the log contains them."""
    resets: Flags = ()
    """Counters that change when the estimator resets, if the log contains them."""


@dataclass(frozen=True, config=STRICT)
class Velocity:
    """The vehicle's velocity."""

    fields: Fields
    unit: Literal["m/s", "cm/s", "mm/s", "km/h"] = "m/s"
    axes: Literal["world", "body"] = "world"
    valid: Flags = ()
    resets: Flags = ()


@dataclass(frozen=True, config=STRICT)
class Attitude:
    """The vehicle's attitude in the world."""

    fields: Fields
    form: Literal["xyzw", "wxyz", "matrix", "roll pitch yaw", "rotation vector"]
    """Quaternion order, a rotation matrix (row by row), angles about the x, y and z axes, or an axis times an angle."""
    unit: Literal["rad", "deg"] = "rad"
    """Unit of angles."""
    turns: Literal["body to world", "world to body"] = "body to world"
    world: World | None = None
    """World axes to which the attitude refers, if they differ from those in [frames]."""
    body: Body | None = None
    heading: Annotated[float, Field(ge=-360.0, le=360.0, strict=True)] = 0.0
    """Rotation about the vertical that aligns the attitudes with the positions, counter-clockwise from above [deg]."""
    valid: Flags = ()
    resets: Flags = ()


@dataclass(frozen=True, config=STRICT)
class Thrust:
    """The commanded collective thrust."""

    fields: Fields
    """One field, or one for each motor: their mean is used, or their sum for the unit N."""
    unit: Literal["m/s^2", "g", "N", "share"]
    """m/s^2 or g for a mass-normalised thrust, N for newtons, or a share on the autopilot's own scale."""
    positive: Literal["up", "down"] = "up"
    mass: Positive | None = None
    """Mass [kg], for the unit N."""
    hover: Positive | Name | None = None
    """For a share: the value at hover, or the field that contains it; by default it is estimated from the flight."""
    full: Positive = 1.0
    """For a share: the number that means full thrust, for example 65535."""
    zero: NotNegative = 0.0
    """For a share: the number that means no thrust, for example 1000 for a pulse width in us."""
    curve: Share = 0.0
    """For a share s: the thrust is (1 - curve) s + curve s^2; 0 for a thrust, about 0.6 to 1 for a motor command."""

    @property
    def scale(self) -> float | None:
        """Mass-normalised thrust of one unit [m/s^2]; None for a share, scaled by the flight or ``hover``."""
        return {"m/s^2": 1.0, "g": ACCELERATIONS["g"], "N": 1.0 / (self.mass or 1.0)}.get(self.unit)

    @property
    def sign(self) -> float:
        """One for a thrust that is positive upwards, minus one otherwise."""
        return 1.0 if self.positive == "up" else -1.0

    @model_validator(mode="after")
    def _complete(self) -> "Thrust":
        if (self.unit == "N") != (self.mass is not None):
            raise ValueError('mass [kg] goes with unit = "N", and only with it')
        if self.hover is not None and self.unit != "share":
            raise ValueError('hover goes with unit = "share"')
        for name, default in (("full", 1.0), ("zero", 0.0), ("curve", 0.0)):
            if getattr(self, name) != default and self.unit != "share":
                raise ValueError(f'{name} goes with unit = "share"')
        if self.zero >= self.full:
            raise ValueError(f"zero = {self.zero:g} must be less than full = {self.full:g}")
        return self


@dataclass(frozen=True, config=STRICT)
class BodyRates:
    """Commanded or measured body rates."""

    fields: Fields
    unit: Literal["rad/s", "deg/s", "mrad/s"] = "rad/s"
    optional: bool = False
    """Whether a log without these fields may still be read."""


@dataclass(frozen=True, config=STRICT)
class Acceleration:
    """Measured acceleration; by default it is the derivative of the velocity."""

    fields: Fields
    unit: Literal["m/s^2", "g"] = "m/s^2"
    axes: Literal["world", "body"] = "body"
    gravity: Literal["included", "removed"] = "included"
    """included: specific force of an accelerometer, one g upwards at rest; removed: derivative of the velocity."""
    optional: bool = False


@dataclass(frozen=True, config=STRICT)
class LandDetector:
    """Fields that are non-zero while the vehicle is on the ground, if the log contains them."""

    fields: Flags


@dataclass(frozen=True, config=STRICT)
class Frames:
    """The log's world and body axes; three letters give the directions of x, y and z."""

    world: World = "ENU"
    """ENU (east, north, up), NED, NWU, or for example EUS if y points up; the direction of north is arbitrary."""
    body: Body = "FLU"
    """FLU (forward, left, up), FRD (forward, right, down), RFU, and so on."""

    @model_validator(mode="after")
    def _both(self) -> "Frames":
        if left_handed(self.world) != left_handed(self.body):
            raise ValueError(f"world = {self.world!r} and body = {self.body!r} must both be right-handed, or both left")
        return self


@dataclass(frozen=True, config=STRICT)
class Part:
    """The part of the log to use; times count from the beginning of the log [s]."""

    start: Seconds = 0.0
    end: Seconds | None = None


@dataclass(frozen=True, config=STRICT)
class LogMap:
    """A map from a log's fields to quantities."""

    attitude: Attitude
    thrust: Thrust
    position: Position | None = None
    """Without this table, positions are integrated from the velocities."""
    velocity: Velocity | None = None
    """Without this table, velocities are the smoothed derivatives of the positions."""
    rates: BodyRates | None = None
    """Commanded body rates."""
    measured_rates: BodyRates | None = None
    """Gyroscope rates; by default they are derived from the attitudes."""
    acceleration: Acceleration | None = None
    landed: LandDetector | None = None
    time: Time | None = None
    frames: Frames = Frames()
    part: Part = Part()

    @model_validator(mode="after")
    def _fitting(self) -> "LogMap":
        if self.part.end is not None and self.part.end <= self.part.start:
            raise ValueError(f"part.end = {self.part.end} s must be after part.start = {self.part.start} s")
        if self.position is None and self.velocity is None:
            raise ValueError("[position], [velocity] or both must be there")
        world, body = self.attitude.world or self.frames.world, self.attitude.body or self.frames.body
        if left_handed(world) != left_handed(body):
            raise ValueError(f"attitude: world = {world!r} and body = {body!r} must both be right-handed, or both left")
        return self
