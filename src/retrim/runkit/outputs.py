"""Writes the output files of a run: a trained policy, and the flights' events, logs and learned parameters."""

import json
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..adapt.learner_state import LearnerState
from ..config.presets import Preset
from ..config.setup import Setup
from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy
from ..io.checkpoint import save_delta
from ..io.files import write_whole
from ..io.logs.recording import Recording, write_npz
from ..io.logs.viewers import can_record, record
from ..io.policies import save_learner_state, save_policy
from .flights import Flight
from .interrupts import interrupts_only_set
from .run import Run

POLICY = "policy.safetensors"
LOG = re.compile(r".+_seed\d+_start\d+\.(npz|mcap)")
"""Name of a flight's log; see :func:`write_logs`."""


def write_trained_policy(
    run: Run, setup: Setup, policy: AbstractPolicy, losses: Sequence[float], *, seed: int, error_m: float | None = None
) -> Path:
    """Write ``policy.safetensors`` and its ``results.json``; Ctrl-C takes effect after both are written.

    The policy of an interrupted run does not replace an earlier policy: it goes to the folder ``interrupted``.

    Args:
        run: Run whose folder receives the files.
        setup: Set-up of the policy's preset.
        policy: The trained policy.
        losses: Loss at each optimiser step.
        seed: Training seed.
        error_m: Error in the policy's own model [m], once it is known.

    Returns:
        Path of the policy.

    Raises:
        OSError: The folder cannot be written.
    """
    if run.interrupted and (run.folder / POLICY).exists():
        run = run.at(run.folder / "interrupted")
    preset, path = setup.preset, run.folder / POLICY
    row: dict[str, Any] = {"task": preset.task, "preset": preset.name, "updates": len(losses)}
    row |= {"envs": preset.pretrain.num_envs, "loss": losses[-1]}
    row |= {} if error_m is None else {"nominal_error_m": error_m}
    with interrupts_only_set(run.stop):
        save_policy(path, policy, preset)
        run.write_results([row], seeds=[seed], losses=list(losses))
    return path


def clear_outputs(folder: Path, inputs: Collection[Path] = ()) -> None:
    """Remove the flight files of an earlier command from a folder, before new ones are written.

    Args:
        folder: Folder of the run. Files of the user in this folder have other names and remain.
        inputs: Files that the present command reads. They remain until a new file replaces them.
    """
    names = ("learner_state.safetensors", "adapted.safetensors", "delta.safetensors", "events.jsonl")
    logs = (log for log in (folder / "logs").glob("*") if LOG.fullmatch(log.name))
    for path in (*(folder / name for name in names), *logs):
        if path.resolve() not in inputs:
            path.unlink(missing_ok=True)


def write_events(flights: Sequence[Flight], folder: Path) -> None:
    """Write ``events.jsonl``: the adaptation events and the reason for a termination, flight by flight."""
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
    """Write each flight to ``logs/`` as NPZ, and also as MCAP if the MCAP writer is installed."""
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    for flight in flights:
        spec, recording = flight.spec, recording_of(flight)
        path = folder / "logs" / f"{spec.method}_seed{spec.seed}_start{spec.start}.mcap"
        write_npz(path.with_suffix(".npz"), recording)
        if can_record(path):
            record(path, recording)


def recording_of(flight: Flight) -> Recording:
    """Return a flight's recording."""
    log = flight.log
    measurement, true = (np.concatenate([x.p, x.R.reshape(-1, 9), x.v], axis=1) for x in (log.measured, log.true))
    follows = np.concatenate([log.u[1:], log.u[-1:]])  # a log's row contains the command of the tick that it ends
    age = np.broadcast_to(log.age, log.t.shape)
    return Recording(
        log.t,
        measurement,
        true,
        age,
        follows,
        flight.error,
        flight.target,
        events=flight.events,
        terminated=log.terminated,
    )


def write_learner_state(flights: Sequence[Flight], preset: Preset, folder: Path) -> None:
    """Write the learner state of the first adapting flight that was not terminated.

    The files are ``learner_state.safetensors``, to resume from, and ``adapted.safetensors`` (a policy) or
    ``delta.safetensors`` (for a low-rank policy).
    """
    learner_state = next(
        (f.learner_state for f in flights if f.learner_state is not None and not f.log.terminated), None
    )
    if learner_state is not None:
        write_state(learner_state, preset, folder)


def write_state(learner_state: LearnerState, preset: Preset, folder: Path) -> Path:
    """Write a learner state to resume from, and its policy or low-rank delta; return the path of the latter."""
    save_learner_state(folder / "learner_state.safetensors", learner_state, preset)
    policy = learner_state.policy.policy
    if isinstance(policy, LoraPolicy):
        save_delta(path := folder / "delta.safetensors", policy)
    else:
        save_policy(path := folder / "adapted.safetensors", policy, preset)
    return path
