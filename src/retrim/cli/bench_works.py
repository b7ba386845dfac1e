"""What ``retrim bench`` times. ``python -m retrim.cli.bench_works NAME`` does one piece of work and prints JSON."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Key

from .. import build, presets
from ..adapt.adapter import Adapter, AdaptState
from ..adapt.buffer import RollingBuffer
from ..adapt.gate import Verdict
from ..adapt.plant import ControllerPilot, fly
from ..adapt.plants.closed_loop import closed_loop
from ..control.controller import PolicyController
from ..learn.bptt import PolicyState
from ..learn.residual import Window
from ..physics.bem import Bem
from ..physics.state import Command, State
from ..physics.vehicle import small
from ..testbed import Setting, disturbance
from .bench_timing import Work, compiled, timed
from .bench_training import pretrain, see_and_pretrain
from .session import Stopwatch


def _learner(name: str = "paper") -> tuple[Adapter, AdaptState, Window]:
    """Adapter, its state with a residual that is not zero, and a full window of flight under the large disturbance."""
    preset = presets.load(name)
    policy = build.policy(preset, random.key(0))
    adapter = build.adapter(preset)
    plant = Setting().make("large")
    log_buffer = RollingBuffer(preset.adapt.window)
    sample = plant.reset(build.flight_starts(preset, 1)[0])
    for _ in range(preset.adapt.window):
        log_buffer.push(sample.t, sample.x, Command.hover())
        sample = plant.exchange(Command.hover())
    window = log_buffer.window()
    state = adapter.init(policy, build.residual(preset, random.key(1)))
    return adapter, state, window


def _burst(name: str) -> dict[str, Any]:
    adapter, state, window = _learner(name)
    fitted, _, _ = adapter.refine(state.residual, window)
    arguments = adapter, state.policy, fitted.residual, window, random.key(0)
    program, compile_s = compiled(Adapter.improve, *arguments)
    return timed(compile_s, lambda: program(*arguments), 9)


def _residual() -> dict[str, Any]:
    adapter, state, window = _learner()
    program, compile_s = compiled(Adapter.refine, adapter, state.residual, window)
    return timed(compile_s, lambda: program(adapter, state.residual, window), 9)


def _programs() -> dict[str, Any]:
    """Trace and compile, or load, everything a flight needs: policy, plant, residual fit, policy update."""
    from .flights import Campaign

    watch = Stopwatch()
    preset = presets.load("fast")
    campaign = Campaign(preset, build.policy(preset, random.key(0)), setting=Setting(), seconds=3.0, starts=1, seed=0)
    campaign.warm_up(["large"])
    return {"compile_s": watch.compile_s, "run_s": watch.total_s - watch.compile_s, "remarks": "preset fast"}


def _tick() -> dict[str, Any]:
    """One flight without adaptation: plant, observation, policy, checks."""
    preset = presets.load("fast")
    controller = PolicyController(build.task(preset).observation, build.policy(preset, random.key(0)))
    plant = Setting().make("none")
    x0 = build.flight_starts(preset, 1)[0]
    began = time.perf_counter()
    fly(plant, ControllerPilot(controller), x0, ticks=2)
    compile_s = time.perf_counter() - began
    row = timed(compile_s, lambda: fly(plant, ControllerPilot(controller), x0, ticks=1500).p, 5)
    row["remarks"] = f"{1000 * row['run_s'] / 1500:.2f} ms a tick; " + row["remarks"]
    return row


def _eight() -> dict[str, Any]:
    """Eight flights of 30 s on bem, plant and policy as one program; four on each of two threads."""
    preset = presets.load("fast")
    controller = PolicyController(build.task(preset).observation, build.policy(preset, random.key(0)))
    model, around, starts = Bem.of(small(), presets.DT), disturbance("none"), build.flight_starts(preset, 8)
    halves = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts[i : i + 4]) for i in (0, 4)]

    @jax.jit
    def four(controller: PolicyController, x0s: State) -> State:
        return lax.map(lambda x0: closed_loop(model, around, controller, x0, ticks=1500)[0], x0s)  # type: ignore[no-any-return]

    program, compile_s = compiled(four, controller, halves[0])
    with ThreadPoolExecutor(2) as pool:
        fly_all = lambda: list(pool.map(lambda x0s: jax.block_until_ready(program(controller, x0s)), halves))  # noqa: E731
        return timed(compile_s, fly_all, 3)


def _bem_tick() -> dict[str, Any]:
    """One exchange with the blade-element plant."""
    plant, u = Setting().make("none"), Command.hover()
    began = time.perf_counter()
    plant.reset(None)
    plant.exchange(u)
    compile_s = time.perf_counter() - began

    def ticks() -> Any:
        for _ in range(500):
            sample = plant.exchange(u)
        return sample.x.p

    row = timed(compile_s, ticks, 5)
    return row | {"run_s": row["run_s"] / 500, "remarks": f"500 ticks: {row['remarks']}"}


def _fleet(how: str) -> dict[str, Any]:
    """Eight bursts of eight vehicles."""
    adapter, state, window = _learner()
    fitted, _, _ = adapter.refine(state.residual, window)
    keys = random.split(random.key(0), 8)

    def one(state: AdaptState, window: Window, key: Key[Array, ""]) -> tuple[PolicyState, Verdict]:
        return adapter.improve(state.policy, state.residual.residual, window, key)

    state = AdaptState(state.policy, fitted)
    if how == "threads":
        jax.block_until_ready(one(state, window, keys[0]))
        with ThreadPoolExecutor(2) as pool:
            row = timed(0.0, lambda: list(pool.map(lambda k: jax.block_until_ready(one(state, window, k)), keys)), 3)
        return row | {"compile_s": None, "remarks": row["remarks"] + "; compiled as one update"}

    @jax.jit
    def fleet(state: AdaptState, window: Window, keys: Key[Array, "8"]) -> tuple[PolicyState, Verdict]:
        if how == "map":
            return lax.map(lambda key: one(state, window, key), keys)  # type: ignore[no-any-return]
        return jax.vmap(lambda key: one(state, window, key))(keys)

    program, compile_s = compiled(fleet, state, window, keys)
    return timed(compile_s, lambda: program(state, window, keys), 3)


def _demo() -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "retrim.cli", "demo", "--out", folder], check=True, stdout=subprocess.DEVNULL
        )
        total = time.perf_counter() - began
        with open(f"{folder}/results.json") as file:
            compile_s = json.load(file)["compile_s"]
    return {"compile_s": compile_s, "run_s": total - compile_s, "remarks": "48 flights of 30 s, 24 of them adapting"}


def _charged(title: str, name: str) -> Work:
    """An update beside the flight time that a preset charges for it."""
    return Work(title, f"{presets.load(name).adapt.improve_charge:g} s, its charge", lambda: _burst(name))


WORKS: dict[str, Work] = {
    "pretrain-paper": Work(
        "pretrain 300 x 100 x 150", "40 s", lambda: pretrain(presets.load("paper"), 1), "15 s", "50.6 s (5.1 s)"
    ),
    "pretrain-fast": Work("pretrain 150 x 16 x 150, to 5 mm", "6 s", lambda: pretrain(presets.load("fast"), 3)),
    "pretrain-track-paper": Work(
        "pretrain tracking 300 x 100 x 150", "45 s", lambda: pretrain(presets.load("track-paper"), 1)
    ),
    "pretrain-track": Work(
        "pretrain tracking 600 x 32 x 100, three references", "-", lambda: pretrain(presets.load("track"), 1)
    ),
    "pretrain-vision": Work(
        "learn to see, and pretrain 300 x 16 x 150", "30 s, to 0.02 m", lambda: see_and_pretrain("vision")
    ),
    "pretrain-vision-paper": Work(
        "learn to see, and pretrain 500 x 300 x 150",
        "360 s",
        lambda: see_and_pretrain("vision-paper"),
        authors="433 s",
    ),
    "burst": Work(
        "policy update 30 x 10 x 150, with residual",
        "0.8 s",
        lambda: _burst("paper"),
        "1.5 s",
        "2.5 s (6.1 s, each call)",
    ),
    "burst-track": _charged("policy update 30 x 10 x 100, preset track", "track"),
    "burst-vision": _charged("policy update 30 x 10 x 150, preset vision", "vision"),
    "burst-vision-paper": _charged("policy update 50 x 30 x 150, preset vision-paper", "vision-paper"),
    "residual": Work("residual, 3 nets x 100 iterations x 100 samples", "0.1 s", _residual, "2 s", "0.53 s (1.1 s)"),
    "programs-cold": Work("all programs of a flight, empty cache", "compile 60 s", _programs, cached=True),
    "programs-warm": Work("all programs of a flight, from the cache", "compile 5 s", _programs, cached=True),
    "bem-tick": Work("one tick of the plant bem", "0.002 s", _bem_tick),
    "bem-eight": Work("8 flights of 30 s on bem, one program", "10 s (goal 3 s)", _eight),
    "flight": Work("30 s of flight, not adapting", "-", _tick),
    "fleet-map": Work("8 policy updates, lax.map", "-", lambda: _fleet("map")),
    "fleet-vmap": Work("8 policy updates, vmap", "-", lambda: _fleet("vmap")),
    "fleet-threads": Work("8 policy updates, 2 threads", "-", lambda: _fleet("threads")),
    "demo": Work("retrim demo", "180 s in all, 2000 MB", _demo),
}


def main() -> None:
    """Do the work named on the command line and print its row."""
    work = WORKS[sys.argv[1]]
    found = work.do()
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    unit = 1024.0 if sys.platform != "darwin" else 1024.0**2
    known = {"goal": work.goal, "paper": work.paper, "authors": work.authors}
    print(json.dumps({"work": work.title, **known, "peak_mb": peak / unit, **found}))


if __name__ == "__main__":
    main()
