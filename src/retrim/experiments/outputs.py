"""Files that a run leaves: a trained policy; events and logs of flights, and what they learnt."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..adapt.learner import LearnerState
from ..config.presets import Preset
from ..config.setup import Setup
from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..io.checkpoint import save_delta
from ..io.files import write_whole
from ..io.logs.recording import Recording, write_npz
from ..io.logs.viewers import can_record, record
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


def write_flights(flights: Sequence[Flight], preset: Preset, folder: Path) -> None:
    """Write events and logs of flights, and what they learnt, in the place of those of earlier ones."""
    clear_outputs(folder)
    write_events(flights, folder)
    write_logs(flights, folder)
    write_learnt(flights, preset, folder)


def clear_outputs(folder: Path) -> None:
    """Remove what an earlier command left of flights in a folder that is used again, before new files are written."""
    for name in ("learnt.safetensors", "adapted.safetensors", "delta.safetensors", "events.jsonl"):
        (folder / name).unlink(missing_ok=True)
    for log in (folder / "logs").glob("*"):
        if log.suffix in (".npz", ".mcap"):
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
    """Write each flight under ``logs/``: as NPZ, and as MCAP where what writes it is installed."""
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    for flight in flights:
        spec, recording = flight.spec, recording_of(flight)
        path = folder / "logs" / f"{spec.method}_seed{spec.seed}_start{spec.start}.mcap"
        write_npz(path.with_suffix(".npz"), recording)
        if can_record(path):
            record(path, recording)


def recording_of(flight: Flight) -> Recording:
    """Return what is recorded of a flight."""
    log = flight.log
    measured, true = (np.concatenate([x.p, x.R.reshape(-1, 9), x.v], axis=1) for x in (log.measured, log.true))
    follows = np.concatenate([log.u[1:], log.u[-1:]])  # a log's row has the command of the tick that it ended
    age = np.broadcast_to(log.age, log.t.shape)
    return Recording(
        log.t,
        measured,
        true,
        age,
        follows,
        flight.error,
        flight.target,
        events=flight.events,
        terminated=log.terminated,
    )


def write_learnt(flights: Sequence[Flight], preset: Preset, folder: Path) -> None:
    """Write what the first whole adapting flight learnt.

    ``learnt.safetensors`` (to go on from), and ``adapted.safetensors`` (a policy) or ``delta.safetensors`` (of a
    low-rank one).
    """
    learnt = next((f.learnt for f in flights if f.learnt is not None and not f.log.terminated), None)
    if learnt is not None:
        write_state(learnt, preset, folder)


def write_state(learnt: LearnerState, preset: Preset, folder: Path) -> None:
    """Write what was learnt, to go on from, and the policy or the low-rank delta that came of it."""
    save_learnt(folder / "learnt.safetensors", learnt, preset)
    policy = learnt.policy.policy
    if isinstance(policy, LoraPolicy):
        save_delta(folder / "delta.safetensors", policy)
    else:
        save_policy(folder / "adapted.safetensors", policy, preset)
