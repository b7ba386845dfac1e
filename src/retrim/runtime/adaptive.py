"""The adaptive pilot: flies a policy, feeds learners, and applies their updates."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..adapt.buffer import RollingBuffer
from ..adapt.learner_state import LearnerState
from ..adapt.updates import PolicyUpdate, ResidualUpdate, Update
from ..control.controller import AbstractController
from ..physics.state import Command
from ..plants.plant import Measurement
from .events import Event
from .learner import Learner
from .pilot import ControllerPilot, Pilot


class ScheduledLearner(NamedTuple):
    """A learner, and the interval at which it is offered windows."""

    learner: Learner
    every_s: float
    """Time between windows [s], rounded to whole ticks."""


class AdaptivePilot(Pilot):
    """A pilot that learns in flight. ``state`` holds the latest published policy and residual."""

    def __init__(
        self,
        controller: Callable[[LearnerState], AbstractController[Any]],
        state: LearnerState,
        learners: Sequence[ScheduledLearner],
        *,
        dt: float,
        window: int,
    ) -> None:
        """Build a pilot.

        Args:
            controller: Function that returns the controller for a learner state; each new controller takes over the
                memory of the previous one.
            state: Policy and residual at the start.
            learners: Learners, in the order in which they are offered windows.
            dt: Control tick [s].
            window: Length of the learners' window [ticks].
        """
        self.controller_of = controller
        self.dt: float = dt
        self.learners = tuple(learners)
        self.periods = [max(1, round(each.every_s / dt)) for each in self.learners]
        self.window = window
        self._buffer = RollingBuffer(window)
        self._pilot = ControllerPilot(controller(state))
        self._ticks_offered = [0] * len(self.learners)
        self._start = 0.0
        self._new_events: list[Event] = []
        self.state = state
        self.events: list[Event] = []

    def reset(self, measurement: Measurement) -> None:
        """Start a flight: keep the learner state, clear the buffer and cancel computations in progress."""
        self._buffer.clear()
        self._start, self._ticks_offered = measurement.t, [0] * len(self.learners)
        for learner, _ in self.learners:
            learner.reset()
        self._pilot.reset(measurement)

    def warm_up(self, measurement: Measurement) -> None:
        """Compile the programs of the flight and of every learner; updates from this one tick are dropped."""
        super().warm_up(measurement)
        for learner, _ in self.learners:
            learner.submit(self._buffer.window(), 0)
            learner.reset()

    def act(self, measurement: Measurement) -> Command:
        """Apply the visible updates, fly one tick and offer the windows that are due."""
        t = measurement.t - self._start
        tick = round(t / self.dt)
        self._apply(t, tick)
        u = self._pilot.act(measurement)
        self._tell(self._pilot.take_events())
        self._buffer.push(t, measurement.x, u, measurement.age)
        due = [i for i, period in enumerate(self.periods) if tick // period > self._ticks_offered[i]]
        if due:
            window = self._buffer.window()
            for i in due:
                self._ticks_offered[i] = tick // self.periods[i]
                self.learners[i].learner.submit(window, tick)
            self._apply(t, tick)  # a skip is visible at the tick of its offer
        return u

    def accept(self, u: Command) -> None:
        """Remember the accepted command in the buffer and in the observation."""
        self._buffer.accept(u)
        self._pilot.accept(u)

    def learn(self, state: LearnerState, t: float) -> None:
        """Adopt a learner state from a different source, and let the learners continue from it.

        Args:
            state: Policy and residual.
            t: Time of the newest measurement from which they were learned [s].
        """
        self._publish(ResidualUpdate(t, 0.0, state.residual))
        self._publish(PolicyUpdate(t, 0.0, 0.0, state.policy))

    def task_time(self, t: float) -> float:
        """Return the time along the reference at flight time ``t`` [s]."""
        return self._pilot.task_time(t)

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        result, self._new_events = self._new_events, []
        return result

    def _apply(self, t: float, tick: int) -> None:
        for learner, _ in self.learners:
            for update in learner.poll(tick):
                self._publish(update)
                self._tell([Event.of(t, update)])

    def _tell(self, events: Sequence[Event]) -> None:
        self.events += events
        self._new_events += events

    def _publish(self, update: Update) -> None:
        if isinstance(update, ResidualUpdate | PolicyUpdate):
            is_fit = isinstance(update, ResidualUpdate)
            policy, residual = (self.state.policy, update.state) if is_fit else (update.state, self.state.residual)
            self.state = LearnerState(policy, residual)
            self._pilot.controller = self.controller_of(self.state)
        for learner, _ in self.learners:
            learner.receive(update)
