"""Does a log agree with itself? Mistakes of units and frames are told by the map with which it would.

Positions move as velocities say; a vehicle accelerates along its thrust axis; it turns as it is told. Where one of
these does not quite hold, every map that differs in one statement is tried, and one with which it holds far better is
named. Wind, drag and lags leave something unexplained with any map.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ...errors import LogError
from . import log_map as maps
from .log_map import LogMap
from .on_one_clock import UP, Ticks, turning

SMOOTH = 0.2  # [s] over which differences are taken
SUSPECT = 0.05  # share that is not explained above which other maps are tried
BETTER, AGREES = 5.0, 0.75  # one of them must leave so much less, and explain at least that
MOVES, TILTS, TURNS = 0.15, 0.03, 0.1  # [m/s], [rad], [rad/s] below which nothing can be told


def check_plausible(path: Path, chosen: LogMap, read: Callable[[LogMap], Ticks], valid: np.ndarray) -> None:
    """Check that the quantities of a log agree with each other.

    Args:
        path: For messages.
        chosen: The map.
        read: Reads the log with another map.
        valid: Which ticks count.

    Raises:
        LogError: They do not; the message names the statement of the map that is wrong, if one is.
    """
    scores = agreement(chosen, read(chosen), valid)
    wrong = {name: score for name, score in scores.items() if score < 1.0 - SUSPECT}
    if not wrong:
        return
    best, found = 0.0, ""
    for words, other in _others(chosen):
        try:
            after = agreement(other, read(other), valid)
        except LogError:
            continue
        mended = [name for name in wrong if 1.0 - after.get(name, -1.0) < (1.0 - wrong[name]) / BETTER]
        kept = all(after.get(name, -1.0) > score - SUSPECT for name, score in scores.items())
        if mended and kept and (least := min(after.values())) > max(best, AGREES):
            name, best = min(mended, key=lambda each: wrong[each]), least
            found = f"{EXPLAINED[name]} ({100 * wrong[name]:.0f} % agreement); with {words} they would"
    if found:
        raise LogError(f"{path}: {found}")
    name, score = min(wrong.items(), key=lambda item: item[1])
    if score < 0.0:
        raise LogError(f"{path}: {EXPLAINED[name]}, and no other unit or frame of the map mends it")


EXPLAINED = {
    "motion": "positions do not move as velocities say",
    "lift": "the vehicle does not accelerate along its thrust axis",
    "thrust": "accelerations are not those of the commanded thrust",
    "turning": "the vehicle does not turn as it is told",
    "gyroscope": "the vehicle does not turn as its measured rates say",
}


def agreement(chosen: LogMap, ticks: Ticks, valid: np.ndarray) -> dict[str, float]:
    """Return how well a log agrees with itself, 1 for entirely; what cannot be told is not in it."""
    k = max(1, round(SMOOTH / ticks.dt))
    both = np.convolve(valid, np.ones(k + 1), mode="valid") > k
    if both.sum() < 2 * k:
        return {}

    def mean(x: np.ndarray) -> np.ndarray:
        total = np.cumsum(np.concatenate([np.zeros((1, x.shape[1])), 0.5 * (x[1:] + x[:-1])]), axis=0)
        return np.asarray(((total[k:] - total[:-k]) / k)[both])

    scores = dict[str, float]()
    moved = ((ticks.p[k:] - ticks.p[:-k]) / (k * ticks.dt))[both]
    told = mean(ticks.v)
    if max(_rms(moved), _rms(told)) > MOVES:
        scores["motion"] = _explained(moved, told)
    felt, axis = mean(ticks.a + UP), mean(ticks.R[:, :, 2])
    aligned = float(np.mean(np.sum(felt * axis, axis=1) / np.maximum(np.linalg.norm(felt, axis=1), 1e-9)))
    sideways, tilt = (x[:, :2] - x[:, :2].mean(axis=0) for x in (felt, axis))
    if _rms(tilt) > TILTS:
        aligned = min(aligned, float(np.sum(sideways * tilt) / (np.linalg.norm(sideways) * np.linalg.norm(tilt))))
    scores["lift"] = aligned
    if (scale := chosen.thrust.scale) is not None:
        given = scale * float(np.median(mean(ticks.thrust[:, None])))
        along = float(np.median(np.abs(np.sum(felt * axis, axis=1))))
        scores["thrust"] = 1.0 - abs(np.log2(max(given, 1e-6) / max(along, 1e-6)))
    turned = mean(turning(ticks.R, ticks.dt))
    for name, rates in (("turning", ticks.command), ("gyroscope", ticks.rates)):
        if rates is not None and max(_rms(mean(rates)), _rms(turned)) > TURNS:
            scores[name] = _alike(turned, mean(rates))
    return scores


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(x**2, axis=1))))


def _explained(x: np.ndarray, by: np.ndarray) -> float:
    """Return the share of the larger of both that they have in common."""
    return 1.0 - float(np.sum((x - by) ** 2) / max(np.sum(x**2), np.sum(by**2), 1e-12))


def _alike(x: np.ndarray, by: np.ndarray) -> float:
    """Return the correlation, times the ratio of the sizes: a lag is no disagreement."""
    small, large = sorted((float(np.linalg.norm(x)), float(np.linalg.norm(by))))
    return float(np.sum(x * by)) / max(small * large, 1e-12) * float(np.sqrt(small / max(large, 1e-12)))


def _others(chosen: LogMap) -> Iterator[tuple[str, LogMap]]:
    """Maps that differ in one statement, or in both frames, in words."""
    for table, key in (
        ("velocity", "axes"), ("velocity", "unit"), ("position", "unit"), ("attitude", "turns"), ("attitude", "form"),
        ("thrust", "unit"), ("rates", "unit"), ("measured_rates", "unit"), ("frames", "body"), ("frames", "world"),
    ):  # fmt: skip
        spec: Any = getattr(chosen, table)
        if spec is None:
            continue
        for value in _values(spec, key):
            if value == getattr(spec, key) or (table == "thrust" and value in ("N", "share")):
                continue
            if table == "attitude" and key == "form" and {value, spec.form} != {"xyzw", "wxyz"}:
                continue
            yield f'{table}.{key} = "{value}"', _with(chosen, table, key, value)
    frames = chosen.frames
    both = maps.Frames("NED" if frames.world == "ENU" else "ENU", "FRD" if frames.body == "FLU" else "FLU")
    words = f'frames.world = "{both.world}" and frames.body = "{both.body}"'
    yield words, dataclasses.replace(chosen, frames=both)


def _values(spec: Any, key: str) -> tuple[Any, ...]:
    kind = next(field.type for field in dataclasses.fields(spec) if field.name == key)
    return get_args(kind)


def _with(chosen: LogMap, table: str, key: str, value: Any) -> LogMap:
    changes = {key: value} | (
        {"mass": None, "hover": None} if table == "thrust" else {}
    )  # what goes with one unit only
    return dataclasses.replace(chosen, **{table: dataclasses.replace(getattr(chosen, table), **changes)})
