"""Settings of a Betaflight board that determine what its sticks mean, and the sticks for a thrust and body rates."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ...errors import MessageError, PlantError
from ...physics.state import STANDARD_GRAVITY
from ...physics.vehicle import Vehicle
from . import msp

REQUIRED_ANSWERS = {
    msp.API_VERSION: "API_VERSION", msp.FC_VARIANT: "FC_VARIANT", msp.FC_VERSION: "FC_VERSION",
    msp.BOX_IDS: "BOXIDS", msp.MODE_RANGES: "MODE_RANGES", msp.RX_CONFIG: "RX_CONFIG", msp.RX_MAP: "RX_MAP",
    msp.RC_TUNING: "RC_TUNING", msp.RC_DEADBAND: "RC_DEADBAND", msp.ADVANCED_CONFIG: "ADVANCED_CONFIG",
}  # fmt: skip
"""Requests whose answers describe a board."""
CENTRE, SPAN, LOW, HIGH = 1500, 500, 1000, 2000  # [us]
ROLL, PITCH, YAW, THROTTLE = range(4)  # order of the sticks in the firmware
SIGNS = np.array([1.0, 1.0, -1.0])  # roll, pitch and yaw sticks, from forward-left-up body rates
RATE_UNIT = 10.0  # [deg/s] of a rate setting
HOVER_RANGE = 0.05, 0.85  # throttle at hover that is plausible
TABLE = 201


@dataclass(frozen=True)
class Board:
    """What a board reports about its settings."""

    boxes: tuple[int, ...]
    """Permanent numbers of the modes, in the order of the flags."""
    ranges: tuple[msp.ModeRange, ...]
    """Switches of the modes."""
    order: tuple[int, ...]
    """Receiver channel of roll, pitch, yaw and throttle."""
    lowest: int
    """Stick position at which the throttle begins [us]."""
    idle: float
    """Motor command at zero throttle, as a share."""
    rates: tuple[tuple[float, float, float], ...]
    """For roll, pitch and yaw: rate per full stick at the centre [rad/s], largest rate [rad/s], and expo."""

    @classmethod
    def of(cls, answers: Mapping[int, bytes]) -> "Board":
        """Read the answers to the requests in ``REQUIRED_ANSWERS``.

        Raises:
            PlantError: The firmware is another one, or a setting makes the sticks ambiguous; the error names the
                command that changes it.
        """
        try:
            return cls._of(answers)
        except MessageError as error:
            raise PlantError(f"the board's answers are incomplete: {error}") from error

    @classmethod
    def _of(cls, answers: Mapping[int, bytes]) -> "Board":
        variant = answers[msp.FC_VARIANT][:4].decode("ascii", "replace")
        if variant != "BTFL":
            raise PlantError(f"the board's firmware is {variant!r}, and the link is for Betaflight (BTFL)")
        tuning, deadband = answers[msp.RC_TUNING], answers[msp.RC_DEADBAND]
        wrong = {
            f"rates_type is number {msp.byte_at(tuning, 22)}: set rates_type = ACTUAL":
                msp.byte_at(tuning, 22) != msp.ACTUAL_RATES,
            "the throttle has an expo: set thr_expo = 0": msp.byte_at(tuning, 7) != 0,
            "the throttle is limited: set throttle_limit_type = OFF": msp.byte_at(tuning, 14) != 0,
            "the sticks have a deadband: set deadband = 0, set yaw_deadband = 0":
                msp.byte_at(deadband, 0) != 0 or msp.byte_at(deadband, 1) != 0,
        }  # fmt: skip
        if faults := [text for text, is_wrong in wrong.items() if is_wrong]:
            raise PlantError(f"the board's settings do not suit a companion computer; {'; '.join(faults)}; then save")
        boxes = tuple(answers[msp.BOX_IDS])
        if msp.OVERRIDE not in boxes:
            raise PlantError(
                "the board does not offer MSP OVERRIDE: set msp_override_channels_mask = 15, put the mode on a switch "
                "of the pilot, then save"
            )
        return cls(
            boxes, tuple(msp.mode_ranges(answers[msp.MODE_RANGES])),
            _order(answers[msp.RX_MAP]), msp.word_at(answers[msp.RX_CONFIG], 5),
            1e-4 * msp.word_at(answers[msp.ADVANCED_CONFIG], 6), _rates(tuning),
        )  # fmt: skip

    @property
    def level_channel(self) -> msp.ModeRange | None:
        """Range of ANGLE mode on a channel of its own, by which the companion can level the vehicle; None without."""
        occupied = {each.channel for each in self.ranges if each.mode != msp.ANGLE}
        return next((each for each in self.ranges if each.mode == msp.ANGLE and each.channel not in occupied), None)

    def fastest(self) -> np.ndarray:
        """Return the body rates at full stick [rad/s]."""
        return np.array([rate_of(1.0, *each) for each in self.rates])

    def channels(self, throttle: float, omega: np.ndarray, *, level: bool = False) -> list[int]:
        """Return the receiver channels [us].

        Args:
            throttle: Throttle, 0 to 1.
            omega: Body rates, forward-left-up [rad/s].
            level: Whether the board levels the vehicle by its own attitude, if ANGLE mode has a channel of its own.
        """
        sticks = [CENTRE + SPAN * stick_of(rate, *each) for rate, each in zip(SIGNS * omega, self.rates, strict=True)]
        up = self.lowest + (HIGH - self.lowest) * float(np.clip(throttle, 0.0, 1.0))
        channels = [CENTRE] * 4
        for axis, value in enumerate([*sticks, up if throttle > 0.0 else LOW]):
            channels[self.order[axis]] = round(float(np.clip(value, LOW, HIGH)))
        if (switch := self.level_channel) is not None:
            channels += [LOW] * (switch.channel + 1 - len(channels))
            channels[switch.channel] = _within(switch) if level else _beside(switch)
        return channels

    def throttle_at(self, channels: list[int]) -> float:
        """Return the throttle, 0 to 1, of receiver channels in the firmware's order [us]."""
        return float(np.clip((channels[THROTTLE] - self.lowest) / (HIGH - self.lowest), 0.0, 1.0))


