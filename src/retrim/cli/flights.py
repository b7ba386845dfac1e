"""Many flights of one policy: several disturbances, methods and starts, on as many threads as there are cores."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from .. import build, presets
from ..adapt.buffer import RollingBuffer
from ..adapt.lockstep import AdaptivePilot, Event
from ..adapt.plant import ControllerPilot, Log, Pilot, Plant, Sample, fly
from ..control.controller import PolicyController
from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..physics.state import State
from ..presets import Preset
from ..tasks.reference import Reference
from ..tasks.task import AbstractTask
from ..tasks.track import AbstractTrack
from ..testbed import Setting
from .session import console

Method = Literal["base", "full", "lora"]
LEARNERS = 2  # folded into a seed for the learners of flights
LOW_RANK = 0  # folded into a learner's key for the delta that it starts from
STEADY = {
    "hover": 2.0,
    "vision": 2.0,
    "track": 10.0,
}  # [s]: the error of a flight is the mean over this long at its end


@dataclass(frozen=True)
class Plan:
    """One flight to fly."""

    disturbance: str
    method: Method
    start: int
    """Number of the start; also seeds the flight's learner."""


@dataclass(frozen=True)
class Flight:
    """One flight flown."""

    plan: Plan
    log: Log
    error: np.ndarray
    """The task's error at each tick [m]."""
    events: tuple[Event, ...]
    task: str = "hover"
    learnt: Policy | LoraPolicy | None = None
    """The policy at the end of a flight that adapted."""
    cross: np.ndarray | None = None
    """Tracking: distance from the nearest point of the lap at each tick [m]."""

    @property
    def steady(self) -> float:
        """Mean error over the last seconds, as the task has it [m]; NaN after a crash."""
        return self._last(self.error)

    @property
    def cross_track(self) -> float | None:
        """The same of the cross-track error; None for other tasks."""
        return None if self.cross is None else self._last(self.cross)

    def _last(self, error: np.ndarray) -> float:
        ticks = round(STEADY[self.task] / presets.DT)
        return float("nan") if self.log.crashed else float(error[-ticks:].mean())

    @property
    def swaps(self) -> tuple[float, ...]:
        """When a new policy took over [s]."""
        return tuple(e.t for e in self.events if e.kind == "policy")


