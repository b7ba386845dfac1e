"""Change the reference in flight: the user selects a reference, and the vehicle changes to it smoothly."""

from concurrent.futures import Executor, Future

import numpy as np

from ...config.references import make_reference
from ...errors import ConfigError, MessageError, RetrimError
from ...onboard.messages import FlightRows, Parameters, pack_note
from ...onboard.topics import REFERENCE
from ...runtime.events import Event
from ...tasks.reference import Reference
from ...tasks.transition import LEAD_TIME, transition_between
from ...transport import wire
from ..live_options import choices
from ..session import LiveRequest
from ..status import Status
from ..supervisor import Supervisor

LEAD = 0.8 * LEAD_TIME  # [s] between the publication of a table and the start of its transition
ATTEMPTS = 3
REFERENCE_TOPIC = "followed"
"""Topic with the name of the current reference."""


class ReferenceSwitcher:
    """Changes the reference on request. A separate thread computes the tables."""

    def __init__(self, request: LiveRequest, supervisor: Supervisor, work: Executor) -> None:
        """Initialise for a flight.

        Args:
            request: Request for the flight.
            supervisor: Supervisor of its processes.
            work: Executor that computes the tables.
        """
        self._supervisor, self._work = supervisor, work
        self._vehicle = request.scenario.make_vehicle(request.setup.preset.vehicle)
        present = request.reference_name
        self._choices = choices(request.setup, present) if REFERENCE in supervisor.spec.controller.parameters else ()
        self.name, self.pieces = present, list[tuple[float, Reference]]()
        if request.setup.flight_reference is not None:
            self.pieces = [(0.0, request.setup.flight_reference)]
        self._version, self._attempts, self._request, self._next = 0, 0, present, present
        self._coming: tuple[str, Future[tuple[float, Reference]]] | None = None
        self._pending: tuple[str, float, Reference] | None = None

    def ask(self, name: str, t: float) -> list[Event]:
        """Begin a change to a different reference as soon as no other change is pending; return the events.

        Args:
            name: Name of the reference; other names than the choices are ignored. Repeated requests have no effect.
            t: Flight time [s].
        """
        if name in self._choices:
            self._next = name
        return self._begin(t)

    def obey(self, status: Status) -> list[Event]:
        """Publish a completed table, and register a table that control has accepted; return the events."""
        new = list[Event]()
        if self._coming is not None and self._coming[1].done():
            (name, reference), self._coming = self._coming, None
            try:
                at, table = reference.result()
            except RetrimError as error:
                return [Event(status.t, "request", f"reference {name} cannot be followed: {error}")]
            self._publish(table, at - LEAD)
            self._pending = name, at, table
        if self._pending is not None:
            name, at, table = self._pending
            if status.control.get("versions", {}).get(REFERENCE, 0) >= self._version:
                self.name, self._pending = name, None
                self.pieces.append((at, table))
                self._supervisor.bus.publish(REFERENCE_TOPIC, pack_note(REFERENCE_TOPIC, name=name))
                new = [Event(at, "reference", f"transition to{name}")]
            elif (t := self._now()) > at:  # control received it too late
                self._pending = None
                if self._attempts < ATTEMPTS:
                    self._make(name)
                else:
                    self._publish(self.pieces[-1][1], t)  # make learners return to the reference in flight
                    new = [Event(status.t, "request", f"reference {name} cannot be followed: it was not taken")]
        return new + self._begin(status.t)

    def _begin(self, t: float) -> list[Event]:
        if self._coming is not None or self._pending is not None or self._next == self._request:
            return []
        self._request, self._attempts = self._next, 0
        if self._request == self.name:
            return []
        self._make(self._request)
        return [Event(t, "request", f"reference {self._request}")]

    def _make(self, name: str) -> None:
        self._attempts += 1
        self._coming = name, self._work.submit(self._table, name)

    def _table(self, name: str) -> tuple[float, Reference]:
        """Return the start time of the transition, and the table.

        A first, discarded computation compiles the program, so the compile time does not delay the start.
        """
        old, new = self.pieces[-1][1], make_reference(name)
        transition_between(old, new, 0.0, self._vehicle)
        at = self._now() + LEAD
        table = transition_between(old, new, at, self._vehicle)
        limits, places = self._supervisor.spec.limits, np.asarray(table.rows[:, :3], dtype=float)
        outside = (places < limits.low) | (places > limits.high)
        if outside.any():
            place = places[int(np.argmax(outside.any(1)))].round(2).tolist()
            raise ConfigError(f"it passes {place} m, outside the fence; --fence sets a wider one")
        return at, table

    def _now(self) -> float:
        """Return the flight time of the control process, which evaluates the table [s].

        On a busy machine, a simulated plant falls behind wall-clock time. Control uses the plant's time.
        """
        message = self._supervisor.bus.latest("flight")
        try:
            rows = None if message is None else FlightRows.unpack(message.data).rows
        except MessageError:
            rows = None
        return 0.0 if rows is None else float(rows[-1, 1])

    def _publish(self, table: Reference, since: float) -> None:
        self._version += 1
        arrays = {key: np.asarray(leaf) for key, leaf in wire.names(table).items()}
        base = self._supervisor.spec.controller.base
        result = Parameters(REFERENCE, self._version, base, since, arrays)
        self._supervisor.bus.publish(f"parameters.{REFERENCE}", result.pack())
