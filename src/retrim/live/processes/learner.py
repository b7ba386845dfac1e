"""Process of one learning layer; the process reads flight rows and publishes parameters."""

import contextlib
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from ...adapt.buffer import RollingBuffer
from ...adapt.learner_state import LearnerState
from ...adapt.updates import NO_REJECTIONS, Layer, PolicyUpdate, ResidualUpdate, Update, pack_update
from ...adapt.worker import Worker
from ...adapt.workers import make_worker
from ...config.presets import Preset
from ...config.setup import Setup
from ...errors import MessageError
from ...io.policies import load_learner_state
from ...learn.window import Window
from ...onboard.heartbeat import Pacemaker
from ...onboard.messages import COMMAND, MEASURED, FlightRows, Parameters, last_note, pack_note
from ...onboard.realtime import ParentWatch
from ...onboard.topics import REFERENCE
from ...physics.state import Command, State
from ...runkit.compile_cache import enable_compile_cache
from ...runkit.outlet import Outlet
from ...runkit.outputs import write_state
from ...transport import wire
from ...transport.bus import Bus
from ...transport.shared_memory import SharedMemoryBus
from ..states import state_of
from .controllers import parameter_groups
from .published_updates import active_learner_state, active_update, keep, newest_update

CHECK_EVERY = 0.005  # [s]
READ_LIMIT, UPDATE_LIMIT = 5.0, 60.0  # [s], longest time to read the bus and to compute an update
VERDICT = 1.0  # [s] for control to accept or refuse a policy; the policy then counts as lost
NICENESS = 10
HISTORY = 8  # number of the flight's past policies that are kept for a rollback


@dataclass(frozen=True)
class LearnerPlan:
    """Arguments of the process."""

    folder: Path
    layer: Layer
    start: Path
    """File with the preset and the learned state from before the flight."""
    reference: str | None
    seed: int
    base: str
    """Hash of the flight's controller."""
    parent: int
    floor: int = 0
    """Policy version; updates on the bus up to this version are older than ``start``."""
    trust: tuple[str, ...] = ()
    """Python names that ``start`` may contain. The user passed them to the process that wrote this plan."""
    out: Path | None = None
    """Folder for the learned state if the supervisor has ended before writing the state; None to discard it."""