class Campaign:
    """Flies plans for one policy. ``stop`` is set by Ctrl-C: what is flown is kept, what is flying is given up."""

    def __init__(
        self,
        preset: Preset,
        policy: Policy,
        *,
        setting: Setting,
        seconds: float,
        starts: int,
        seed: int,
        measured: bool = False,
        flown: Reference | None = None,
    ) -> None:
        self.preset, self.policy = preset, policy
        self._ticks, self._seed, self._workers = round(seconds / presets.DT), seed, 1 if measured else _cores()
        self._flown, self._measured = flown, measured
        self._adapter = build.adapter(preset, flown)
        self._seen = build.seen_in_flight(preset, flown)
        self.setting = setting
        self._starts = build.flight_starts(preset, starts, seed, flown)
        self.stop = threading.Event()

    def warm_up(self, disturbances: Iterable[str], methods: Iterable[Method] = ("base", "full")) -> None:
        """Compile every program of the flights before the first take-off."""
        x0 = self._starts[0]
        with console.status("compiling the programs of a flight (kept in a cache for the next time) ..."):
            pilot = self._pilot(0, "full")
            for disturbance in dict.fromkeys(disturbances):
                plant = self._plant(disturbance, 0)
                fly(plant, pilot, x0, ticks=2, alive=self._alive)
            buffer = RollingBuffer(self.preset.adapt.window)
            buffer.push(0.0, x0, self.policy.u_hover)
            window, residual = buffer.window(), pilot.state.residual
            jax.block_until_ready(self._adapter.refine(residual, window))
            for method in dict.fromkeys(methods):
                if method != "base":
                    policy = self._pilot(0, method).state.policy
                    key = random.key(0)
                    jax.block_until_ready(self._adapter.improve(policy, residual.residual, window, key))

    def fly(self, plans: Sequence[Plan]) -> tuple[list[Flight], bool]:
        """The flights in the order of ``plans``, and whether Ctrl-C cut them short (then some are missing).

        With ``--charge measured`` they fly one after another, so that none is charged for another's work.
        """
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[flown]}"),
            TimeRemainingColumn(),
        )
        futures: dict[Plan, Future[Flight]] = {}
        interrupted = False
        with Progress(*columns, console=console) as progress, ThreadPoolExecutor(self._workers) as pool:
            bar = progress.add_task("flying", total=len(plans) * self._ticks, flown="")
            try:
                for plan in plans:
                    futures[plan] = pool.submit(self._fly, plan, _Ticker(progress, bar))
                for flown, future in enumerate(as_completed(futures.values()), start=1):
                    future.result()
                    progress.update(bar, flown=f"{flown} of {len(plans)} flights")
            except KeyboardInterrupt:
                interrupted = True
                self.stop.set()
            except BaseException:
                self.stop.set()
                raise
            finally:
                with _deaf_to_interrupts():  # a further Ctrl-C must not lose what is done
                    pool.shutdown(wait=True, cancel_futures=True)
        done = (futures[plan] for plan in plans if plan in futures)
        return [f.result() for f in done if not f.cancelled() and f.exception() is None], interrupted

    def _pilot(self, start: int, method: Method) -> AdaptivePilot:
        key = random.fold_in(random.fold_in(random.key(self._seed), LEARNERS), start)
        policy = build.lora(self.policy, random.fold_in(key, LOW_RANK)) if method == "lora" else self.policy
        return build.pilot(self.preset, policy, key, self._flown, measured=self._measured)

    def _plant(self, disturbance: str, start: int) -> Plant:
        """The same gusts and sensor noise for every method that flies from a start."""
        return self.setting.make(disturbance, seed=1000 * self._seed + start)

    def _fly(self, plan: Plan, ticker: "_Ticker") -> Flight:
        adaptive = None if plan.method == "base" else self._pilot(plan.start, plan.method)
        pilot: Pilot = adaptive or ControllerPilot(PolicyController(self._seen, self.policy))
        plant = self._plant(plan.disturbance, plan.start)
        log = fly(plant, pilot, self._starts[plan.start], ticks=self._ticks, alive=self._alive, sinks=(ticker,))
        error, cross = _errors(self._adapter.task, log.t, log.x)
        events = tuple(adaptive.events) if adaptive else ()
        off_lap = None if cross is None else np.asarray(cross)
        return Flight(
            plan,
            log,
            np.asarray(error),
            events,
            self.preset.task,
            adaptive.state.policy.policy if adaptive else None,
            off_lap,
        )

    def _alive(self, sample: Sample) -> bool:
        if self.stop.is_set():
            raise _Stopped
        return bool(_still_alive(self._adapter.task, np.float64(sample.t), sample.really))


class _Stopped(Exception):
    """A flight was given up."""


@eqx.filter_jit
def _still_alive(task: AbstractTask, t: Any, x: State) -> Array:
    return task.alive(jnp.asarray(t, dtype=x.p.dtype), x)


@eqx.filter_jit
def _errors(task: AbstractTask, t: Any, x: State) -> tuple[Array, Array | None]:
    error = jax.vmap(task.error)(jnp.asarray(t, dtype=x.p.dtype), x)
    return error, lax.map(task.cross_track, x) if isinstance(task, AbstractTrack) else None


@contextlib.contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Ignore Ctrl-C for a moment; only the main thread may, and only it receives one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Ticker:
    """Moves the progress bar, once a second of flight."""

    def __init__(self, progress: Progress, bar: Any) -> None:
        self._progress, self._bar, self._ticks = progress, bar, 0

    def state(self, sample: Sample) -> None:
        self._ticks += 1
        if self._ticks % 50 == 0:
            self._progress.advance(self._bar, 50)

    def event(self, kind: str, **data: object) -> None:
        """Not shown."""


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
