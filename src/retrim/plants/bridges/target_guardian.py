"""A guardian for links that publish targets in ROS: its packets pass through a node in a process of its own."""

import contextlib
import math
import os
import select
import subprocess
import sys
from collections.abc import Sequence

from ...errors import PlantError
from .guardian import Guardian, Phase, SafeCommands

PERIOD_S = 0.05  # [s] between two targets; they may be few, because a stack that needs the guardian holds the last one
VALIDITY_S = 0.5  # [s]
RATES_IGNORED = 7  # type_mask of an AttitudeTarget: ignore the body rates
# Share of the thrust at hover if it was identified, and if it comes from the vehicle file: a level vehicle sinks.
SINK_THRUST, SINK_THRUST_FROM_FILE = 0.95, 0.9
END_S = 2.0  # [s], longest wait for the end of a process


class TargetGuardian:
    """The node and its guardian. Both have their own session, so they do not end with the link."""

    def __init__(self, program: str, words: Sequence[str]) -> None:
        """Start the node.

        Args:
            program: Module with a function ``main`` that publishes the messages of its standard input.
            words: Arguments of the program.

        Raises:
            PlantError: The process cannot be started.
        """
        paths = os.pathsep.join(place for place in sys.path if place)
        try:
            self._node = subprocess.Popen(
                [sys.executable, "-P", "-c", f"from {program} import main; main()", *words],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                start_new_session=True, env=os.environ | {"PYTHONPATH": paths},
            )  # fmt: skip
        except OSError as error:
            raise PlantError(f"the node of the guardian cannot be started: {error}") from error
        self._guardian: Guardian | None = None

    def is_ready(self) -> bool:
        """Return whether the node is in the network.

        Raises:
            PlantError: The node has ended.
        """
        if self._node.poll() is not None:
            raise PlantError(f"the node of the guardian has ended with code {self._node.returncode}")
        assert self._node.stdout is not None
        return bool(select.select([self._node.stdout], [], [], 0.0)[0])

    def guard(self, target: bytes) -> None:
        """Begin to guard a link; the guardian waits for its first command.

        Args:
            target: The serialised message that is published if the link ends or is silent.
        """
        assert self._node.stdin is not None
        self.release()
        commands = SafeCommands((Phase((frame(target),), PERIOD_S, VALIDITY_S),))
        self._guardian = Guardian(commands, self._node.stdin.fileno())

    def feed(self) -> None:
        """Report a command of the link."""
        if self._guardian is not None:
            self._guardian.feed()

    def release(self) -> None:
        """Stop to guard the link without a target."""
        if self._guardian is not None:
            self._guardian.release()
            self._guardian = None

    def close(self) -> None:
        """Publish the target if there was a command, because a stack may hold the last one; then leave the network."""
        if self._guardian is not None:
            self._guardian.leave()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._guardian.process.wait(END_S)
            self._guardian = None
        assert self._node.stdin is not None
        assert self._node.stdout is not None
        with contextlib.suppress(OSError):
            self._node.stdin.close()
        self._node.stdout.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._node.wait(END_S)


def level(yaw: float) -> tuple[float, float]:
    """Return z and w of the quaternion of a level attitude with a heading [rad]; x and y are zero."""
    return math.sin(0.5 * yaw), math.cos(0.5 * yaw)


def frame(message: bytes) -> bytes:
    """Return a message with its length, as the node reads it; a short one is written in one piece."""
    return len(message).to_bytes(4, "little") + message
