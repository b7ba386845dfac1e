"""Learn for many vehicles in one process: updates that are due at the same time run as one program."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax import random

from ...adapt.batched_workers import all_refuse, learn_base, learn_together, room_for, shared_base
from ...adapt.updates import Update
from ...config.loading import dump
from ...config.presets import Preset
from ...config.setup import Setup
from ...io.digests import tree_digest
from ...learn.bptt import PolicyState
from ...learn.window import Window
from ...transport.bus import Bus
from .learner import LearnerLoop, LearnerPlan

CPU_BATCH, ACCELERATOR_BATCH = 4, 1024  # vehicles per program on a CPU and on an accelerator


class FleetLearner:
    """Learners of many vehicles. The learners do not wait for a vehicle whose window is late."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Initialise without vehicles; ``clock`` returns the time [s]."""
        self._members: dict[str, _Member] = {}
        self._clock, self._setups = clock, dict[tuple[str, str | None], Setup]()
        self._rollbacks = dict[Any, int]()
        self._compiled = set[tuple[Any, int, bool]]()
        self._bases = dict[Any, PolicyState]()
        self._key = random.key(0)
        self._most = CPU_BATCH if jax.default_backend() == "cpu" else ACCELERATOR_BATCH

    @property
    def loops(self) -> dict[str, LearnerLoop]:
        """Loops by the name of the vehicle and layer; the loop that has waited longest comes first."""
        return {name: member.loop for name, member in self._members.items()}

    def add(self, name: str, plan: LearnerPlan, bus: Bus, is_active: Callable[[], bool] = lambda: True) -> None:
        """Add a vehicle and layer to learn for.

        Args:
            name: Name of the vehicle and layer.
            plan: Plan of the learner.
            bus: Bus of the flight.
            is_active: Function that is called before each publication; it returns False if the vehicle has left.
        """
        loop = LearnerLoop(plan, bus, self._clock, self._setup_of)
        loop.catch_up()
        low_rank = loop.new_worker().low_rank
        base = "" if low_rank is None else tree_digest(low_rank.base)
        self._members[name] = _Member(loop, base, is_active)

    def drop(self, name: str) -> None:
        """Stop learning for a vehicle and layer."""
        self._members.pop(name, None)

    def warm_up(self) -> None:
        """Compile the current vehicles' programs for each number of vehicles that may be due at once."""
        for kind, members in self._kinds().items():
            loops = [member.loop for member in members.values()]
            for n in (1 << k for k in range(room_for(min(len(loops), self._most)).bit_length())):
                if (kind, n, len(loops) > 1) in self._compiled:
                    continue
                some = [loops[i % len(loops)] for i in range(n)]
                workers, windows = [loop.new_worker() for loop in some], [loop.dummy_window() for loop in some]
                learn_together(workers, windows)
                if workers[0].low_rank is not None and len(loops) > 1:
                    learn_base(workers, windows, shared_base(workers[0]), random.key(0))
                self._compiled.add((kind, n, len(loops) > 1))

    def step(self) -> int:
        """Learn for the vehicles that are due, the longest-waiting first; return their number.

        On a CPU, a few vehicles fill a core. With more vehicles in one program, each would only wait for the others.
        The remaining vehicles are due in the next step and learn from the window at that time.
        """
        done = 0
        for kind, members in self._kinds().items():
            windows = dict[str, Window]()
            for name, member in members.items():
                if len(windows) < self._most and (window := member.loop.due()) is not None:
                    windows[name] = window
            if not windows:
                continue
            updates = self._learn(kind, [members[name].loop for name in windows], list(windows.values()))
            for name, update in zip(windows, updates, strict=True):
                if members[name].is_active():
                    members[name].loop.publish_update(update)
                self._members[name] = self._members.pop(name)  # move to the end of the queue
            done += len(windows)
        return done

    def _learn(self, kind: Any, loops: list[LearnerLoop], windows: list[Window]) -> list[Update]:
        """Learn for some vehicles of a kind; low-rank policies share a base that learns from all of them."""
        workers, members = [loop.worker for loop in loops], self._kinds()[kind].values()
        if workers[0].low_rank is None or len(members) < 2:
            return learn_together(workers, windows)
        backs = sum(member.loop.rolled_back for member in members)
        if backs != self._rollbacks.get(kind, backs):
            self._bases.pop(kind, None)  # control has rolled back a policy: continue from the policy in flight
        self._rollbacks[kind] = backs
        before = self._bases.get(kind) or shared_base(workers[0])
        self._key, key = random.split(self._key)
        base = learn_base(workers, windows, before, key)
        updates = learn_together(workers, windows, base)
        self._bases[kind] = before if all_refuse(updates) else base
        return updates

    def _setup_of(self, preset: Preset, reference: str | None) -> Setup:
        """Return the set-up for a preset and a reference.

        Vehicles with the same preset and reference share a learner, so their updates can run as one program.
        """
        key = dump(preset), reference
        if key not in self._setups:
            self._setups[key] = Setup.from_preset(preset, reference)
        return self._setups[key]

    def _kinds(self) -> dict[Any, dict[str, "_Member"]]:
        """Return the members of each kind, by name."""
        result: dict[Any, dict[str, _Member]] = {}
        for name, member in self._members.items():
            result.setdefault(member.kind, {})[name] = member
        return result


class _Member(NamedTuple):
    """One vehicle and layer."""

    loop: LearnerLoop
    base: str
    """Digest of the base of the worker's low-rank policy; empty for other workers."""
    is_active: Callable[[], bool]

    @property
    def kind(self) -> tuple[str, int, str]:
        """Key of the vehicles that share a program: layer, set-up (its reference may change in flight) and base."""
        return self.loop.plan.layer, id(self.loop.setup), self.base