def rate_of(stick: float, centre: float, largest: float, expo: float) -> float:
    """Return the rate for a stick from -1 to 1 on the curve ACTUAL [rad/s]."""
    size = abs(stick)
    bend = size * (size**5 * expo + size * (1.0 - expo))
    return float(stick * centre + np.sign(stick) * max(0.0, largest - centre) * bend)


def stick_of(rate: float, centre: float, largest: float, expo: float) -> float:
    """Return the stick from -1 to 1 for a rate [rad/s]; the inverse of :func:`rate_of` up to full stick."""
    sticks = np.linspace(0.0, 1.0, TABLE)
    return float(np.sign(rate) * np.interp(abs(rate), [rate_of(s, centre, largest, expo) for s in sticks], sticks))


class ThrustCurve:
    """The throttle for a thrust per mass: the vehicle's curve from motor command to thrust, scaled to the hover."""

    def __init__(self, vehicle: Vehicle, idle: float) -> None:
        """Tabulate a curve; it is not scaled until a hover is known.

        Args:
            vehicle: Vehicle whose motors determine the shape of the curve.
            idle: Motor command at zero throttle, as a share.
        """
        self._throttles = np.linspace(0.0, 1.0, TABLE)
        motors = jnp.asarray(idle + (1.0 - idle) * self._throttles, jnp.result_type(float))
        speeds = np.asarray(vehicle.esc.speed(motors), dtype=float)
        self._thrusts = np.square(np.maximum(speeds, 0.0))
        self.hover: float | None = None
        """Throttle at hover; None until it is known."""

    def learn(self, throttles: list[float]) -> None:
        """Scale the curve.

        Args:
            throttles: Throttles while the vehicle hovers.

        Raises:
            PlantError: They cannot come from a hovering vehicle.
        """
        if len(throttles) < 5 or not HOVER_RANGE[0] < np.median(throttles) < HOVER_RANGE[1]:
            raise PlantError(
                f"the throttle at hover is not known: {np.round(throttles[-5:], 2).tolist()}; hover between "
                f"{HOVER_RANGE[0]:g} and {HOVER_RANGE[1]:g} of the throttle"
            )
        self.hover = float(np.mean(throttles))

    def throttle(self, c: float) -> float:
        """Return the throttle for a thrust per mass [m/s^2]."""
        return float(np.interp(c, self._per_mass(), self._throttles))

    def per_mass(self, throttle: float) -> float:
        """Return the thrust per mass for a throttle [m/s^2]."""
        return float(np.interp(throttle, self._throttles, self._per_mass()))

    def _per_mass(self) -> np.ndarray:
        if self.hover is None:
            raise PlantError("the throttle at hover is not known before the vehicle hovers")
        at_hover = float(np.interp(self.hover, self._throttles, self._thrusts))
        result: np.ndarray = self._thrusts * (STANDARD_GRAVITY / at_hover)
        return result


def _order(row: bytes) -> tuple[int, ...]:
    order = tuple(row[:4])
    if sorted(order) != [0, 1, 2, 3]:
        raise MessageError(f"the receiver's map is {list(order)}")
    return order


def _rates(tuning: bytes) -> tuple[tuple[float, float, float], ...]:
    at: Callable[[int], int] = lambda place: msp.byte_at(tuning, place)  # noqa: E731
    unit = np.deg2rad(RATE_UNIT)
    centres, largest, expos = (at(0), at(12), at(11)), (at(2), at(3), at(4)), (at(1), at(13), at(10))
    return tuple((unit * c, unit * max(c, m), 0.01 * e) for c, m, e in zip(centres, largest, expos, strict=True))


def _within(switch: msp.ModeRange) -> int:
    return int(np.clip((switch.low + switch.high) // 2, LOW, HIGH))


def _beside(switch: msp.ModeRange) -> int:
    return LOW if switch.low > LOW + msp.STEP else HIGH
