"""Computes rows of results from flights."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..config.command_paths import declared_path
from ..config.methods import find_method
from ..config.presets import Preset
from ..config.vehicles import make_vehicle
from ..runkit.flights import Flight, FlightSpec
from .crash_cause import likely_cause


class Rows(list[dict[str, Any]]):
    """Rows of results, each a plain dictionary."""

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; pandas must be installed."""
        import pandas

        return pandas.DataFrame(list(self))


CONDITIONS = ("disturbance", "method", "plant", "vehicle", "sensors", "thrust_error", "delay", "fault", "reference")
"""Conditions that the flights of one row share."""
FIGURES = (
    "error", "peak_after_5s", "settle_s", "cross_track_m", "behind_s", "unshifted_m", "rates_rms", "rates_change_rms",
)  # fmt: skip
"""A flight's figures, in addition to whether it crashed."""
EFFORT = ("rates_rms", "rates_change_rms")
"""Commanded body rates, and their change per tick [rad/s]."""


def record(flight: Flight) -> dict[str, Any]:
    """Return one flight's figures; a terminated flight has no errors."""
    has_crashed = flight.log.terminated
    effort = (
        flight.effort if find_method(flight.spec.method).on_board is None else (np.nan, np.nan)
    )  # no rates are commanded
    behind, aligned_error = flight.behind or (None, None)
    return {
        **conditions_of(flight.spec, flight.vehicle),
        "metric": flight.metric,
        "error": None if has_crashed else flight.steady,
        "peak_after_5s": _finite(flight.peak),
        "settle_s": _finite(flight.settle_s),
        "cross_track_m": None if has_crashed else flight.cross_track,
        "behind_s": behind,
        "unshifted_m": aligned_error,
        "rates_rms": _finite(effort[0]),
        "rates_change_rms": _finite(effort[1]),
        "crashed": has_crashed,
        "failed": None,
    }


def failed_record(spec: FlightSpec, vehicle: str, metric: str, why: str) -> dict[str, Any]:
    """Return the record of a flight whose job failed, with its conditions and the reason, and without figures.

    Args:
        spec: Specification of the flight.
        vehicle: Name of the vehicle.
        metric: Name of the task's error.
        why: The job's error, in one line.
    """
    about = conditions_of(spec, vehicle)
    return {**dict.fromkeys(FIGURES), **about, "metric": metric, "crashed": False, "failed": why}


def conditions_of(spec: FlightSpec, vehicle: str) -> dict[str, Any]:
    """Return the part of a flight's record that its specification states.

    Args:
        spec: Specification of the flight.
        vehicle: Name of the vehicle.
    """
    own = {"method": spec.method, "vehicle": vehicle}
    conditions = {name: own[name] if name in own else getattr(spec.scenario, name) for name in CONDITIONS}
    return {**conditions, "seed": spec.seed, "start": spec.start}


def rows(flights: Sequence[Flight], *, by_seed: bool = False) -> Rows:
    """Return one row per scenario and method; see :func:`summary`.

    Args:
        flights: The flights.
        by_seed: Whether to separate the rows by seed.
    """
    groups: dict[Any, list[Flight]] = {}
    for flight in flights:
        spec = flight.spec
        groups.setdefault((spec.scenario, spec.method, spec.seed if by_seed else None), []).append(flight)
    keys = (*CONDITIONS, "seed") if by_seed else CONDITIONS
    return Rows(summary([record(flight) for flight in group], keys) for group in groups.values())


def summary(records: Sequence[Mapping[str, Any]], keys: Sequence[str] = CONDITIONS) -> dict[str, Any]:
    """Return one row for flights under the same conditions.

    The mean is over the flights that were not terminated. In the median and the maximum, a terminated flight's error is
    infinite (null in JSON), so that a crash remains visible. A flight whose job failed gives no information about
    the method. It counts in ``n``, and is listed in ``failures``.

    Args:
        records: Results from :func:`record`.
        keys: Conditions to copy into the row.
    """
    why = [each["failed"] for each in records if each.get("failed")]
    first, records = records[0], [each for each in records if not each.get("failed")]
    if not records:
        none = dict.fromkeys(("mean", "std", "median", "max", "peak_after_5s", "settle_s", *EFFORT, "interval"))
        about = {key: first[key] for key in keys if key != "reference" or first[key]}
        return about | {"metric": first["metric"], **none, "n": len(why), "crashes": 0, "failures": why, "errors": []}
    everything = _column(records, "error")
    whole = everything[np.isfinite(everything)]
    cross = [each["cross_track_m"] for each in records if each["cross_track_m"] is not None]
    return {
        **{key: first[key] for key in keys if key != "reference" or first[key]},
        "metric": first["metric"],
        "mean": float(whole.mean()) if len(whole) else None,
        "std": float(whole.std(ddof=1)) if len(whole) > 1 else None,
        "median": _finite(float(np.median(everything))),
        "max": _finite(float(everything.max())),
        "peak_after_5s": _finite(float(np.median(_column(records, "peak_after_5s")))),
        "settle_s": _finite(float(np.median(_column(records, "settle_s")))),
        **({"cross_track_m": float(np.mean(cross))} if cross else {}),
        **{name: _average(records, name) for name in EFFORT},
        **(
            {"behind_s": _average(records, "behind_s", np.median), "unshifted_m": _average(records, "unshifted_m")}
            if cross
            else {}
        ),
        "interval": interval(records),
        "n": len(records) + len(why),
        "crashes": sum(each["crashed"] for each in records),
        **({"failures": why} if why else {}),
        "errors": [each["error"] for each in records],
    }


