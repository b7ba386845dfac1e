"""Adaptation on a virtual clock: what a live run does, but repeatable bit for bit.

Compute time is charged to flight time. Work that is due at a tick sees what was known at that tick; its result becomes
visible only after the seconds it is charged, exactly as if a learner had worked beside the flight.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
from jax import random
from jaxtyping import Array, Key

from ..control.controller import PolicyController
from ..learn.residual import Window
from ..physics.state import Command
from ..tasks.observation import AbstractObservation
from .adapter import Adapter, AdaptState
from .buffer import RollingBuffer
from .plant import ControllerPilot, Sample
from .sink import Sink


class Schedule(NamedTuple):
    """When to learn, and what it costs (paper, Sec. IV-A.3: residual every 3 s, policy every 5 s)."""

    refine_every: float
    """[s]"""
    improve_every: float
    """[s]"""
    refine_charge: float | None
    """Flight time that passes until a residual is visible [s]; None: as long as it took by the clock."""
    improve_charge: float | None
    """The same for a policy."""


class Event(NamedTuple):
    """Something that adaptation did."""

    t: float
    """When it became visible [s]."""
    kind: str
    """``residual``, ``policy``, ``rejected`` (a result that must not be used) or ``skipped`` (the learner was busy)."""
    note: str


class _Learner:
    """One learner: at most one piece of work under way, whose result appears later."""

    def __init__(self, every: float, charge: float | None, dt: float) -> None:
        self._period, self._charge, self._dt = round(every / dt), charge, dt
        self._ready: tuple[int, Callable[[], None]] | None = None

    def deliver(self, tick: int) -> None:
        """Make a finished result visible."""
        if self._ready is not None and self._ready[0] <= tick:
            publish, self._ready = self._ready[1], None
            publish()

    def cancel(self) -> None:
        """Drop what is under way."""
        self._ready = None

    def due(self, tick: int) -> bool:
        """Whether work should start at this tick."""
        return tick > 0 and tick % self._period == 0

    @property
    def busy(self) -> bool:
        """Whether a result is still under way."""
        return self._ready is not None

    def work(self, tick: int, job: Callable[[], Callable[[], None]]) -> None:
        """Do ``job`` now; what it returns is called once its charge has passed."""
        began = time.perf_counter()
        publish = job()
        seconds = time.perf_counter() - began if self._charge is None else self._charge
        self._ready = (tick + max(1, math.ceil(seconds / self._dt - 1e-6)), publish)


class AdaptivePilot:
    """A pilot that learns as it flies. ``state`` is what has been learnt and admitted so far.

    ``observation``: what the policy sees in flight, if that is not what it sees in training.
    """

    def __init__(
        self,
        adapter: Adapter,
        state: AdaptState,
        schedule: Schedule,
        key: Key[Array, ""],
        *,
        dt: float,
        window: int,
        observation: AbstractObservation[Any] | None = None,
        sinks: Sequence[Sink] = (),
    ) -> None:
        self._seen = adapter.task.observation if observation is None else observation
        self._adapter, self._key, self._sinks = adapter, key, tuple(sinks)
        self._buffer = RollingBuffer(window)
        self._refiner = _Learner(schedule.refine_every, schedule.refine_charge, dt)
        self._improver = _Learner(schedule.improve_every, schedule.improve_charge, dt)
        self._pilot = ControllerPilot(PolicyController(self._seen, state.policy.policy.plain()))
        self._tick = 0
        self._now = 0.0
        self.state = state
        self.events: list[Event] = []

    def __call__(self, sample: Sample) -> Command:
        """Publish what is ready, fly one tick, start what is due."""
        if sample.t == 0.0:  # another flight: what was learnt stays, what was seen or under way does not
            self._buffer.clear()
            self._refiner.cancel()
            self._improver.cancel()
            self._tick = 0
        self._now = sample.t
        for learner in (self._refiner, self._improver):
            learner.deliver(self._tick)
        u = self._pilot(sample)
        self._buffer.push(sample.t, sample.x, u)
        self._start(self._refiner, "residual", self._refine)
        self._start(self._improver, "policy", self._improve)
        self._tick += 1
        return u

    def _start(self, learner: _Learner, name: str, job: Callable[[Window], Callable[[], None]]) -> None:
        if not learner.due(self._tick):
            return
        if learner.busy:
            self._tell("skipped", f"{name} learner still busy")
            return
        window = self._buffer.window()
        learner.work(self._tick, lambda: job(window))

    def _refine(self, window: Window) -> Callable[[], None]:
        fitted, error, sound = jax.block_until_ready(self._adapter.refine(self.state.residual, window))

        def publish() -> None:
            self.state = AdaptState(self.state.policy, fitted)
            if sound:
                self._tell("residual", f"rms error {float(error):.3f} m/s^2")
            else:
                self._tell("rejected", "the residual's fit is not finite")

        return publish

    def _improve(self, window: Window) -> Callable[[], None]:
        self._key, key = random.split(self._key)
        residual = self.state.residual.residual
        trained, verdict = jax.block_until_ready(self._adapter.improve(self.state.policy, residual, window, key))

        def publish() -> None:
            if verdict.admitted:
                self.state = AdaptState(trained, self.state.residual)
                self._pilot.controller = PolicyController(self._seen, trained.policy.plain())
            self._tell("policy" if verdict.admitted else "rejected", verdict.reason())

        return publish

    def _tell(self, kind: str, note: str) -> None:
        self.events.append(Event(self._now, kind, note))
        data: dict[str, Any] = {"t": self._now, "note": note}
        for sink in self._sinks:
            sink.event(kind, **data)
