"""Execute the user's requests in flight, such as to land, to pause learning or to change the method or reference."""

import contextlib
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ...config.methods import learning_methods
from ...errors import MessageError, RetrimError
from ...io.policies import load_learner_state, save_learner_state
from ...onboard.messages import unpack_note
from ...onboard.note_fields import format_value
from ...runtime.events import Event
from ..report import collect_learner_state
from ..session import LiveRequest, learner_state
from ..status import Status
from ..supervisor import Supervisor
from .manual_disturbance import ManualDisturbance
from .reference_switcher import ReferenceSwitcher

KNOBS, UNITS = ("push", "wind", "load", "rotor"), {"push": "m/s²", "wind": "m/s", "load": "kg", "kick": "m/s²"}
KNOB_REST_S = 0.5  # [s] without a further change, after which the new knob positions become an event


class OperatorRequests:
    """Reads and executes the user's requests during one flight. Long operations run in a separate thread."""

    def __init__(self, request: LiveRequest, supervisor: Supervisor) -> None:
        """Initialise for the flight of a supervisor."""
        self._request, self._supervisor = request, supervisor
        self._wish: dict[str, Any] = {"method": request.method, "paused": False}
        self._method, self._starts = request.method, 0
        self._versions = {"wish": 0, "knobs": 0}
        self._knob_change: tuple[float, float, ManualDisturbance] | None = None
        """Time on the clock and in the flight [s] of the last change of the knobs, and their positions."""
        self._knobs_before = ManualDisturbance()
        self._work = ThreadPoolExecutor(1)
        self.following = ReferenceSwitcher(request, supervisor, self._work)
        self._coming: tuple[str, Future[Path]] | None = None

    def obey(self, status: Status) -> list[Event]:
        """Execute the requests made since the last call; return them as events."""
        new = self._knobs(status.t)
        if (wish := self._new("wish")) is not None:
            with contextlib.suppress(MessageError):  # the supervisor counts and reports invalid notes
                request = unpack_note(wish, "wish")
                if "reference" in request:
                    new += self.following.ask(request["reference"], status.t)
                new += self._ask(request, status)
        return new + self._report_arrival(status.t) + self.following.obey(status)

    def close(self) -> None:
        """Cancel pending operations."""
        self._work.shutdown(wait=False, cancel_futures=True)

    def _ask(self, request: dict[str, Any], status: Status) -> list[Event]:
        if request.get("land"):
            self._supervisor.land()
            return [Event(status.t, "request", "land")]
        method, pause = request.get("method", self._wish["method"]), request.get("paused", self._wish["paused"])
        now = {"method": method, "paused": pause}
        if now == self._wish or not self._supervisor.spec.layers:
            return []
        methods = tuple(dict.fromkeys((self._request.method, *learning_methods())))
        if method not in (*methods, "none"):
            return [Event(status.t, "refused", f"method {format_value(method)}: there are {', '.join(methods)}, none")]
        self._wish = now
        self._supervisor.learn(pause=pause or method == "none", active=method != "none")
        if method != "none" and method != self._method:
            self._method = method
            self._coming = method, self._work.submit(self._start_of, method, status)
        return [Event(status.t, "request", f"method {method}" + (", paused" if pause else ""))]

    def _start_of(self, method: str, status: Status) -> Path:
        """Write the policy and the residual in flight in the form that ``method`` learns; return the path."""
        start, trust = self._supervisor.start, self._supervisor.spec.trust
        state = (
            collect_learner_state(self._supervisor.bus, status, start, trust)
            or load_learner_state(start, trust=trust)[0]
        )
        self._starts += 1
        path = self._supervisor.start.parent / f"start-{self._starts}.safetensors"
        policy = state.policy.policy.merged()
        save_learner_state(
            path, learner_state(self._request, policy, method, state.residual), self._request.setup.preset
        )
        return path

    def _report_arrival(self, t: float) -> list[Event]:
        if self._coming is None or not self._coming[1].done():
            return []
        (method, future), self._coming = self._coming, None
        try:
            self._supervisor.learn_from(future.result())
        except (RetrimError, OSError) as error:
            return [Event(t, "request", f"method {method} is not available: {error}")]
        return [Event(t, "request", f"the policy's learner starts again: {method}")]

    def _knobs(self, t: float) -> list[Event]:
        if (knob_message := self._new("knobs")) is not None:
            with contextlib.suppress(MessageError):
                self._knob_change = time.monotonic(), t, ManualDisturbance.unpack(knob_message)
        if self._knob_change is None or time.monotonic() - self._knob_change[0] < KNOB_REST_S:
            return []
        (_, at, knobs), self._knob_change = self._knob_change, None
        before, self._knobs_before = self._knobs_before, knobs
        changed = [name for name in KNOBS if getattr(knobs, name) != getattr(before, name)]
        if knobs.kicks != before.kicks:
            changed.append("kick")
        elif changed and knobs == ManualDisturbance(kick=knobs.kick, kicks=knobs.kicks):
            return [Event(at, "knobs", "all added effects removed")]
        words = (f"{name} {_format(getattr(knobs, name))} {UNITS.get(name, '')}".rstrip() for name in changed)
        return [Event(at, "knobs", ", ".join(words))] if changed else []

    def _new(self, topic: str) -> bytes | None:
        message = self._supervisor.bus.latest(topic, self._versions[topic])
        if message is None:
            return None
        self._versions[topic] = message.version
        return message.data


def _format(value: Any) -> str:
    return " ".join(f"{each:g}" for each in value) if isinstance(value, tuple) else f"{value:g}"
