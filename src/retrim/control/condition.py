"""The condition of a controller that can step back from some of its functions, with a description in words."""

from enum import IntEnum

import equinox as eqx
from jaxtyping import Array, Int


class Stage(IntEnum):
    """Active parts of a flight."""

    ADAPTED = 0
    OBSERVED = 1
    SLOW = 2
    BASE = 3
    CAUTIOUS = 4


class Cause(IntEnum):
    """Reason for the last change of stage."""

    NONE = 0
    ERROR = 1
    OSCILLATION = 2
    RECOVERY = 3
    SWINGS = 4
    CALM = 5
    NO_GAIN = 6
    NO_EFFECT = 7


PARTS = {
    Stage.ADAPTED: "the flight uses all of its parts",
    Stage.OBSERVED: "the base policy flies with the disturbance observer",
    Stage.SLOW: "the base policy flies with a slow mean of the estimated disturbance",
    Stage.BASE: "the base policy flies alone",
    Stage.CAUTIOUS: "the policy assumes a slower vehicle",
}
GROUNDS = {
    Cause.NONE: "start of the flight",
    Cause.ERROR: "the error exceeds that predicted for the base policy",
    Cause.OSCILLATION: "the estimated disturbance oscillates by itself, as with late or wrongly scaled measurements",
    Cause.RECOVERY: "the error has been as small as predicted for the base policy",
    Cause.SWINGS: "the vehicle swings back and forth by itself, as with a wrong estimate of its delay or lag",
    Cause.NO_GAIN: "the error is as large under the base policy alone, as with a state estimate that wanders",
    Cause.CALM: "the vehicle has not swung by itself for a while",
    Cause.NO_EFFECT: "the vehicle swings as much if a slower vehicle is assumed, as with late measurements",
}


class Condition(eqx.Module):
    """Stage to which a controller has stepped back, and the cause."""

    stage: Int[Array, ""]
    cause: Int[Array, ""]

    def note(self) -> str:
        """Return the condition in words, for the log."""
        return describe_condition(int(self.stage), int(self.cause))


def describe_condition(stage: int, cause: int) -> str:
    """Return a stage and its cause in words."""
    return f"{PARTS[Stage(stage)]}: {GROUNDS[Cause(cause)]}"
