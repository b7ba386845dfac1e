"""What a live flight leaves: a log in the form of all others, errors, and the accounts of its deadlines."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..adapt.learner import LearnerState
from ..errors import PlantError
from ..experiments.flights import Flight
from ..experiments.flying import scored, until_terminated
from ..experiments.recovery import change_times, recoveries
from ..io.trained import load_learnt
from ..onboard.accounts import EDGES_MS, accounted, measured, summary
from ..onboard.guard import HOVER, Mode
from ..onboard.messages import ACCOUNTS, COMMAND, MEASURED, STOPPED, TRUE
from ..onboard.recorder import read_log
from ..onboard.stalls import lost_in
from ..runtime.events import Event
from ..runtime.flight import Log, States
from ..transport.bus import Bus
from .events import LiveEvents
from .plant_process import CRASHED
from .published import learnt_from
from .session import LiveRequest
from .status import Status

GAP_S = 0.5  # [s] of a log that may be missing: a machine that stands still sends nothing


def flight_of(
    request: LiveRequest, events: Sequence[Event], status: Status, learnt: LearnerState | None, path: Path
) -> tuple[Flight, np.ndarray]:
    """Return the flight that a log holds, up to its landing, and the rows of the log.

    Args:
        request: What was flown.
        events: What happened.
        status: The last one.
        learnt: What the learners knew at the end.
        path: The log.

    Raises:
        PlantError: The log holds no flight.
    """
    rows = read_log(path)
    dt = request.setup.preset.dt
    shown = rows[(rows[:, 1] < request.seconds - 0.5 * dt) & measured(rows)]
    if status.control.get("reason") == "landing":  # as ordered: what follows is not the policy's
        by_policy = np.flatnonzero(shown[:, -1] == Mode.POLICY)
        shown = shown[: by_policy[-1] + 1] if len(by_policy) else shown[:0]
    if len(shown) < 2:
        raise PlantError(f"{path} holds {len(shown)} ticks: there was no flight")
    u = np.concatenate([HOVER[None], shown[:-1, COMMAND]])
    log = Log(
        shown[:, 1],
        _states(shown[:, TRUE]),
        _states(shown[:, MEASURED]),
        u,
        dt,
        False,
        tuple(events),
        shown[:, 2],
    )
    return scored(request.setup, request.flight, until_terminated(request.setup.flown, log), learnt), rows


def results(
    request: LiveRequest, flight: Flight, rows: np.ndarray, status: Status, events: LiveEvents
) -> list[dict[str, Any]]:
    """Return the rows of ``results.json``; nothing of the landing counts.

    Args:
        request: What was flown.
        flight: How.
        rows: All of its log, the landing too.
        status: The last one.
        events: What happened.
    """
    scenario, log = request.scenario, flight.log
    end = float(log.t[-1])
    changes = change_times(scenario.disturbance, request.setup.flown.home(), end)
    # The state of a crash may be none that is written down.
    lost = (status.ended or "").startswith((CRASHED, STOPPED)) and status.control.get("reason") != "landing"
    crashed = log.terminated or lost
    back = recoveries(log.t, flight.error, changes, 0.05, terminated=crashed)
    flown = rows if lost else rows[rows[:, 1] <= end]
    by = {name: summary(flown[accounted(flown), column]) for name, column in ACCOUNTS.items()}
    policies = [swap for swap in events.swaps if swap[1] == "policy" and swap[0] <= end]
    given_up = status.control.get("given_up", [])
    values = {
        "missed_ticks": status.control.get("missed"),
        **_stalls(status, log.dt),
        **{f"{name}_{q}_ms": by[name][q] for name in ("lateness", "step", "idle") for q in ("p50", "p99", "max")},
        "state_age_p99_ms": by["state_age"]["p99"],
        "policy_age_p50_s": None if by["policy_age"]["p50"] is None else 1e-3 * by["policy_age"]["p50"],
        "steady": None if crashed else flight.steady,
        "recovery_5cm": float(np.mean(back)),
        "policies": len(policies),
        "flight_to_swap_s": float(np.median([swap[3] for swap in policies])) if policies else None,
        "samples_late": status.world.get("late"),
        "commands_held": status.world.get("held"),
        "simulation_lost_s": status.world.get("lost"),
        "restarts": sum(status.restarts.values()),
        "refused_messages": sum(status.control.get("refused", {}).values()) + status.refused_notes,
        "taken_back": len(given_up),
        "fallback_ticks": int(np.sum(flown[:, -1] != Mode.POLICY)),
    }
    about = {"scenario": scenario.disturbance, "method": request.method, "plant": scenario.plant, "n": 1,
             "crashes": int(crashed)}  # fmt: skip
    return [{**about, "metric": metric, "value": _finite(value)} for metric, value in values.items()]


def _stalls(status: Status, dt: float) -> dict[str, Any]:
    """When the machine stood still, and how many ticks were missed then; None where nobody could tell."""
    seen = status.stalls
    if not seen:
        return dict.fromkeys(("missed_in_stalls", "stalls", "stall_max_ms"))
    missed = lost_in(seen["newest"], status.control.get("gaps", []), dt)
    return {"missed_in_stalls": missed, "stalls": seen["count"], "stall_max_ms": 1e3 * seen["longest"]}


def missing(rows: np.ndarray, status: Status, dt: float) -> list[str]:
    """Return which part of a flight its log does not hold, in a line; none if it holds all that was flown.

    Args:
        rows: All of the log.
        status: The last one.
        dt: Control tick [s].
    """
    ticks = np.concatenate([[-1], rows[:, 0], [max(status.ticks, rows[-1, 0] + 1 if len(rows) else 0)]])
    gaps = np.diff(ticks) - 1
    missed = max((int(n) for *_, n in status.control.get("gaps", [])), default=0)  # nobody flew those
    if gaps.max() <= missed + GAP_S / dt:
        return []
    at = int(np.argmax(gaps))
    begin, end = (float(dt * (tick + 1)) for tick in (ticks[at], ticks[at + 1] - 1))
    part = f"{len(rows)} of {ticks[-1]:.0f} ticks, none from {begin:.2f} to {end:.2f} s"
    return [f"the log is shorter than the flight: it holds {part}"]


def histograms(rows: np.ndarray) -> dict[str, Any]:
    """Return how late steps began and how long they took, as histograms [ms]."""
    flown = rows[accounted(rows)]
    return {"edges_ms": list(EDGES_MS)} | {
        name: summary(flown[:, ACCOUNTS[name]])["histogram"] for name in ("lateness", "step", "idle")
    }


def _states(x: np.ndarray) -> States:
    return States(x[:, :3], x[:, 3:12].reshape(-1, 3, 3), x[:, 12:])


def _finite(value: Any) -> Any:
    return None if value is None or not np.isfinite(value) else value


def learnt_in(bus: Bus, status: Status, start: Path, trust: Collection[str] = ()) -> LearnerState | None:
    """Return what was learnt and flown last; None if nothing was.

    Args:
        bus: Of the flight.
        status: How it stands.
        start: File with what the learners went on from.
        trust: Python names that it may hold.
    """
    return learnt_from(bus, load_learnt(start, trust=trust)[0], status.control)


def complaints(folder: Path) -> list[Path]:
    """Return the files with what processes wrote to their standard outputs; those that are empty are removed."""
    found = sorted(folder.glob("*.log"))
    for path in found:
        if not path.stat().st_size:
            path.unlink()
    return [path for path in found if path.exists()]
