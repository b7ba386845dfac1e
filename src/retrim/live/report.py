"""Results of a live flight: a log in the common format, errors, and deadline statistics."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..adapt.learner_state import LearnerState
from ..errors import PlantError
from ..io.policies import load_learner_state
from ..onboard.guard import HOVER, Mode
from ..onboard.messages import ACCOUNTS, COMMAND, MEASURED, PHASE, STOPPED, TRUE
from ..onboard.recorder import read_log
from ..onboard.stalls import count_lost_ticks
from ..onboard.timing_stats import EDGES_MS, has_measurement, is_from_control, summary
from ..runkit.flights import Flight
from ..runkit.flying import cut_at_termination, score_flight
from ..runkit.recovery import change_times, recoveries
from ..runtime.events import Event
from ..runtime.flight import Log, States
from ..transport.bus import Bus
from .events import LiveEvents
from .processes.plant import CRASHED
from .processes.published_updates import active_learner_state
from .roles import ROLES
from .session import LiveRequest
from .status import Status

GAP_S = 0.5  # [s], allowed gap in a log, since a stalled machine does not send messages


def flight_of(
    request: LiveRequest, events: Sequence[Event], status: Status, learner_state: LearnerState | None, path: Path
) -> tuple[Flight, np.ndarray]:
    """Return the flight in a log, up to its landing, and all rows of the log.

    Args:
        request: Request for the flight.
        events: Events of the flight.
        status: Last status.
        learner_state: Learned state at the end.
        path: Path of the log.

    Raises:
        PlantError: The log does not contain a flight.
    """
    rows = read_log(path)
    dt = request.setup.preset.dt
    flight_rows = rows[(rows[:, 1] < request.seconds - 0.5 * dt) & has_measurement(rows)]
    if status.control.get("reason") == "landing":  # ordered landing: exclude the ticks after the policy
        by_policy = np.flatnonzero(flight_rows[:, -1] == Mode.POLICY)
        flight_rows = flight_rows[: by_policy[-1] + 1] if len(by_policy) else flight_rows[:0]
    if len(flight_rows) < 2:
        raise PlantError(f"{path} holds {len(flight_rows)} ticks: there was no flight")
    u = np.concatenate([HOVER[None], flight_rows[:-1, COMMAND]])
    log = Log(
        flight_rows[:, 1],
        _states(flight_rows[:, TRUE]),
        _states(flight_rows[:, MEASURED]),
        u,
        dt,
        False,
        tuple(events),
        flight_rows[:, 2],
        None if request.setup.pace is None else flight_rows[:, PHASE],
    )
    return score_flight(
        request.setup, request.flight, cut_at_termination(request.setup.flight_task, log), learner_state
    ), rows


def results(
    request: LiveRequest, flight: Flight, rows: np.ndarray, status: Status, events: LiveEvents
) -> list[dict[str, Any]]:
    """Return the rows of ``results.json``; the results exclude the landing.

    Args:
        request: Request for the flight.
        flight: Flight, up to its landing.
        rows: All rows of the log, including the landing.
        status: Last status.
        events: Events of the flight.
    """
    scenario, log = request.scenario, flight.log
    end = float(log.t[-1])
    changes = change_times(scenario.disturbance, request.setup.flight_task.home(), end)
    # The log may lack the state at the crash.
    is_lost = (status.end_reason or "").startswith((CRASHED, STOPPED)) and status.control.get("reason") != "landing"
    has_crashed = log.terminated or is_lost
    back = recoveries(log.t, flight.error, changes, 0.05, terminated=has_crashed)
    control_rows = rows if is_lost else rows[rows[:, 1] <= end]
    by = {name: summary(control_rows[is_from_control(control_rows), column]) for name, column in ACCOUNTS.items()}
    policies = [swap for swap in events.swaps if swap[1] == "policy" and swap[0] <= end]
    withdrawals = status.control.get("given_up", [])
    values = {
        "missed_ticks": status.control.get("missed"),
        **_stalls(status, log.dt),
        **{f"{name}_{q}_ms": by[name][q] for name in ("lateness", "step", "idle") for q in ("p50", "p99", "max")},
        "state_age_p99_ms": by["state_age"]["p99"],
        "policy_age_p50_s": None if by["policy_age"]["p50"] is None else 1e-3 * by["policy_age"]["p50"],
        "steady": None if has_crashed else flight.steady,
        "recovery_5cm": float(np.mean(back)),
        "policies": len(policies),
        "flight_to_swap_s": float(np.median([swap[3] for swap in policies])) if policies else None,
        "samples_late": status.world.get("late"),
        "commands_held": status.world.get("held"),
        "simulation_lost_s": status.world.get("lost"),
        "restarts": sum(status.restarts.values()),
        "refused_messages": sum(status.control.get("refused", {}).values()) + status.refused_notes,
        "rolled_back": len(withdrawals),
        "fallback_ticks": int(np.sum(control_rows[:, -1] != Mode.POLICY)),
    }
    about = {"scenario": scenario.disturbance, "method": request.method, "plant": scenario.plant, "n": 1,
             "crashes": int(has_crashed)}  # fmt: skip
    return [{**about, "metric": metric, "value": _finite(value)} for metric, value in values.items()]


def _stalls(status: Status, dt: float) -> dict[str, Any]:
    """Return the machine's stalls and the ticks missed in them; the values are null without stall reports."""
    stalls = status.stalls
    if not stalls:
        return dict.fromkeys(("missed_in_stalls", "stalls", "stall_max_ms"))
    missed_ticks = count_lost_ticks(stalls["newest"], status.control.get("gaps", []), dt)
    return {"missed_in_stalls": missed_ticks, "stalls": stalls["count"], "stall_max_ms": 1e3 * stalls["longest"]}


