"""Checks a log's consistency, and finds mistakes in its map's units, frames and signs.

If figures from :mod:`retrim.io.logs.agreement` are low, every map that differs in one statement is tried. If the log
agrees far better with one of these maps, the error names this map. A log that is inconsistent with every map is
refused. A log with low agreement is read, but with a warning.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...errors import LogError
from .agreement import CLAIMS, agreement, heading_between
from .log_map import LogMap
from .on_one_clock import Ticks
from .other_maps import Other, others, with_heading

SUSPICION = 0.05  # unexplained share above which other maps are tried
IMPROVEMENT = 5.0  # factor by which another map must reduce the remainder
LEAST_AGREEMENT = 0.75  # of another map
PART = 3000  # number of ticks in a long log that are used to try other maps
REFUSAL_LIMITS = {"motion": 0.0, "lift": 0.0, "thrust": 0.0, "turning": -0.3, "gyroscope": -0.3}
"""Agreement below which a log is refused."""
DOUBT_LIMITS = {"motion": 0.75, "lift": 0.5, "thrust": 0.65, "climb": 0.25, "turning": 0.5, "gyroscope": 0.75}
"""Agreement below which a report begins with a warning."""


def check_plausible(
    path: Path, log_map: LogMap, ticks: Ticks, read: Callable[[Other, slice], Ticks], valid: np.ndarray
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Check that a log's quantities agree with each other.

    Args:
        path: The log file, for messages.
        log_map: The map.
        ticks: The log, read with the map.
        read: Reads a part of the log with a different map.
        valid: Mask of the ticks that are used.

    Returns:
        The agreement figures, where 1 is complete agreement, and a warning for each low figure.

    Raises:
        LogError: The quantities do not agree; the message names the wrong statement in the map, if there is one.
    """
    scores = agreement(log_map, ticks, valid)
    wrong = {name: score for name, score in scores.items() if score < 1.0 - SUSPICION and name != "climb"}
    if wrong and (correction := _find_correction(log_map, read, valid)):
        raise LogError(f"{path}: {correction}")
    for name, score in sorted(wrong.items(), key=lambda item: item[1]):
        if score < REFUSAL_LIMITS[name]:
            raise LogError(
                f"{path}: {EXPLANATIONS[name]} ({100 * score:.0f} % agreement), and no other unit, frame or sign of "
                f"the map corrects it"
            )
    return scores, tuple(
        f"{CLAIMS[name].format(max(0, round(100 * score)))}, {100 * DOUBT_LIMITS[name]:.0f} % are expected"
        for name, score in scores.items()
        if score < DOUBT_LIMITS[name]
    )


def _find_correction(log_map: LogMap, read: Callable[[Other, slice], Ticks], valid: np.ndarray) -> str:
    """Return the error and the map statement that corrects it best; an empty string if no statement corrects it."""
    part = _part(valid)
    ticks = read(Other("", log_map, {}), part)
    scores = agreement(log_map, ticks, valid[part])
    wrong = {name: score for name, score in scores.items() if score < 1.0 - SUSPICION and name != "climb"}
    best, result = (0.0, 0.0), ""
    rotated_map = with_heading(log_map, heading_between(ticks, valid[part]) if valid[part].any() else 0.0)
    for other in (*others(log_map), rotated_map) if wrong else ():
        try:
            after = agreement(other.log_map, read(other, part), valid[part])
        except LogError:
            continue
        correction = [name for name in wrong if 1.0 - after.get(name, -1.0) < (1.0 - wrong[name]) / IMPROVEMENT]
        holds = all(after.get(name, -1.0) > score - SUSPICION for name, score in scores.items())
        if not correction or not holds or _least(after) < LEAST_AGREEMENT:
            continue
        # Rounded, so that of two equivalent statements, the first one is named.
        if (rank := (round(_least(after), 1), round(sum(after.values()), 6))) > best:
            name, best = min(correction, key=lambda each: wrong[each]), rank
            result = f"{EXPLANATIONS[name]} ({100 * wrong[name]:.0f} % agreement); with {other.words} they would"
    return result


def _part(valid: np.ndarray) -> slice:
    """Return the part of a long log that contains the most flight data; this part is sufficient to check a map."""
    if len(valid) <= PART:
        return slice(0, len(valid))
    flight = np.concatenate([[0], np.cumsum(valid)])
    first = int(np.argmax(flight[PART:] - flight[:-PART]))
    return slice(first, first + PART)


def _least(scores: dict[str, float]) -> float:
    return min(score for name, score in scores.items() if name != "climb")


EXPLANATIONS = {
    "motion": "positions do not move as velocities say",
    "lift": "the vehicle does not accelerate along its thrust axis",
    "thrust": "accelerations are not those of the commanded thrust",
    "turning": "the vehicle does not turn as commanded",
    "gyroscope": "the vehicle does not turn as its measured rates say",
}