def interval(records: Sequence[Mapping[str, Any]], draws: int = 2000) -> list[float] | None:
    """Return the 95 % bootstrap interval of the mean error [m], if at least one flight was complete.

    Training seeds are drawn first, with replacement, and then flights from each seed. Flights with the same seed are
    correlated; this order keeps their correlation from narrowing the interval.

    Args:
        records: Results from :func:`record`.
        draws: Number of resampled means.
    """
    by_seed: dict[Any, list[float]] = {}
    for each in records:
        if each["error"] is not None:
            by_seed.setdefault(each["seed"], []).append(each["error"])
    if not by_seed:
        return None
    draw, groups, means = np.random.default_rng(0), [np.array(errors) for errors in by_seed.values()], []
    for _ in range(draws):
        sample = (groups[i] for i in draw.integers(len(groups), size=len(groups)))
        means.append(np.concatenate([draw.choice(group, len(group)) for group in sample]).mean())
    low, high = np.percentile(means, (2.5, 97.5))
    return [float(low), float(high)]


def _average(
    records: Sequence[Mapping[str, Any]], name: str, of: Callable[[list[float]], Any] = np.mean
) -> float | None:
    result = [each[name] for each in records if each.get(name) is not None]
    return float(of(result)) if result else None


def _column(records: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    return np.array([np.inf if each[name] is None else each[name] for each in records])


def metres(value: float, digits: int | None = None) -> str:
    """Return an error [m] as text; a value that rounds to zero is written as an upper bound.

    Args:
        value: The error [m].
        digits: Decimal places; three by default, four below a millimetre.
    """
    return _format(value, digits or _digits(value))


def mean_and_deviation(values: np.ndarray) -> str:
    """Return errors [m] as mean ± standard deviation, with the decimal places that :func:`metres` gives the mean."""
    mean, deviation = float(values.mean()), float(values.std(ddof=len(values) > 1))
    return _with_deviation(mean, deviation, _digits(mean))


def _with_deviation(mean: float, deviation: float | None, digits: int) -> str:
    text = _format(mean, digits)
    return text if deviation is None or text.startswith("<") else f"{text} ± {deviation:.{digits}f}"


def _digits(value: float) -> int:
    return 3 if value >= 1e-3 else 4


def _format(value: float, digits: int) -> str:
    least = 10.0**-digits
    return f"{value:.{digits}f}" if value >= 0.5 * least else f"< {least:.{digits}f}"


def cell(row: dict[str, Any], digits: int | None = None) -> str:
    """Return the mean ± standard deviation [m], with the numbers of terminated flights and of failed jobs.

    Args:
        row: Result from :func:`summary`.
        digits: Decimal places; by default those of :func:`metres`.
    """
    text = ""
    if row["mean"] is not None:
        text = _with_deviation(row["mean"], row["std"], digits or _digits(row["mean"]))
    return with_counts(row, text)


def with_counts(row: Mapping[str, Any], text: str) -> str:
    """Return the text of a mean error with the numbers of terminated flights and of failed jobs.

    Args:
        row: Result from :func:`summary`.
        text: The mean error; not used if no flight has one.
    """
    failures = f", {len(row['failures'])} of {row['n']} failed" if row.get("failures") else ""
    if row["mean"] is None:
        return f"crashed, {row['crashes']} of {row['n']}" + failures if row["crashes"] else failures.removeprefix(", ")
    return text + (f", {row['crashes']} of {row['n']} crashed" if row["crashes"] else "") + failures


def _finite(value: float) -> float | None:
    """Return a value for JSON, which cannot represent infinity: null instead of a value that is not finite."""
    return value if np.isfinite(value) else None


def notes(flights: Sequence[Flight], preset: Preset) -> list[str]:
    """Return a line about each method's crashes and their cause, and a line if no update took effect."""
    lines = []
    for method in dict.fromkeys(flight.spec.method for flight in flights):
        same = [flight for flight in flights if flight.spec.method == method]
        if crashes := [flight for flight in same if flight.log.terminated]:
            lines.append(_crashes(method, crashes, len(same), preset))
    learning = [flight for flight in flights if flight.learner_state is not None]
    if learning and not any(flight.swaps for flight in learning):
        first = preset.adapt.update_every + preset.adapt.update_latency
        lines.append(f"no policy update took effect; with fixed latencies the first one comes at {first:g} s")
    return lines


def _crashes(method: str, crashed: Sequence[Flight], n: int, preset: Preset) -> str:
    """Return a line about a method's first crash, with its likely cause."""
    first = min(crashed, key=lambda flight: float(flight.log.t[-1]))
    path = declared_path(preset, make_vehicle(preset.vehicle))
    which = f"start {first.spec.start}"
    which = which if len(crashed) == 1 else f"{len(crashed)} of {n} starts, {which}"
    cause = likely_cause(first.log, float(path.response_time))
    message = f"crashed: {method}, {which}, after {first.log.t[-1]:.2f} s: {first.events[-1].note}"
    return message if cause is None else f"{message}; likely because {cause}"