def missing(rows: np.ndarray, status: Status, dt: float) -> list[str]:
    """Return one line about the part of a flight that is missing from its log; an empty list if the log is complete.

    Args:
        rows: All rows of the log.
        status: Last status.
        dt: Control tick [s].
    """
    ticks = np.concatenate([[-1], rows[:, 0], [max(status.ticks, rows[-1, 0] + 1 if len(rows) else 0)]])
    gaps = np.diff(ticks) - 1
    missed_ticks = max((int(n) for *_, n in status.control.get("gaps", [])), default=0)  # control missed these ticks
    if gaps.max() <= missed_ticks + GAP_S / dt:
        return []
    at = int(np.argmax(gaps))
    begin, end = (float(dt * (tick + 1)) for tick in (ticks[at], ticks[at + 1] - 1))
    part = f"{len(rows)} of {ticks[-1]:.0f} ticks, none from {begin:.2f} to {end:.2f} s"
    return [f"the log is shorter than the flight: it holds {part}"]


def histograms(rows: np.ndarray) -> dict[str, Any]:
    """Return histograms of the lateness, duration and idle time of control steps [ms]."""
    control_rows = rows[is_from_control(rows)]
    return {"edges_ms": list(EDGES_MS)} | {
        name: summary(control_rows[:, ACCOUNTS[name]])["histogram"] for name in ("lateness", "step", "idle")
    }


def _states(x: np.ndarray) -> States:
    return States(x[:, :3], x[:, 3:12].reshape(-1, 3, 3), x[:, 12:])


def _finite(value: Any) -> Any:
    return None if value is None or not np.isfinite(value) else value


def collect_learner_state(bus: Bus, status: Status, start: Path, trust: Collection[str] = ()) -> LearnerState | None:
    """Return the last learned state that was used in flight; None if no update was used.

    Args:
        bus: Bus of the flight.
        status: Current status.
        start: File with the initial state of the learners.
        trust: Python names that the file may contain.
    """
    return active_learner_state(bus, load_learner_state(start, trust=trust)[0], status.control)


def complaints(folder: Path) -> list[Path]:
    """Return the files with the processes' standard output and error; remove empty files."""
    result = [path for role in sorted(ROLES) if (path := folder / f"{role}.log").exists()]
    for path in result:
        if not path.stat().st_size:
            path.unlink()
    return [path for path in result if path.exists()]
