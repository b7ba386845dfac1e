"""Many flights of one policy: several disturbances, methods and starts, on as many threads as there are cores."""

import os
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any, Literal

import jax
import numpy as np
from jax import random
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from .. import presets
from ..adapt.buffer import RollingBuffer
from ..adapt.lockstep import AdaptivePilot, Event
from ..adapt.plant import ControllerPilot, Log, Pilot, Sample, fly
from ..adapt.plants.sim import SimPlant
from ..adapt.sink import Sink
from ..control.controller import PolicyController
from ..control.policy import Policy
from ..presets import Preset
from .session import console

Method = Literal["base", "full"]
STEADY = 2.0  # [s]: the steady-state error is the mean over this long at the end of a flight


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

    @property
    def steady(self) -> float:
        """Mean error over the last two seconds [m]; NaN after a crash."""
        ticks = round(STEADY / presets.DT)
        return float("nan") if self.log.crashed else float(self.error[-ticks:].mean())

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
        vehicle: str,
        seconds: float,
        starts: int,
        seed: int,
        measured: bool = False,
        sinks: Sequence[Sink] = (),
    ) -> None:
        self.preset, self.policy = preset, policy
        self._ticks, self._seed, self._sinks = round(seconds / presets.DT), seed, tuple(sinks)
        self._adapter = presets.adapter(preset)
        self._schedule = presets.schedule(preset, measured=measured)
        self._model = presets.plant_model(vehicle)
        self._starts = presets.flight_starts(preset, starts, seed)
        self.stop = threading.Event()

    def warm_up(self) -> None:
        """Compile every program of a flight before the first take-off."""
        x0 = self._starts[0]
        with console.status("compiling the programs of a flight (kept in a cache for the next time) ..."):
            plan = Plan("none", "full", 0)
            plant = SimPlant(self._model, presets.disturbance(plan.disturbance))
            pilot = self._pilot(plan)
            fly(plant, pilot, x0, ticks=2)
            buffer = RollingBuffer(self.preset.adapt.window)
            buffer.push(x0, self.policy.u_hover)
            state, window = pilot.state, buffer.window()
            jax.block_until_ready(self._adapter.refine(state.residual, window))
            key = random.key(0)
            jax.block_until_ready(self._adapter.improve(state.policy, state.residual.residual, window, key))

    def fly(self, plans: Sequence[Plan]) -> tuple[list[Flight], bool]:
        """The flights in the order of ``plans``, and whether Ctrl-C cut them short (then some are missing)."""
        done: dict[Plan, Flight] = {}
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[flown]}"),
            TimeRemainingColumn(),
        )
        workers = max(1, min(len(plans), _cores()))
        interrupted = False
        with Progress(*columns, console=console) as progress, ThreadPoolExecutor(workers) as pool:
            bar = progress.add_task("flying", total=len(plans) * self._ticks, flown="")
            futures: dict[Future[Flight], Plan] = {
                pool.submit(self._fly, plan, _Ticker(progress, bar)): plan for plan in plans
            }
            try:
                for future in as_completed(futures):
                    done[futures[future]] = future.result()
                    progress.update(bar, flown=f"{len(done)} of {len(plans)} flights")
            except KeyboardInterrupt:
                interrupted = True
                self.stop.set()
                pool.shutdown(wait=True, cancel_futures=True)
            except BaseException:
                self.stop.set()
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        return [done[plan] for plan in plans if plan in done], interrupted

    def _pilot(self, plan: Plan) -> AdaptivePilot:
        k_residual, k_learn = random.split(random.fold_in(random.key(self._seed + 1), plan.start))
        state = self._adapter.init(self.policy, presets.residual(self.preset, k_residual))
        return AdaptivePilot(
            self._adapter,
            state,
            self._schedule,
            k_learn,
            dt=presets.DT,
            window=self.preset.adapt.window,
            sinks=self._sinks,
        )

    def _fly(self, plan: Plan, ticker: "_Ticker") -> Flight:
        adaptive = self._pilot(plan) if plan.method == "full" else None
        pilot: Pilot = adaptive or ControllerPilot(PolicyController(self._adapter.task.observation, self.policy))
        plant = SimPlant(self._model, presets.disturbance(plan.disturbance))
        goal, box = np.array(self.preset.goal), self.preset.box

        def alive(sample: Sample) -> bool:
            if self.stop.is_set():
                raise KeyboardInterrupt
            away = np.abs(np.asarray(sample.x.p) - goal)
            return bool((away <= box).all())  # false for NaN too

        log = fly(plant, pilot, self._starts[plan.start], ticks=self._ticks, alive=alive, sinks=(ticker,))
        error = np.linalg.norm(log.p - goal, axis=1)
        return Flight(plan, log, error, tuple(adaptive.events) if adaptive else ())


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


def rows(flights: Sequence[Flight], *, task: str, plant: str, vehicle: str) -> list[dict[str, Any]]:
    """One row of results per disturbance and method: mean and standard deviation over the starts that survived."""
    table = []
    for disturbance, method in dict.fromkeys((f.plan.disturbance, f.plan.method) for f in flights):
        group = [f for f in flights if (f.plan.disturbance, f.plan.method) == (disturbance, method)]
        steady = np.array([f.steady for f in group if not f.log.crashed])
        table.append(
            {
                "task": task,
                "plant": plant,
                "vehicle": vehicle,
                "disturbance": disturbance,
                "method": method,
                "metric": "steady_error_m",
                "mean": float(steady.mean()) if len(steady) else None,
                "std": float(steady.std(ddof=1)) if len(steady) > 1 else None,
                "n": len(group),
                "crashes": sum(f.log.crashed for f in group),
            }
        )
    return table


def cell(row: dict[str, Any]) -> str:
    """Mean +- standard deviation [m], with crashes."""
    if row["mean"] is None:
        return f"crashed, {row['crashes']} of {row['n']}"
    text = f"{row['mean']:.3f}" + (f" ± {row['std']:.3f}" if row["std"] is not None else "")
    return text + (f", {row['crashes']} of {row['n']} crashed" if row["crashes"] else "")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
