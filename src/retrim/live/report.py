"""What a live flight leaves: a log in the form of all others, errors, and the accounts of its deadlines."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..adapt.learner import LearnerState
from ..adapt.updates import PolicyUpdate, ResidualUpdate, unpack_update
from ..errors import MessageError, PlantError
from ..experiments.flights import Flight
from ..experiments.flying import scored, until_terminated
from ..experiments.recovery import change_times, recoveries
from ..io.trained import load_learnt
from ..onboard.accounts import EDGES_MS, summary
from ..onboard.guard import Mode
from ..onboard.messages import COMMAND, MEASURED, TRUE
from ..onboard.recorder import read_log
from ..runtime.events import Event
from ..runtime.flight import Log, States
from ..transport.bus import Bus
from .session import LAYERS, LiveRequest
from .supervisor import Status

HOVER = np.array([9.81, 0.0, 0.0, 0.0])


def flight_of(
    request: LiveRequest, events: Sequence[Event], status: Status, learnt: LearnerState | None
) -> tuple[Flight, np.ndarray]:
    """Return the flight that a log holds, up to its landing, and the rows of the log.

    Args:
        request: What was flown.
        events: What happened.
        status: The last one.
        learnt: What the learners knew at the end.

    Raises:
        PlantError: The log holds no flight.
    """
    rows = read_log(request.folder / "flight.csv")
    dt = request.setup.preset.dt
    shown = rows[rows[:, 1] < request.seconds - 0.5 * dt]
    if status.control.get("reason") == "landing":  # as ordered: what follows is not the policy's
        shown = shown[np.cumsum(shown[:, -1] != Mode.POLICY) == 0]
    if len(shown) < 2:
        raise PlantError(f"{request.folder / 'flight.csv'} holds {len(shown)} ticks: there was no flight")
    u = np.concatenate([HOVER[None], shown[:-1, COMMAND]])
    until = float(shown[-1, 1])
    log = Log(
        shown[:, 1],
        _states(shown[:, TRUE]),
        _states(shown[:, MEASURED]),
        u,
        dt,
        False,
        tuple(event for event in events if event.t <= until),
        shown[:, 2],
    )
    return scored(request.setup, request.flight, until_terminated(request.setup.flown, log), learnt), rows


def results(request: LiveRequest, flight: Flight, rows: np.ndarray, status: Status) -> list[dict[str, Any]]:
    """Return the rows of ``results.json``.

    Args:
        request: What was flown.
        flight: How.
        rows: All of its log, the landing too.
        status: The last one.
    """
    scenario, log = request.scenario, flight.log
    home = request.setup.flown.home()
    changes = change_times(scenario.disturbance, home, request.seconds)
    back = recoveries(log.t, flight.error, changes, 0.05, terminated=log.terminated)
    late, step = summary(rows[:, -3]), summary(rows[:, -2])
    policies = [swap for swap in status.control.get("swaps", []) if swap[1] == "policy"]
    values = {
        "missed_ticks": status.control.get("missed"),
        "lateness_p50_ms": late["p50"],
        "lateness_p99_ms": late["p99"],
        "lateness_max_ms": late["max"],
        "step_p50_ms": step["p50"],
        "step_p99_ms": step["p99"],
        "step_max_ms": step["max"],
        "steady": None if log.terminated else flight.steady,
        "recovery_5cm": float(np.mean(back)),
        "policies": status.control.get("versions", {}).get("policy", 0),
        "flight_to_swap_s": float(np.median([swap[3] for swap in policies])) if policies else None,
        "samples_late": status.world.get("late"),
        "commands_held": status.world.get("held"),
        "restarts": sum(status.restarts.values()),
        "refused_messages": sum(status.control.get("refused", {}).values()),
        "rollbacks": len(status.control.get("rolled_back", [0])) - 1,
        "fallback_ticks": int(np.sum(rows[rows[:, 1] < request.seconds, -1] != Mode.POLICY)),
    }
    about = {"scenario": scenario.disturbance, "method": request.method, "plant": scenario.plant, "n": 1,
             "crashes": int(log.terminated)}  # fmt: skip
    return [{**about, "metric": metric, "value": _finite(value)} for metric, value in values.items()]


def histograms(rows: np.ndarray) -> dict[str, Any]:
    """Return how late steps began and how long they took, as histograms [ms]."""
    return {
        "edges_ms": list(EDGES_MS),
        "lateness": summary(rows[:, -3])["histogram"],
        "step": summary(rows[:, -2])["histogram"],
    }


def _states(x: np.ndarray) -> States:
    return States(x[:, :3], x[:, 3:12].reshape(-1, 3, 3), x[:, 12:])


def _finite(value: Any) -> Any:
    return None if value is None or not np.isfinite(value) else value


def learnt_in(request: LiveRequest, bus: Bus) -> LearnerState | None:
    """Return what the learners published last; None if nothing was learnt, or what they said cannot be used."""
    state = load_learnt(request.folder / "start.safetensors")[0]
    found = False
    for layer in LAYERS:
        message = bus.latest(f"update.{layer}")
        try:
            update = None if message is None else unpack_update(message.data, state, source=layer)
        except MessageError:
            continue
        if isinstance(update, ResidualUpdate):
            state, found = LearnerState(state.policy, update.state), True
        elif isinstance(update, PolicyUpdate):
            state, found = LearnerState(update.state, state.residual), True
    return state if found else None


def complaints(folder: Path) -> list[Path]:
    """Return what the processes of a flight have written to their standard outputs, where it is not empty."""
    return [path for path in sorted(folder.glob("*.log")) if path.stat().st_size]
