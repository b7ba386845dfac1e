"""Detect a flight's hanging processes, which are alive but do not send heartbeats."""

import contextlib
import time
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType

from ..errors import MessageError
from ..transport.bus import Bus
from .heartbeat import beat_topic
from .messages import Setpoint

SILENCE = 2.0  # [s] without a heartbeat, after which a process counts as hanging
LOOK = 0.25  # [s], longest silence that one check adds, since a stall of the machine is not silence of the process
NO_ALLOWANCES: Mapping[str, float] = MappingProxyType({})


class Pulses:
    """Measures how long each process has been silent. Each check updates the durations."""

    def __init__(self, bus: Bus, clock: Callable[[], float] = time.monotonic, silence: float = SILENCE) -> None:
        """Begin without processes.

        Args:
            bus: Bus of the flight.
            clock: Function that returns the time [s].
            silence: Time without a heartbeat after which a process counts as hanging [s].
        """
        self._bus, self._clock, self._last, self._silence = bus, clock, clock(), silence
        self._versions, self._silent, self._allowances = dict[str, int](), dict[str, float](), dict[str, float]()

    def expect(self, role: str, within: float | None = None) -> None:
        """Expect a process to send heartbeats from now on.

        Args:
            role: Role of the process.
            within: Time limit for the first heartbeat [s], which may include compilation; None for the limit of later
                heartbeats.
        """
        self._versions[role], self._silent[role] = self._version(role), 0.0
        self._allowances[role] = self._silence if within is None else within

    def hanging(self, roles: Iterable[str], allowances: Mapping[str, float] = NO_ALLOWANCES) -> list[str]:
        """Return the processes that have been silent for too long.

        Args:
            roles: Processes that are alive. Other processes and those without expected heartbeats are not checked.
            allowances: Longer time limits for some of the roles, at this check [s].
        """
        now = self._clock()
        elapsed, self._last = min(now - self._last, LOOK), now
        return [role for role in roles if role in self._versions and self._hangs(role, elapsed, allowances)]

    def _hangs(self, role: str, elapsed: float, allowances: Mapping[str, float]) -> bool:
        if self._version(role) != self._versions[role]:
            self.expect(role)
            return False
        self._silent[role] += elapsed
        return self._silent[role] > max(self._allowances[role], allowances.get(role, 0.0))

    def _version(self, role: str) -> int:
        message = self._bus.latest(beat_topic(role))
        return 0 if message is None else message.version


def is_last_command(bus: Bus) -> bool:
    """Return whether control or the watchdog has published the last command of the flight.

    After it, the process of the plant publishes no samples, although its autopilot may need seconds for the landing.
    """
    for message in map(bus.latest, ("setpoint", "fallback")):
        with contextlib.suppress(MessageError):
            if message is not None and Setpoint.unpack(message.data).is_final:
                return True
    return False
