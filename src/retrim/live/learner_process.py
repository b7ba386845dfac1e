"""The process of one layer of learning: windows of flight come in, parameters go out."""

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

from ..adapt.buffer import RollingBuffer
from ..adapt.learner import LearnerState
from ..adapt.updates import NOTHING, Layer, PolicyUpdate, ResidualUpdate, Update, pack_update
from ..adapt.workers import PolicyWorker, ResidualWorker
from ..config.presets import Preset
from ..config.setup import Setup
from ..errors import MessageError
from ..experiments.compile_cache import enable_compile_cache
from ..experiments.outlet import Outlet
from ..experiments.outputs import write_state
from ..io.trained import load_learnt
from ..learn.window import Window
from ..onboard.heart import Pacemaker
from ..onboard.messages import COMMAND, MEASURED, FlightRows, Parameters, last_note, pack_note
from ..onboard.realtime import Lifeline
from ..onboard.topics import REFERENCE
from ..physics.state import Command, State
from ..transport import wire
from ..transport.bus import Bus
from ..transport.shared_memory import SharedMemoryBus
from .controllers import flown
from .published import flown_update, keep, learnt_from, newest_update
from .states import state_of

CHECK_EVERY = 0.005  # [s]
LOOKING, COMPUTING = 5.0, 60.0  # [s] that a look at the bus and that an update may take
VERDICT = 1.0  # [s] that a policy waits to be taken or refused; after it, it counts as lost
NICE = 10
REMEMBERED = 8  # policies that were flown


@dataclass(frozen=True)
class LearnerPlan:
    """Everything that the process is started with."""

    folder: Path
    layer: Layer
    start: Path
    """File with what was learnt before the flight, and the preset."""
    reference: str | None
    seed: int
    base: str
    """Hash of the controller that flies."""
    parent: int
    floor: int = 0
    """Version of the policy up to which updates on the bus are older than ``start``."""
    trust: tuple[str, ...] = ()
    """Python names that ``start`` may hold, since the user named them to the process that wrote this plan."""
    out: Path | None = None
    """Where what was learnt goes if the supervisor is not there to write it; None for nowhere."""


