"""One process that learns for many vehicles: what is due at an instant is learnt as one program."""

import hashlib
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import random

from ..adapt.updates import Update
from ..adapt.workers import PolicyWorker, Worker
from ..config.loading import dump
from ..config.presets import Preset
from ..config.setup import Setup
from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..learn.bptt import PolicyState
from ..learn.window import Window
from ..runtime.fleet_learning import learn_base, learn_together, refused_by_all, room_for, shared_base
from ..transport.bus import Bus
from .learner_process import LearnerLoop, LearnerPlan

AT_ONCE, MANY = 4, 1024  # vehicles of one program: on a CPU, on an accelerator


class FleetLearner:
    """The learners of many vehicles. A vehicle whose window is late is not waited for."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Build one without vehicles; ``clock`` tells the time [s]."""
        self._members: dict[str, _Member] = {}
        self._clock, self._setups = clock, dict[tuple[str, str | None], Setup]()
        self._taken_back = dict[Any, int]()
        self._compiled = set[tuple[Any, int, bool]]()
        self._bases = dict[Any, PolicyState]()
        self._key = random.key(0)
        self._most = AT_ONCE if jax.default_backend() == "cpu" else MANY

    @property
    def loops(self) -> dict[str, LearnerLoop]:
        """The loops by the name of a vehicle and layer, those first that have waited longest."""
        return {name: member.loop for name, member in self._members.items()}

    def add(self, name: str, plan: LearnerPlan, bus: Bus, wanted: Callable[[], bool] = lambda: True) -> None:
        """Learn for one more vehicle and layer, from now on.

        Args:
            name: Its name.
            plan: What to learn.
            bus: Of the flight.
            wanted: Asked before something is published, since who wanted it may be gone meanwhile.
        """
        loop = LearnerLoop(plan, bus, self._clock, self._setup_of)
        loop.catch_up()
        policy = loop.state.policy.policy
        base = fingerprint(policy.base) if isinstance(policy, LoraPolicy) else ""
        self._members[name] = _Member(loop, base, wanted)

    def drop(self, name: str) -> None:
        """Learn no more for it."""
        self._members.pop(name, None)

    def warm_up(self) -> None:
        """Compile what the present vehicles need, however many of them are due at once."""
        for kind, members in self._kinds().items():
            loops = [member.loop for member in members.values()]
            for n in (1 << k for k in range(room_for(min(len(loops), self._most)).bit_length())):
                if (kind, n, len(loops) > 1) in self._compiled:
                    continue
                some = [loops[i % len(loops)] for i in range(n)]
                workers, windows = [loop.new_worker() for loop in some], [loop.made_up_window() for loop in some]
                learn_together(workers, windows)
                if (low_rank := _low_rank(workers)) and len(loops) > 1:
                    base = shared_base(low_rank[0].learner, low_rank[0].state)
                    learn_base(low_rank, windows, base, random.key(0))
                self._compiled.add((kind, n, len(loops) > 1))

    def step(self) -> int:
        """Learn for vehicles that are due, those first that have waited longest; return for how many.

        On a CPU a few of them fill a core, and more at once would only let each wait for the others. Those that are
        left are due in the next step, and learn from a window that is as new as that.
        """
        done = 0
        for kind, members in self._kinds().items():
            windows = dict[str, Window]()
            for name, member in members.items():
                if len(windows) < self._most and (window := member.loop.due()) is not None:
                    windows[name] = window
            if not windows:
                continue
            updates = self._learnt(kind, [members[name].loop for name in windows], list(windows.values()))
            for name, update in zip(windows, updates, strict=True):
                if members[name].wanted():
                    members[name].loop.learnt(update)
                self._members[name] = self._members.pop(name)  # to the end
            done += len(windows)
        return done

    def _learnt(self, kind: Any, loops: list[LearnerLoop], windows: list[Window]) -> list[Update]:
        """Learn for some vehicles of a kind; low-rank policies put their deltas on a base that learns from all."""
        workers, members = [loop.worker for loop in loops], self._kinds()[kind].values()
        low_rank = _low_rank(workers)
        if not low_rank or len(members) < 2:
            return learn_together(workers, windows)
        backs = sum(member.loop.taken_back for member in members)
        if backs != self._taken_back.get(kind, backs):
            self._bases.pop(kind, None)  # control has taken a policy back: go on from what flies
        self._taken_back[kind] = backs
        before = self._bases.get(kind) or shared_base(low_rank[0].learner, low_rank[0].state)
        self._key, key = random.split(self._key)
        base = learn_base(low_rank, windows, before, key)
        updates = learn_together(workers, windows, base)
        self._bases[kind] = before if refused_by_all(updates) else base
        return updates

    def _setup_of(self, preset: Preset, reference: str | None) -> Setup:
        """Vehicles with the same preset and reference share a learner, so that they can be one program."""
        key = dump(preset), reference
        if key not in self._setups:
            self._setups[key] = Setup.of(preset, reference)
        return self._setups[key]

    def _kinds(self) -> dict[Any, dict[str, "_Member"]]:
        """Return the members of each kind, by name."""
        found: dict[Any, dict[str, _Member]] = {}
        for name, member in self._members.items():
            found.setdefault(member.kind, {})[name] = member
        return found


class _Member(NamedTuple):
    """One vehicle and layer."""

    loop: LearnerLoop
    base: str
    """Of what is learnt as a delta."""
    wanted: Callable[[], bool]

    @property
    def kind(self) -> tuple[str, int, str]:
        """What is one program: the layer, the learner, whose reference may change in flight, and the base."""
        return self.loop.plan.layer, id(self.loop.setup), self.base


def _low_rank(workers: Sequence[Worker]) -> list[PolicyWorker]:
    """Return workers that learn a delta; those of one kind all do, or none."""
    return [each for each in workers if isinstance(each, PolicyWorker) and isinstance(each.policy, LoraPolicy)]


def fingerprint(policy: Policy) -> str:
    """Return what tells the weights of a policy apart from others."""
    leaves = jax.tree.leaves(eqx.filter(policy, eqx.is_array))
    return hashlib.sha256(b"".join(np.ascontiguousarray(leaf).tobytes() for leaf in leaves)).hexdigest()[:16]
