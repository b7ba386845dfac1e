"""Receive parameters from the learners.

The receiver passes valid parameters to the pilot, and refuses and counts invalid ones by reason. It rolls back policies
that fly clearly worse than the last proven one.
"""

from collections import deque
from typing import Any

from ..errors import MessageError
from ..transport.bus import Bus
from .messages import Parameters, StaleError
from .pilot import LivePilot
from .rollback import RollbackMonitor
from .topics import GIVEN_KINDS, REFERENCE, VEHICLE

CLOCK_TOLERANCE = 1.0  # [s], how far the time stamp of parameters may lie in the future
REFERENCE_TIME_LIMIT = 0.7  # [s], time limit to take a new reference, before it departs from the current one
HISTORY = 50  # number of past swaps, rollbacks and policies that are kept


class ParameterReceiver:
    """Receives new parameters for the active controller."""

    def __init__(self, pilot: LivePilot, bus: Bus, base: str, dt: float) -> None:
        """Build a receiver.

        Args:
            pilot: Pilot that receives the parameters.
            bus: Bus of the flight.
            base: Hash of the controller.
            dt: Control tick [s].
        """
        self.pilot = pilot
        self.refusals: dict[str, int] = {}
        self.withdrawals: list[int] = []
        self.newest = dict.fromkeys(pilot.versions, 0)
        self.swaps: deque[list[Any]] = deque(maxlen=HISTORY)
        self._bus, self._base = bus, base
        self._versions = dict.fromkeys(pilot.versions, 0)
        self._dt, self._trials, self._open = dt, RollbackMonitor(dt), True
        self._data_times = {0: 0.0}

    @property
    def data_time(self) -> float:
        """Flight time of the newest measurement in the training data of the active policy [s]."""
        return self._data_times.get(self.pilot.versions.get("policy", 0), 0.0)

    @property
    def open(self) -> bool:
        """Whether the learned parameters are in use; if not, the controller uses the parameters from take-off."""
        return self._open

    @open.setter
    def open(self, learning: bool) -> None:
        if learning == self._open:
            return
        self._open, self._trials = learning, RollbackMonitor(self._dt)
        if learning:
            self.pilot.resume()
        else:
            self.pilot.restart()

    def poll(self, t: float) -> None:
        """Read the parameters that have arrived by flight time ``t`` [s]; use valid ones and refuse the others."""
        for half in self._versions:
            if half not in GIVEN_KINDS and not self._open:
                continue
            message = self._bus.latest(f"parameters.{half}", self._versions[half])
            if message is None:
                continue
            self._versions[half] = message.version
            try:
                result = Parameters.unpack(
                    message.data, self.pilot.expected(half), half=half, base=self._base, after=self.newest[half]
                )
            except StaleError:
                self.refuse(f"stale {half}")
            except MessageError:
                self.refuse(half)
            else:
                if result.computed_from > t + CLOCK_TOLERANCE:
                    self.refuse(f"{half} of a time to come")
                elif half == REFERENCE and t > result.computed_from + REFERENCE_TIME_LIMIT:
                    self.refuse("late reference")
                else:
                    self._take(result, t)

    def watch(self, error: float, model_error: float) -> None:
        """Process the result of one tick of the policy, and roll back policies that fly clearly worse.

        Args:
            error: Distance from the target [m].
            model_error: Acceleration error of the corrected model [m/s^2].
        """
        result = self._trials.take(error, model_error)
        if result.confirmed_version is not None:
            self.pilot.confirm(result.confirmed_version)
        if result.worse:
            self.withdrawals = [*self.withdrawals, *self.pilot.back()][-HISTORY:]

    def refuse(self, what: str) -> None:
        """Count a message that must not be used."""
        self.refusals[what] = self.refusals.get(what, 0) + 1

    def _take(self, parameters: Parameters, t: float) -> None:
        self.newest[parameters.half] = parameters.version
        if parameters.half == "policy" and {parameters.parent, parameters.version} & set(self.withdrawals):
            self.withdrawals.append(parameters.version)
            self.refuse("trained from a policy that was rolled back")
            return
        self.pilot.swap(parameters)
        if parameters.half == REFERENCE:
            self._trials = RollbackMonitor(self._dt)  # errors on different references are not comparable
            return
        if parameters.half == VEHICLE:
            return
        self.swaps.append([t, parameters.half, parameters.version, t - parameters.computed_from])
        if parameters.half == "policy":
            self._data_times[parameters.version] = parameters.computed_from
            for old in sorted(self._data_times)[1:-HISTORY]:
                del self._data_times[old]
            self._trials.start_trial(parameters.version)
