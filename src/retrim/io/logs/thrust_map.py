"""Converts a log's thrust to mass-normalised thrust, and determines the acceleration at full thrust."""

from pathlib import Path

import numpy as np

from ...errors import LogError
from ...physics.state import STANDARD_GRAVITY
from .collective import number_of, share_of
from .log_map import Thrust
from .on_one_clock import UP, Ticks

LEAST = 1e-9  # thrust share below which a number is not a command


def normalise_thrust(
    path: Path, spec: Thrust, ticks: Ticks, valid: np.ndarray
) -> tuple[np.ndarray, float | None, list[str]]:
    """Return the thrust [m/s^2], the acceleration at full thrust if the log's thrust is a share, and notes.

    Raises:
        LogError: The thrust is zero throughout, acts against the acceleration, or is not positive at hover.
    """
    if spec.scale is not None:
        return spec.scale * ticks.thrust, None, []
    if spec.hover is None:
        specific_force = ticks.a[valid] + UP
        along, share = np.sum(specific_force * ticks.R[valid, :, 2], axis=1), ticks.thrust[valid]
        largest = float(np.max(share))
        if largest < LEAST:
            raise LogError(
                f"{path}: thrust is {largest:.3g} at most; thrust.fields must name the command that is in use"
            )
        full = float(np.sum(share * along) / np.sum(share**2))
        if full <= 0.0:
            raise LogError(f"{path}: more thrust gives less acceleration along its axis; is it the right field?")
        hover = number_of(spec, STANDARD_GRAVITY / full)
        number = f"{hover:.3f}" if spec.full == 1.0 else f"{hover:.5g}"
        return full * ticks.thrust, full, [f"thrust map found from the flight: hover at {number}"]
    hovers = ticks.hover if ticks.hover is not None else share_of(spec, np.full(len(ticks.t), float(spec.hover)))
    if not np.all(hovers[valid] > 0.01):
        raise LogError(f"{path}: thrust at hover, {spec.hover!r}, is not positive all the time")
    return STANDARD_GRAVITY * ticks.thrust / hovers, float(STANDARD_GRAVITY / np.median(hovers[valid])), []
