"""A flight in a log without attitudes and velocities."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class BodyLog:
    """A flight on one clock, in forward-left-up body axes."""

    t: np.ndarray
    """Times from the beginning [s], (n,), one tick apart."""
    motors: np.ndarray
    """Commands as shares of the full command, one column for all motors or one for each, (n, motors)."""
    rates: np.ndarray
    """Measured body rates, mean over a tick [rad/s], (n, 3)."""
    command: np.ndarray | None
    """Commanded body rates [rad/s], (n, 3); None if the log does not contain them."""
    specific_force: np.ndarray | None
    """Specific force [m/s^2], (n, 3); None if the log does not contain it."""
    valid: np.ndarray
    """Ticks at which the vehicle flies and all quantities are known, (n,)."""
    dt: float
    """Tick [s]."""
    curve: float | None
    """Thrust (1 - curve) s + curve s^2 of a command s, if the map states it."""
    filter_lag: float
    """Lag of two equal poles through which the specific force was measured [s]; 0 without a filter."""
    notes: tuple[str, ...]
    agreement: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Length of the flight without the excluded parts [s]."""
        return float(np.sum(self.valid) * self.dt)