class LearnerLoop:
    """Learning loop of one layer during a flight. Call :meth:`step` repeatedly; tests pass their own clock."""

    def __init__(
        self,
        plan: LearnerPlan,
        bus: Bus,
        clock: Callable[[], float] = time.monotonic,
        setup_of: Callable[[Preset, str | None], Setup] = Setup.from_preset,
    ) -> None:
        """Initialise the loop.

        Args:
            plan: Plan of the learner.
            bus: Bus of the flight.
            clock: Function that returns the time [s].
            setup_of: Function that returns a set-up, which the loops of several vehicles may share.
        """
        state, preset = load_learner_state(plan.start, trust=plan.trust)
        self.plan, self.bus, self.state, self._clock = plan, bus, state, clock
        self.setup = setup_of(preset, plan.reference)
        self.every = preset.adapt.fit_every if plan.layer == "residual" else preset.adapt.update_every
        self._buffer = RollingBuffer(preset.adapt.window)
        self.worker = self.new_worker()
        """Worker that continues from the parameters in flight."""
        self._last_tick, self._new_ticks, self._began = -1, 0, float("-inf")
        self._versions: dict[str, int] = {}
        self._update_count = 0
        self.rolled_back = 0
        """Number of times control rolled back a policy."""
        self._pending: tuple[int, PolicyUpdate, float] | None = None
        self._history: list[tuple[int, Update]] = []

    def new_worker(self) -> Worker:
        """Return a worker that starts from the learned state before the flight."""
        return make_worker(self.setup.learner, self.plan.layer, self.state, random.key(self.plan.seed))

    def warm_up(self) -> None:
        """Compile the flight's programs with a synthetic window, and discard the result."""
        self.worker.learn(self.dummy_window())
        self.worker = self.new_worker()

    def dummy_window(self) -> Window:
        """Return a synthetic window that has the shapes of a flight window and contains one tick of hover."""
        x, buffer = State.at(self.setup.flight_task.home()), RollingBuffer(self.setup.preset.adapt.window)
        buffer.push(0.0, x, Command.hover(x.p.dtype))
        return buffer.window()

    def catch_up(self) -> None:
        """Continue from the update in flight if an earlier process of this layer published the update."""
        self._take_residual()
        if (
            self.plan.layer == "policy"
            and (result := active_update(self.bus, self.state, "policy", self._status())) is not None
            and result[0] > self.plan.floor
        ):
            self._history = [result]
            self.worker.receive(result[1])

    def step(self) -> bool:
        """Read new messages and learn if an update is due; return whether an update was learned."""
        window = self.due()
        if window is None:
            return False
        self.publish_update(self.worker.learn(window))
        return True

    def due(self) -> Window | None:
        """Read new messages; return the window to learn from if an update is due, else None."""
        self._look()
        self._follow()
        if self.plan.layer == "policy":
            self._take_residual()
            self._judge()
        waits = self._pending is not None or not self._new_ticks or self._clock() - self._began < self.every
        if waits or not self._is_active():
            return None
        self._began, self._new_ticks = self._clock(), 0
        return self._buffer.window()

    def publish_update(self, update: Update) -> None:
        """Publish an update learned from the window of :meth:`due`, if control still accepts updates."""
        self._update_count += 1
        topic, took = f"learner.{self.plan.layer}", self._clock() - self._began
        exclusions = list(update.excluded if isinstance(update, ResidualUpdate) else NO_REJECTIONS)
        note = pack_note(topic, learnt=self._update_count, took=took, until=update.computed_from, excluded=exclusions)
        self.bus.publish(topic, note)
        if self.plan.layer == "policy" and self._judge():
            return  # control has since rolled back the policy from which the update was trained
        if self._is_active():
            self._publish(update)

    def _look(self) -> None:
        """Add the new ticks to the window."""
        message = self._fresh("flight")
        if message is None:
            return
        try:
            rows = FlightRows.unpack(message).rows
        except MessageError:
            return
        dtype = np.asarray(self.setup.flight_task.home()).dtype
        for row in rows[rows[:, 0] > self._last_tick]:
            state, u = state_of(row[MEASURED], dtype), jnp.asarray(row[COMMAND], dtype)
            self._buffer.push(float(row[1]), state, Command.of(u), float(row[2]))
            self._last_tick, self._new_ticks = int(row[0]), self._new_ticks + 1

    def _follow(self) -> None:
        """Learn on the new reference if the flight has changed its reference."""
        reference = self.setup.flight_reference
        if reference is None or (message := self._fresh(f"parameters.{REFERENCE}")) is None:
            return
        with contextlib.suppress(MessageError):
            result = Parameters.unpack(message, wire.names(reference), half=REFERENCE, base=self.plan.base, after=0)
            leaves = jax.device_put(list(result.arrays.values()))
            self.setup = self.setup.on(jax.tree.unflatten(jax.tree.structure(reference), leaves))
            self.worker.follow(self.setup.learner)

    def _publish(self, update: Update) -> None:
        layer = self.plan.layer
        if not isinstance(update, ResidualUpdate | PolicyUpdate):
            self.bus.publish(f"said.{layer}", pack_update(update))
            return
        topic = f"parameters.{layer}"
        before = self.bus.latest(topic)
        newest_version = self._status().get("newest", {}).get(layer, 0)  # a new bus may lack the version in control
        version = max(0 if before is None else before.version, newest_version) + 1
        parent = self._history[-1][0] if self._history else 0
        whole = self._learner_state_of(update)
        arrays = wire.names(parameter_groups(whole.policy.policy.merged(), whole.residual)[layer])
        keep(self.bus, layer, version, update, self._status())
        result = Parameters(layer, version, self.plan.base, update.computed_from, arrays, parent)
        self.bus.publish(topic, result.pack())
        if isinstance(update, PolicyUpdate):
            self._pending = version, update, self._clock()
        else:
            self.worker.receive(update)

    def _learner_state_of(self, update: Update) -> LearnerState:
        if isinstance(update, PolicyUpdate):
            return LearnerState(update.state, self.state.residual)
        assert isinstance(update, ResidualUpdate)
        return LearnerState(self.state.policy, update.state)

    def _judge(self) -> bool:
        """Continue from an accepted policy or, after a rollback, the last valid one; return True after a rollback."""
        status = self._status()
        withdrawals, back = status.get("given_up", []), False
        while self._history and self._history[-1][0] in withdrawals:
            self._history.pop()
            back = True
        if back:
            self.rolled_back += 1
            self.worker.receive(self._history[-1][1] if self._history else _start(self.state))
        if self._pending is None:
            return back
        version, update, publish_time = self._pending
        if version in withdrawals:
            self._pending = None
        elif status.get("newest", {}).get("policy", 0) >= version:
            self.worker.receive(update)
            self._history, self._pending = [*self._history[-HISTORY:], (version, update)], None
        elif self._clock() - publish_time > VERDICT:
            self._pending = None  # the policy was corrupted in transit, or control no longer accepts policies
        return back

    def _status(self) -> dict[str, Any]:
        return last_note(self.bus, "status")

    def _is_active(self) -> bool:
        """Return whether learning is active and control accepts updates, which it does only in policy mode."""
        return self._status().get("mode", "policy") == "policy" and not last_note(self.bus, "learning").get(
            "paused", False
        )

    def _take_residual(self) -> None:
        """Pass the newest residual fit to the worker unless the worker already has it."""
        result = newest_update(self.bus, self.state, "residual", after=self._versions.get("fit", 0))
        if result is not None:
            self._versions["fit"] = result[0]
            self.worker.receive(result[1])

    def _fresh(self, topic: str) -> bytes | None:
        message = self.bus.latest(topic, self._versions.get(topic, 0))
        if message is None:
            return None
        self._versions[topic] = message.version
        return message.data

    def leave(self, folder: Path, patience: float = 3.0) -> None:
        """Write the flight's last learned state once updates are no longer accepted, or after ``patience`` [s]."""
        until = self._clock() + patience
        while self._is_active() and self.bus.latest("ended") is None and self._clock() < until:
            time.sleep(CHECK_EVERY)
        learner_state, outlet = active_learner_state(self.bus, self.state, self._status()), Outlet(folder)
        if learner_state is not None:
            outlet.write("the learner state", partial(write_state, learner_state, self.setup.preset))
        for fault in outlet.faults:
            print(fault, file=sys.stderr)


def _start(state: LearnerState) -> PolicyUpdate:
    return PolicyUpdate(0.0, 0.0, 0.0, state.policy)


def learn(plan: LearnerPlan) -> None:
    """Learn until the flight is over; this is the main function of the process."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(NICENESS)  # a browser or terminal on the same machine must not wait for an update
    enable_compile_cache()
    bus, parent = SharedMemoryBus(plan.folder), ParentWatch(plan.parent)
    loop = LearnerLoop(plan, bus)
    loop.warm_up()
    loop.catch_up()
    bus.publish(f"ready.{plan.layer}", pack_note("ready", base=plan.base, device=jax.devices()[0].platform))
    with Pacemaker(bus, plan.layer) as heart:
        while not parent.has_ended() and bus.latest("ended") is None:
            heart.touch(READ_LIMIT)
            window = loop.due()
            if window is None:
                time.sleep(CHECK_EVERY)
                continue
            heart.touch(UPDATE_LIMIT)
            loop.publish_update(loop.worker.learn(window))
    if plan.layer == "policy" and plan.out is not None:
        while not parent.has_ended(READ_LIMIT):  # the supervisor writes the learned state and ends this process
            pass
        loop.leave(plan.out)
