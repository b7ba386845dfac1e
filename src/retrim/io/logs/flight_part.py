"""Selects the ticks of a log at which the vehicle flies with complete data, and reports why others are excluded."""

from pathlib import Path

import numpy as np

from ...errors import LogError
from .ground import on_ground
from .jumps import jumps_of
from .marks import Marks
from .on_one_clock import Ticks
from .resampling import around, runs

LEAST = 1.0  # shortest flight [s]
JUMP = 15.0  # difference from the velocity above which a position has jumped [m/s]
ENDS = 2  # ticks without a derivative at each end and next to a jump
FROZEN = 0.3  # time after which a constant position in the air counts as frozen [s]


def flight_part(path: Path, ticks: Ticks, marks: Marks, *, measured_position: bool) -> tuple[np.ndarray, list[str]]:
    """Return the ticks at which the vehicle flies with complete data, and notes on the excluded ones.

    Args:
        path: The log file, for messages.
        ticks: The log on one clock.
        marks: The autopilot's marks.
        measured_position: Whether the log contains positions.

    Raises:
        LogError: Too little flight data remains.
    """
    notes, dt, valid = list[str](), ticks.dt, ticks.known & _finite(ticks)
    most, least = ticks.thrust[ticks.known].max(initial=-np.inf), ticks.thrust[ticks.known].min(initial=np.inf)
    if most == least == 0.0:
        raise LogError(f"{path}: thrust is 0 throughout; thrust.fields must name the command that is in use")
    if most <= 0.0 and ticks.known.any():
        raise LogError(f'{path}: thrust is never above zero; if it points downwards the map must say positive = "down"')
    for name, holds in marks.holds.items():
        if gap := float(np.sum(~holds) * dt):
            notes.append(f"{name} was not valid for {gap:.1f} s, which are left out")
        valid &= around(holds, ENDS)
    ground = on_ground(ticks) if valid.any() else np.zeros(len(valid), dtype=bool)
    ground |= marks.on_ground
    if (ground_time := float(np.sum(ground) * dt)) > 0.5:
        detector_note = (
            f" (its land detector says {np.sum(marks.on_ground) * dt:.1f} s)" if marks.on_ground.any() else ""
        )
        notes.append(f"{ground_time:.1f} s on the ground{detector_note} are left out")
    valid &= ~ground
    for name in ("velocity", "attitude"):
        resets, airborne_jumps = marks.resets.get(name, np.zeros(len(valid), dtype=bool)), jumps_of(ticks, name)
        if (both := (resets | airborne_jumps) & valid).any():
            notes.append(
                f"{name} jumps {np.sum(both)} times ({np.sum(resets & both)} resets by its counter); the ticks around "
                "are left out"
            )
        valid &= around(~(resets | airborne_jumps), ENDS)
    if measured_position:
        more, jump_notes = _moves(path, ticks, ~ground, marks)
        valid &= more
        notes += jump_notes
    if np.sum(valid) * dt < LEAST:
        why = f" ({'; '.join(notes)})" if notes else ""
        raise LogError(f"{path}: {np.sum(valid) * dt:.2f} s of flight are left, at least {LEAST:g} s are needed{why}")
    return valid, notes


def _finite(ticks: Ticks) -> np.ndarray:
    """Return where all quantities are finite; damaged times may lead to values that are not."""
    columns = [ticks.p, ticks.v, ticks.a, ticks.rates, ticks.thrust[:, None], ticks.R.reshape(-1, 9)]
    if ticks.command is not None:
        columns.append(ticks.command)
    return np.asarray(np.all(np.isfinite(np.concatenate(columns, axis=1)), axis=1))


def _moves(path: Path, ticks: Ticks, airborne: np.ndarray, marks: Marks) -> tuple[np.ndarray, list[str]]:
    """Return where positions neither jump nor freeze."""
    notes, dt = list[str](), ticks.dt
    steps = np.diff(ticks.p, axis=0) - 0.5 * dt * (ticks.v[1:] + ticks.v[:-1])
    steps[np.diff(ticks.t) > 2.0 * dt] = 0.0  # a pause
    jumps = np.concatenate([[False], np.linalg.norm(steps, axis=1) > JUMP * dt + 0.05])
    still = np.concatenate([[False], np.all(np.diff(ticks.p, axis=0) == 0.0, axis=1)])
    frozen = runs(still, max(2, round(FROZEN / dt))) & airborne
    if airborne.any() and np.mean(frozen[airborne]) > 0.5:
        raise LogError(f"{path}: position does not change for {np.sum(frozen) * dt:.1f} s of the flight")
    if frozen.any():
        notes.append(f"position does not change for {np.sum(frozen) * dt:.2f} s in the air, which are left out")
    if np.mean(jumps) > 0.2:
        raise LogError(
            f"{path}: position moves {np.median(np.linalg.norm(steps, axis=1)) / dt:.3g} m/s faster than velocity says "
            f"in {100 * np.mean(jumps):.0f} % of the flight; are the units right?"
        )
    jumps |= marks.resets.get("position", np.zeros(len(jumps), dtype=bool))
    if (airborne_jumps := jumps[1:] & airborne[1:]).any():
        far = np.linalg.norm(steps, axis=1)[airborne_jumps].max()
        notes.append(
            f"position jumps {np.sum(airborne_jumps)} times, by up to {far:.2f} m; the ticks around are left out"
        )
    return ~frozen & around(~jumps, ENDS), notes
