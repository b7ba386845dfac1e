"""Files that a run leaves: a trained policy; events and logs of flights, and what they learnt."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..config.presets import Preset
from ..config.setup import Setup
from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..io.checkpoint import save_delta
from ..io.files import write_whole
from ..io.trained import save_learnt, save_policy
from .flights import Flight
from .interrupts import interrupts_only_set
from .run import Run


def write_trained(
    run: Run, setup: Setup, policy: Policy, losses: Sequence[float], *, seed: int, error_m: float | None = None
) -> Path:
    """Write ``policy.safetensors`` with its ``results.json``; a Ctrl-C comes after both.

    Args:
        run: Where to.
        setup: Preset of the policy.
        policy: What was trained.
        losses: Loss of each optimiser step.
        seed: Seed of the training.
        error_m: Error in the policy's own model [m], once it is known.

    Returns:
        Path of the policy.

    Raises:
        OSError: The folder cannot be written any more.
    """
    preset, path = setup.preset, run.folder / "policy.safetensors"
    row: dict[str, Any] = {"task": preset.task, "preset": preset.name, "updates": len(losses)}
    row |= {"envs": preset.pretrain.num_envs, "loss": losses[-1]}
    row |= {} if error_m is None else {"nominal_error_m": error_m}
    with interrupts_only_set(run.stop):
        save_policy(path, policy, preset)
        run.write_results([row], seeds=[seed], losses=list(losses))
    return path


def clear_outputs(folder: Path) -> None:
    """Remove what an earlier command left of flights in a folder that is used again, before new files are written."""
    for name in ("learnt.safetensors", "adapted.safetensors", "delta.safetensors", "events.jsonl"):
        (folder / name).unlink(missing_ok=True)
    for log in (folder / "logs").glob("*.npz"):
        log.unlink()


def write_events(flights: Sequence[Flight], folder: Path) -> None:
    """Write ``events.jsonl``: what adaptation did, and why a flight was terminated, flight by flight."""
    lines = [
        json.dumps(
            {
                "event": event.kind,
                "disturbance": flight.spec.scenario.disturbance,
                "method": flight.spec.method,
                "seed": flight.spec.seed,
                "start": flight.spec.start,
                "t": round(event.t, 6),
                "note": event.note,
            }
        )
        for flight in flights
        for event in flight.events
    ]
    write_whole(folder / "events.jsonl", "".join(line + "\n" for line in lines))


def write_logs(flights: Sequence[Flight], folder: Path) -> None:
    """Write one NPZ for each flight under ``logs/``: times, true and measured states, commands, errors."""
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    for flight in flights:
        spec, log = flight.spec, flight.log
        name = f"{spec.method}_seed{spec.seed}_start{spec.start}"
        with (folder / "logs" / f"{name}.npz.partial").open("wb") as file:
            np.savez_compressed(
                file,
                t=log.t,
                p=log.true.p,
                R=log.true.R,
                v=log.true.v,
                p_measured=log.measured.p,
                R_measured=log.measured.R,
                v_measured=log.measured.v,
                u=log.u,
                age=np.broadcast_to(log.age, log.t.shape),
                error=flight.error,
                terminated=log.terminated,
            )
        (folder / "logs" / f"{name}.npz.partial").replace(folder / "logs" / f"{name}.npz")


def write_learnt(flights: Sequence[Flight], preset: Preset, folder: Path) -> None:
    """Write what the first whole adapting flight learnt.

    ``learnt.safetensors`` (to go on from), and ``adapted.safetensors`` (a policy) or ``delta.safetensors`` (of a
    low-rank one).
    """
    learnt = next((f.learnt for f in flights if f.learnt is not None and not f.log.terminated), None)
    if learnt is None:
        return
    save_learnt(folder / "learnt.safetensors", learnt, preset)
    policy = learnt.policy.policy
    if isinstance(policy, LoraPolicy):
        save_delta(folder / "delta.safetensors", policy)
    else:
        save_policy(folder / "adapted.safetensors", policy, preset)
