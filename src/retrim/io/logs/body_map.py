"""Maps the fields of a log without attitudes and velocities, for example one of a rate controller alone."""

from typing import Literal

from pydantic import model_validator
from pydantic.dataclasses import dataclass

from .log_map import STRICT, Acceleration, BodyRates, Frames, LandDetector, Part, Thrust, Time

STATES = ("position", "velocity", "attitude")


@dataclass(frozen=True, config=STRICT)
class BodyMap:
    """A map from a log's fields to commands and to the measurements of a gyroscope and an accelerometer."""

    thrust: Thrust
    measured_rates: BodyRates
    """Gyroscope rates."""
    rates: BodyRates | None = None
    """Commanded body rates; without them, only the thrust is identified."""
    acceleration: Acceleration | None = None
    """Specific force in body axes; without it, the thrust is not identified."""
    landed: LandDetector | None = None
    time: Time | None = None
    frames: Frames = Frames()
    """Only the body axes are used."""
    part: Part = Part()
    decoder: Literal["none", "blackbox"] = "none"
    """``blackbox`` for the numbers of blackbox_decode, which are in the units of the board."""

    @model_validator(mode="after")
    def _fitting(self) -> "BodyMap":
        if self.acceleration is not None and (self.acceleration.axes, self.acceleration.gravity) != (
            "body",
            "included",
        ):
            raise ValueError('without [attitude], acceleration needs axes = "body" and gravity = "included"')
        if self.thrust.unit != "share" or self.thrust.hover is not None:
            raise ValueError('without [attitude], thrust needs unit = "share" and no hover, which is identified')
        return self


def is_body_map(tables: dict[str, object]) -> bool:
    """Return whether the tables of a map contain measured rates and no state."""
    return "measured_rates" in tables and not any(name in tables for name in STATES)
