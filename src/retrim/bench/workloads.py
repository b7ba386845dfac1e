"""Define the benchmarks; ``python -m retrim.bench.workloads NAME`` runs one and prints its result as JSON."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from functools import partial
from typing import Any

from jax import random

from ..adapt.learner import GATE_STARTS, OnlineLearner
from ..config.loading import load
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..evaluation.fleet import Fleet
from ..onboard.launch import PYTHON
from ..physics.state import Command
from ..progress import no_progress
from ..runkit.stopwatch import Stopwatch
from ..runtime.flight import fly
from .background_load import policies
from .fleet import eight_flights, on_threads, one_after_another, side_by_side
from .flight import learner_in_flight
from .machine import on_core, rates
from .timing import Work, compile_function, time_runs
from .training import encode_and_pretrain, pretrain
from .vehicles import live_fleet


def _update(name: str, *, lora: bool = False) -> dict[str, Any]:
    """Time a policy update, which needs three products per training step and one per tick of the gate."""
    learner, state, window = learner_in_flight(name)
    if lora:
        policy = Setup.from_preset(load(name)).low_rank(state.policy.policy, random.key(2))
        state = learner.init(policy, random.key(1))
    residual, _ = learner.fit_residual(state.residual, window)
    arguments = learner, state.policy, residual, window, random.key(0)
    program, compile_s = compile_function(OnlineLearner.update_policy, *arguments)
    weights = sum(layer.weight.size for layer in state.policy.policy.merged().linear_layers())
    ticks = learner.env.task.horizon * (3 * learner.num_updates * learner.num_envs + 2 * GATE_STARTS)
    return time_runs(compile_s, lambda: program(*arguments), 9) | {"flop": 2.0 * weights * ticks}


def _residual(name: str = "hover/paper") -> dict[str, Any]:
    learner, state, window = learner_in_flight(name)
    program, compile_s = compile_function(OnlineLearner.fit_residual, learner, state.residual, window)
    return time_runs(compile_s, lambda: program(learner, state.residual, window), 9)


def _programs() -> dict[str, Any]:
    """Trace and compile (or load) all programs of a flight: policy, plant, residual fit and policy update."""
    watch, preset = Stopwatch(), load("hover/fast")
    policy = Setup.from_preset(preset).new_policy(random.key(0))
    Fleet(preset, policy, [Scenario("large")], starts=1, seconds=3.0).warm_up()
    return {"compile_s": watch.compile_s, "run_s": watch.total_s - watch.compile_s, "remarks": "preset hover/fast"}


def _tick() -> dict[str, Any]:
    """Time a flight without adaptation: plant, observation, policy and checks."""
    setup = Setup.from_preset("hover/fast")
    policy, plant, x0 = setup.new_policy(random.key(0)), Scenario().make(), setup.flight_starts(1)[0]
    began = time.perf_counter()
    fly(plant, setup.pilot(policy), x0, ticks=2, progress=no_progress)
    compile_s = time.perf_counter() - began
    row = time_runs(compile_s, lambda: fly(plant, setup.pilot(policy), x0, ticks=1500, progress=no_progress).p, 5)
    row["remarks"] = f"{1000 * row['run_s'] / 1500:.2f} ms a tick; " + row["remarks"]
    return row


def _bem_tick() -> dict[str, Any]:
    """Time one step of the blade-element plant."""
    plant, u = Scenario().make(), Command.hover()
    began = time.perf_counter()
    plant.reset(None)
    plant.step(u)
    compile_s = time.perf_counter() - began

    def ticks() -> Any:
        for _ in range(500):
            measurement, _ = plant.step(u)
        return measurement.x.p

    row = time_runs(compile_s, ticks, 5)
    per_tick = {"run_s": row["run_s"] / 500, "units": row["units"] / 500}
    return row | per_tick | {"remarks": f"500 ticks: {row['remarks']}"}


def _demo() -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        subprocess.run([*PYTHON, "retrim.cli", "demo", "--out", folder], check=True, stdout=subprocess.DEVNULL)
        total = time.perf_counter() - began
        with open(f"{folder}/results.json") as file:
            compile_s = json.load(file)["compile_s"]
    return {"compile_s": compile_s, "run_s": total - compile_s, "remarks": "48 flights of 30 s, 24 of them adapting"}


def _with_latency(title: str, name: str) -> Work:
    """Return a policy-update benchmark whose goal is the latency that the preset assumes for an update."""
    return Work(title, f"{load(name).adapt.update_latency:g} s, its latency", lambda: _update(name))


WORKLOADS: dict[str, Work] = {
    "pretrain-retrim": Work(
        "pretrain hover/retrim, 300 x 16 x 150", "2.5 s, to 5 mm", lambda: pretrain("hover/retrim", 3), one_core=True
    ),
    "pretrain-paper": Work("pretrain hover/paper, 300 x 100 x 150", "40 s", lambda: pretrain("hover/paper", 1), "15 s"),
    "pretrain-fast": Work("pretrain hover/fast, 150 x 16 x 150", "6 s, to 5 mm", lambda: pretrain("hover/fast", 3)),
    "pretrain-track": Work("pretrain track/retrim, 1200 x 32 x 100", "-", lambda: pretrain("track/retrim", 1)),
    "pretrain-track-paper": Work(
        "pretrain track/paper, 300 x 100 x 150", "45 s", lambda: pretrain("track/paper", 1)
    ),
    "pretrain-vision": Work(
        "encoder, and pretrain vision/retrim, 300 x 16 x 150", "30 s", lambda: encode_and_pretrain("vision/retrim")
    ),
    "pretrain-vision-paper": Work(
        "encoder, and pretrain vision/paper, 500 x 300 x 150", "360 s", lambda: encode_and_pretrain("vision/paper")
    ),
    "update-retrim": Work(
        "burst 5 x 10 x 150, hover/retrim", "0.05 s on one core", lambda: _update("hover/retrim"), one_core=True
    ),
    "policies": Work("burst beside a flight at 50 Hz, hover/retrim", "0.1 s, 10 a second", policies, two_cores=True),
    "update-track-retrim": Work(
        "burst 5 x 10 x 100, track/retrim", "0.1 s, its latency", lambda: _update("track/retrim"), one_core=True
    ),
    "update-vision-retrim": Work(
        "burst 5 x 10 x 150, vision/retrim", "0.1 s, its latency", lambda: _update("vision/retrim"), one_core=True
    ),
    "update": Work(
        "policy update 30 x 10 x 150, hover/paper", "0.85 s on one core", lambda: _update("hover/paper"), "1.5 s",
        one_core=True,
    ),
    "update-lora": Work("policy update 30 x 10 x 150, LoRA", "-", lambda: _update("hover/fast", lora=True)),
    "update-track": _with_latency("policy update 30 x 10 x 100, track/preview", "track/preview"),
    "update-vision": _with_latency("policy update 30 x 10 x 150, vision/ideal", "vision/ideal"),
    "update-vision-paper": _with_latency("policy update 50 x 30 x 150, vision/paper", "vision/paper"),
    "residual": Work("residual, 3 nets x 100 steps x 100 samples", "0.1 s", _residual, "2 s", one_core=True),
    "residual-retrim": Work(
        "residual, regression on 100 samples", "0.01 s", lambda: _residual("hover/retrim"), one_core=True
    ),
    "residual-track-retrim": Work(
        "residual, layered: regression, 3 small nets x 10 steps", "0.02 s, its latency",
        lambda: _residual("track/retrim"), one_core=True,
    ),
    "programs-cold": Work("all programs of a flight, empty cache", "compile 60 s", _programs, cached=True),
    "programs-warm": Work("all programs of a flight, from the cache", "compile 5 s", _programs, cached=True),
    "bem-tick": Work("one tick of the plant bem", "0.002 s", _bem_tick, one_core=True),
    "bem-eight": Work("8 flights of 30 s on bem, one program", "3 s", eight_flights, one_core=True),
    "flight": Work("30 s of flight, not adapting", "-", _tick, one_core=True),
    "fleet-map": Work("8 policy updates, lax.map", "-", one_after_another),
    "fleet-vmap": Work("8 policy updates, vmap", "-", side_by_side),
    "fleet-threads": Work("8 policy updates, 2 threads", "-", on_threads),
    **{
        f"vehicles-{n}": Work(
            f"{n} vehicles live at 50 Hz, one process learns for all", "16 within 4 times the delay of one",
            partial(live_fleet, n), two_cores=True,
        )
        for n in (1, 4, 16)
    },
    "demo": Work("retrim demo", "75 s in all, 2000 MB", _demo),
}  # fmt: skip


def main() -> None:
    """Run the benchmark that the command line names, on one core if the second word is ``one``; print the row."""
    if sys.argv[2:] == ["one"]:
        on_core(0)
    if sys.argv[1] == "machine":
        print(json.dumps(rates()))
        return
    work = WORKLOADS[sys.argv[1]]
    result = work.do()
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    unit = 1024.0 if sys.platform != "darwin" else 1024.0**2
    limits = {"goal": work.goal, "paper": work.paper}
    print(json.dumps({"work": work.title, **limits, "peak_mb": peak / unit, **result}))


if __name__ == "__main__":
    main()
