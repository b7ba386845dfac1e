"""Does a log agree with itself? Mistakes of units, frames and signs are told by the map with which it would.

Where figures of :mod:`retrim.io.logs.agreement` are low, every map that differs in one statement is tried, and one with
which the log agrees far better is named. A log that contradicts itself with every map is refused; one that agrees badly
is read with a warning.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...errors import LogError
from .agreement import CLAIMS, agreement, heading_between
from .log_map import LogMap
from .on_one_clock import Ticks
from .other_maps import Other, others, with_heading

SUSPECT = 0.05  # share that is not explained above which other maps are tried
BETTER, AGREES = 5.0, 0.75  # one of them must leave so much less, and explain at least that
PART = 3000  # ticks of a long log with which other maps are tried
REFUSED = {"motion": 0.0, "lift": 0.0, "thrust": 0.0, "turning": -0.3, "gyroscope": -0.3}
"""Below these a log is refused."""
DOUBTFUL = {"motion": 0.75, "lift": 0.5, "thrust": 0.65, "climb": 0.25, "turning": 0.5, "gyroscope": 0.75}
"""Below these a report begins with a warning."""


def check_plausible(
    path: Path, chosen: LogMap, ticks: Ticks, read: Callable[[Other, slice], Ticks], valid: np.ndarray
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Check that the quantities of a log agree with each other.

    Args:
        path: For messages.
        chosen: The map.
        ticks: The log, read with it.
        read: Reads a part of the log with another map.
        valid: Which ticks count.

    Returns:
        The figures, 1 for entire agreement, and a warning for each that is low.

    Raises:
        LogError: They do not; the message names the statement of the map that is wrong, if one is.
    """
    scores = agreement(chosen, ticks, valid)
    wrong = {name: score for name, score in scores.items() if score < 1.0 - SUSPECT and name != "climb"}
    if wrong and (mended := _mended(chosen, read, valid)):
        raise LogError(f"{path}: {mended}")
    for name, score in sorted(wrong.items(), key=lambda item: item[1]):
        if score < REFUSED[name]:
            raise LogError(
                f"{path}: {EXPLAINED[name]} ({100 * score:.0f} % agreement), and no other unit, frame or sign of the "
                f"map mends it"
            )
    return scores, tuple(
        f"{CLAIMS[name].format(max(0, round(100 * score)))}, {100 * DOUBTFUL[name]:.0f} % are expected"
        for name, score in scores.items()
        if score < DOUBTFUL[name]
    )


def _mended(chosen: LogMap, read: Callable[[Other, slice], Ticks], valid: np.ndarray) -> str:
    """Return what is wrong and the statement of the map that mends it best; nothing if none does."""
    part = _part(valid)
    ticks = read(Other("", chosen, {}), part)
    scores = agreement(chosen, ticks, valid[part])
    wrong = {name: score for name, score in scores.items() if score < 1.0 - SUSPECT and name != "climb"}
    best, found = (0.0, 0.0), ""
    turned = with_heading(chosen, heading_between(ticks, valid[part]) if valid[part].any() else 0.0)
    for other in (*others(chosen), turned) if wrong else ():
        try:
            after = agreement(other.log_map, read(other, part), valid[part])
        except LogError:
            continue
        mended = [name for name in wrong if 1.0 - after.get(name, -1.0) < (1.0 - wrong[name]) / BETTER]
        kept = all(after.get(name, -1.0) > score - SUSPECT for name, score in scores.items())
        if not mended or not kept or _least(after) < AGREES:
            continue
        if (rank := (round(_least(after), 1), sum(after.values()))) > best:
            name, best = min(mended, key=lambda each: wrong[each]), rank
            found = f"{EXPLAINED[name]} ({100 * wrong[name]:.0f} % agreement); with {other.words} they would"
    return found


def _part(valid: np.ndarray) -> slice:
    """Return the part of a long log with the most flight: it tells as much of a map as all of it."""
    if len(valid) <= PART:
        return slice(0, len(valid))
    flight = np.concatenate([[0], np.cumsum(valid)])
    first = int(np.argmax(flight[PART:] - flight[:-PART]))
    return slice(first, first + PART)


def _least(scores: dict[str, float]) -> float:
    return min(score for name, score in scores.items() if name != "climb")


EXPLAINED = {
    "motion": "positions do not move as velocities say",
    "lift": "the vehicle does not accelerate along its thrust axis",
    "thrust": "accelerations are not those of the commanded thrust",
    "turning": "the vehicle does not turn as it is told",
    "gyroscope": "the vehicle does not turn as its measured rates say",
}