class LearnerLoop:
    """One layer beside the flight. :meth:`step` is the whole of it; a test gives it a clock."""

    def __init__(
        self,
        plan: LearnerPlan,
        bus: Bus,
        clock: Callable[[], float] = time.monotonic,
        setup_of: Callable[[Preset, str | None], Setup] = Setup.of,
    ) -> None:
        """Build it.

        Args:
            plan: What to learn.
            bus: Of the flight.
            clock: The time [s].
            setup_of: Returns the set-up of a preset and a reference; loops of several vehicles may share one.
        """
        state, preset = load_learnt(plan.start, trust=plan.trust)
        self.plan, self.bus, self.state, self._clock = plan, bus, state, clock
        self.setup = setup_of(preset, plan.reference)
        self.every = preset.adapt.fit_every if plan.layer == "residual" else preset.adapt.update_every
        self._buffer = RollingBuffer(preset.adapt.window)
        self.worker = self.new_worker()
        """It goes on from what is flown."""
        self._last_tick, self._new_ticks, self._began = -1, 0, float("-inf")
        self._known: dict[str, int] = {}
        self._learnt = 0
        self.taken_back = 0
        """How often control took a policy back."""
        self._pending: tuple[int, PolicyUpdate, float] | None = None
        self._flown: list[tuple[int, Update]] = []

    def new_worker(self) -> ResidualWorker | PolicyWorker:
        """Return a worker that begins with what was learnt before the flight."""
        if self.plan.layer == "residual":
            return ResidualWorker(self.setup.learner, self.state)
        return PolicyWorker(self.setup.learner, self.state, random.key(self.plan.seed))

    def warm_up(self) -> None:
        """Compile what a flight needs; what is learnt from a made-up window is dropped."""
        self.worker.learn(self.made_up_window())
        self.worker = self.new_worker()

    def made_up_window(self) -> Window:
        """Return a window of the shapes of the flight's, with one tick of hover."""
        x, buffer = State.at(self.setup.flown.home()), RollingBuffer(self.setup.preset.adapt.window)
        buffer.push(0.0, x, Command.hover(x.p.dtype))
        return buffer.window()

    def catch_up(self) -> None:
        """Go on from what an earlier process of this layer published and control flies."""
        self._take_residual()
        if (
            self.plan.layer == "policy"
            and (found := flown_update(self.bus, self.state, "policy", self._status())) is not None
            and found[0] > self.plan.floor
        ):
            self._flown = [found]
            self.worker.receive(found[1])

    def step(self) -> bool:
        """Take what is new and learn if it is time; return whether something was learnt."""
        window = self.due()
        if window is None:
            return False
        self.learnt(self.worker.learn(window))
        return True

    def due(self) -> Window | None:
        """Take what is new; return the window to learn from if it is time, else None."""
        self._look()
        self._follow()
        if self.plan.layer == "policy":
            self._take_residual()
            self._judge()
        waits = self._pending is not None or not self._new_ticks or self._clock() - self._began < self.every
        if waits or not self._wanted():
            return None
        self._began, self._new_ticks = self._clock(), 0
        return self._buffer.window()

    def learnt(self, update: Update) -> None:
        """Publish what was learnt from the window of :meth:`due`, if it is still wanted."""
        self._learnt += 1
        topic, took = f"learner.{self.plan.layer}", self._clock() - self._began
        excluded = list(update.excluded if isinstance(update, ResidualUpdate) else NOTHING)
        note = pack_note(topic, learnt=self._learnt, took=took, until=update.computed_from, excluded=excluded)
        self.bus.publish(topic, note)
        if self.plan.layer == "policy" and self._judge():
            return  # the policy that it was trained from was taken back meanwhile
        if self._wanted():
            self._publish(update)

    def _look(self) -> None:
        """Add the ticks that are new to the window."""
        message = self._fresh("flight")
        if message is None:
            return
        try:
            rows = FlightRows.unpack(message).rows
        except MessageError:
            return
        dtype = np.asarray(self.setup.flown.home()).dtype
        for row in rows[rows[:, 0] > self._last_tick]:
            state, u = state_of(row[MEASURED], dtype), jnp.asarray(row[COMMAND], dtype)
            self._buffer.push(float(row[1]), state, Command.of(u), float(row[2]))
            self._last_tick, self._new_ticks = int(row[0]), self._new_ticks + 1

    def _follow(self) -> None:
        """Learn on the reference that is followed, if another one is followed now."""
        followed = self.setup.followed
        if followed is None or (message := self._fresh(f"parameters.{REFERENCE}")) is None:
            return
        with contextlib.suppress(MessageError):
            found = Parameters.unpack(message, wire.names(followed), half=REFERENCE, base=self.plan.base, after=0)
            leaves = jax.device_put(list(found.arrays.values()))
            self.setup = self.setup.on(jax.tree.unflatten(jax.tree.structure(followed), leaves))
            self.worker.learner = self.setup.learner

    def _publish(self, update: Update) -> None:
        layer = self.plan.layer
        if not isinstance(update, ResidualUpdate | PolicyUpdate):
            self.bus.publish(f"said.{layer}", pack_update(update))
            return
        topic = f"parameters.{layer}"
        before = self.bus.latest(topic)
        known = self._status().get("newest", {}).get(layer, 0)  # a bus that is new knows less than who flies
        version = max(0 if before is None else before.version, known) + 1
        parent = self._flown[-1][0] if self._flown else 0
        whole = self._learnt_by(update)
        arrays = wire.names(flown(whole.policy.policy.merged(), whole.residual)[layer])
        keep(self.bus, layer, version, update, self._status())
        found = Parameters(layer, version, self.plan.base, update.computed_from, arrays, parent)
        self.bus.publish(topic, found.pack())
        if isinstance(update, PolicyUpdate):
            self._pending = version, update, self._clock()
        else:
            self.worker.receive(update)

    def _learnt_by(self, update: Update) -> LearnerState:
        if isinstance(update, PolicyUpdate):
            return LearnerState(update.state, self.state.residual)
        assert isinstance(update, ResidualUpdate)
        return LearnerState(self.state.policy, update.state)

    def _judge(self) -> bool:
        """Go on from a policy once it is flown, and from the last that still is; return whether one was taken back."""
        status = self._status()
        given_up, back = status.get("given_up", []), False
        while self._flown and self._flown[-1][0] in given_up:
            self._flown.pop()
            back = True
        if back:
            self.taken_back += 1
            self.worker.receive(self._flown[-1][1] if self._flown else _start(self.state))
        if self._pending is None:
            return back
        version, update, published = self._pending
        if version in given_up:
            self._pending = None
        elif status.get("newest", {}).get("policy", 0) >= version:
            self.worker.receive(update)
            self._flown, self._pending = [*self._flown[-REMEMBERED:], (version, update)], None
        elif self._clock() - published > VERDICT:
            self._pending = None  # it was damaged on the way, or nobody takes policies any more
        return back

    def _status(self) -> dict[str, Any]:
        return last_note(self.bus, "status")

    def _wanted(self) -> bool:
        """Nobody takes what is learnt after the policy has flown; what was flown last would be lost."""
        return self._status().get("mode", "policy") == "policy" and not last_note(self.bus, "learning").get(
            "paused", False
        )

    def _take_residual(self) -> None:
        """Take note of the newest fit, if it is new."""
        found = newest_update(self.bus, self.state, "residual", after=self._known.get("fit", 0))
        if found is not None:
            self._known["fit"] = found[0]
            self.worker.receive(found[1])

    def _fresh(self, topic: str) -> bytes | None:
        message = self.bus.latest(topic, self._known.get(topic, 0))
        if message is None:
            return None
        self._known[topic] = message.version
        return message.data

    def leave(self, folder: Path, patience: float = 3.0) -> None:
        """Write down what was learnt and flown last, once no policy flies any more, or after a while [s]."""
        until = self._clock() + patience
        while self._wanted() and self.bus.latest("ended") is None and self._clock() < until:
            time.sleep(CHECK_EVERY)
        learnt, outlet = learnt_from(self.bus, self.state, self._status()), Outlet(folder)
        if learnt is not None:
            outlet.write("what was learnt", partial(write_state, learnt, self.setup.preset))
        for fault in outlet.faults:
            print(fault, file=sys.stderr)


def _start(state: LearnerState) -> PolicyUpdate:
    return PolicyUpdate(0.0, 0.0, 0.0, state.policy)


def learn(plan: LearnerPlan) -> None:
    """Learn until the flight is over: the main function of the process."""
    with contextlib.suppress(OSError, AttributeError):
        os.nice(NICE)  # a browser or a terminal on the same machine answers before the next update is done
    enable_compile_cache()
    bus, parent = SharedMemoryBus(plan.folder), Lifeline(plan.parent)
    loop = LearnerLoop(plan, bus)
    loop.warm_up()
    loop.catch_up()
    bus.publish(f"ready.{plan.layer}", pack_note("ready", base=plan.base, device=jax.devices()[0].platform))
    with Pacemaker(bus, plan.layer) as heart:
        while not parent.gone() and bus.latest("ended") is None:
            heart.touch(LOOKING)
            window = loop.due()
            if window is None:
                time.sleep(CHECK_EVERY)
                continue
            heart.touch(COMPUTING)
            loop.learnt(loop.worker.learn(window))
    if plan.layer == "policy" and plan.out is not None:
        while not parent.gone(LOOKING):  # it writes down what was learnt, and ends this process
            pass
        loop.leave(plan.out)
