"""Learn for many vehicles in one process: updates that are due at the same time run as one program."""

import hashlib
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import random

from ..adapt.updates import Update
from ..adapt.worker import Worker
from ..adapt.workers import PolicyWorker
from ..config.loading import dump
from ..config.presets import Preset
from ..config.setup import Setup
from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy
from ..learn.bptt import PolicyState
from ..learn.window import Window
from ..runtime.fleet_learning import learn_base, learn_together, refused_by_all, room_for, shared_base
from ..transport.bus import Bus
from .learner_process import LearnerLoop, LearnerPlan

AT_ONCE, MANY = 4, 1024  # vehicles per program on a CPU and on an accelerator


class FleetLearner:
    """Learners of many vehicles. The learners do not wait for a vehicle whose window is late."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Initialise without vehicles; ``clock`` returns the time [s]."""
        self._members: dict[str, _Member] = {}
        self._clock, self._setups = clock, dict[tuple[str, str | None], Setup]()
        self._taken_back = dict[Any, int]()
        self._compiled = set[tuple[Any, int, bool]]()
        self._bases = dict[Any, PolicyState]()
        self._key = random.key(0)
        self._most = AT_ONCE if jax.default_backend() == "cpu" else MANY

    @property
    def loops(self) -> dict[str, LearnerLoop]:
        """Loops by the name of the vehicle and layer; the loop that has waited longest comes first."""
        return {name: member.loop for name, member in self._members.items()}

    def add(self, name: str, plan: LearnerPlan, bus: Bus, wanted: Callable[[], bool] = lambda: True) -> None:
        """Add a vehicle and layer to learn for.

        Args:
            name: Name of the vehicle and layer.
            plan: Plan of the learner.
            bus: Bus of the flight.
            wanted: Function that is called before each publication; it returns False if the vehicle has left.
        """
        loop = LearnerLoop(plan, bus, self._clock, self._setup_of)
        loop.catch_up()
        policy = loop.state.policy.policy
        base = fingerprint(policy.base) if isinstance(policy, LoraPolicy) else ""
        self._members[name] = _Member(loop, base, wanted)

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
                if (low_rank := _low_rank(workers)) and len(loops) > 1:
                    base = shared_base(low_rank[0].learner, low_rank[0].state)
                    learn_base(low_rank, windows, base, random.key(0))
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
            updates = self._learnt(kind, [members[name].loop for name in windows], list(windows.values()))
            for name, update in zip(windows, updates, strict=True):
                if members[name].wanted():
                    members[name].loop.learnt(update)
                self._members[name] = self._members.pop(name)  # move to the end of the queue
            done += len(windows)
        return done

    def _learnt(self, kind: Any, loops: list[LearnerLoop], windows: list[Window]) -> list[Update]:
        """Learn for some vehicles of a kind; low-rank policies share a base that learns from all of them."""
        workers, members = [loop.worker for loop in loops], self._kinds()[kind].values()
        low_rank = _low_rank(workers)
        if not low_rank or len(members) < 2:
            return learn_together(workers, windows)
        backs = sum(member.loop.rolled_back for member in members)
        if backs != self._taken_back.get(kind, backs):
            self._bases.pop(kind, None)  # control has rolled back a policy: continue from the policy in flight
        self._taken_back[kind] = backs
        before = self._bases.get(kind) or shared_base(low_rank[0].learner, low_rank[0].state)
        self._key, key = random.split(self._key)
        base = learn_base(low_rank, windows, before, key)
        updates = learn_together(workers, windows, base)
        self._bases[kind] = before if refused_by_all(updates) else base
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
    """Fingerprint of the base of a low-rank policy; empty for other policies."""
    wanted: Callable[[], bool]

    @property
    def kind(self) -> tuple[str, int, str]:
        """Key of the vehicles that share a program: layer, set-up (its reference may change in flight) and base."""
        return self.loop.plan.layer, id(self.loop.setup), self.base


def _low_rank(workers: Sequence[Worker]) -> list[PolicyWorker]:
    """Return the workers that learn a low-rank delta; for one kind, these are either all workers or none."""
    return [each for each in workers if isinstance(each, PolicyWorker) and isinstance(each.policy, LoraPolicy)]


def fingerprint(policy: AbstractPolicy) -> str:
    """Return a hash that identifies the weights of a policy."""
    leaves = jax.tree.leaves(eqx.filter(policy, eqx.is_array))
    return hashlib.sha256(b"".join(np.ascontiguousarray(leaf).tobytes() for leaf in leaves)).hexdigest()[:16]
