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
from .rollback import FlownError
from .topics import REFERENCE, UNLEARNED, VEHICLE

AHEAD = 1.0  # [s], how far the time stamp of parameters may lie in the future
IN_TIME = 0.7  # [s], time limit to take a new reference, before it departs from the current one
REMEMBERED = 50  # number of past swaps, rollbacks and policies that are kept


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
        self.refused: dict[str, int] = {}
        self.given_up: list[int] = []
        self.newest = dict.fromkeys(pilot.versions, 0)
        self.swaps: deque[list[Any]] = deque(maxlen=REMEMBERED)
        self._bus, self._base = bus, base
        self._known = dict.fromkeys(pilot.versions, 0)
        self._dt, self._flown, self._open = dt, FlownError(dt), True
        self._computed_from = {0: 0.0}

    @property
    def learnt(self) -> float:
        """Flight time of the newest measurement in the training data of the active policy [s]."""
        return self._computed_from.get(self.pilot.versions.get("policy", 0), 0.0)

    @property
    def open(self) -> bool:
        """Whether the learned parameters are in use; if not, the controller uses the parameters from take-off."""
        return self._open

    @open.setter
    def open(self, learnt: bool) -> None:
        if learnt == self._open:
            return
        self._open, self._flown = learnt, FlownError(self._dt)
        if learnt:
            self.pilot.resume()
        else:
            self.pilot.restart()

    def poll(self, t: float) -> None:
        """Read the parameters that have arrived by flight time ``t`` [s]; use valid ones and refuse the others."""
        for half in self._known:
            if half not in UNLEARNED and not self._open:
                continue
            message = self._bus.latest(f"parameters.{half}", self._known[half])
            if message is None:
                continue
            self._known[half] = message.version
            try:
                result = Parameters.unpack(
                    message.data, self.pilot.expected(half), half=half, base=self._base, after=self.newest[half]
                )
            except StaleError:
                self.refuse(f"stale {half}")
            except MessageError:
                self.refuse(half)
            else:
                if result.computed_from > t + AHEAD:
                    self.refuse(f"{half} of a time to come")
                elif half == REFERENCE and t > result.computed_from + IN_TIME:
                    self.refuse("late reference")
                else:
                    self._take(result, t)

    def watch(self, error: float, missed: float) -> None:
        """Process the result of one tick of the policy, and roll back policies that fly clearly worse.

        Args:
            error: Distance from the target [m].
            missed: Acceleration error of the corrected model [m/s^2].
        """
        result = self._flown.take(error, missed)
        if result.proven is not None:
            self.pilot.proven(result.proven)
        if result.worse:
            self.given_up = [*self.given_up, *self.pilot.back()][-REMEMBERED:]

    def refuse(self, what: str) -> None:
        """Count a message that must not be used."""
        self.refused[what] = self.refused.get(what, 0) + 1

    def _take(self, found: Parameters, t: float) -> None:
        self.newest[found.half] = found.version
        if found.half == "policy" and {found.parent, found.version} & set(self.given_up):
            self.given_up.append(found.version)
            self.refuse("trained from a policy that was taken back")
            return
        self.pilot.swap(found)
        if found.half == REFERENCE:
            self._flown = FlownError(self._dt)  # errors on different references are not comparable
            return
        if found.half == VEHICLE:
            return
        self.swaps.append([t, found.half, found.version, t - found.computed_from])
        if found.half == "policy":
            self._computed_from[found.version] = found.computed_from
            for old in sorted(self._computed_from)[1:-REMEMBERED]:
                del self._computed_from[old]
            self._flown.swapped(found.version)
