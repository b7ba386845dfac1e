"""From flights to rows of results."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .flights import Flight


class Rows(list[dict[str, Any]]):
    """Rows of results, each a plain dictionary."""

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; pandas must be installed."""
        import pandas

        return pandas.DataFrame(list(self))


def rows(flights: Sequence[Flight], *, by_seed: bool = False) -> Rows:
    """Return one row per scenario and method.

    The mean is over the flights that were not terminated; the median counts a terminated flight as infinite, so that it
    cannot hide one.

    Args:
        flights: What was flown.
        by_seed: One row for each seed, too.
    """
    groups: dict[Any, list[Flight]] = {}
    for flight in flights:
        spec = flight.spec
        groups.setdefault((spec.scenario, spec.method, spec.seed if by_seed else None), []).append(flight)
    return Rows(_row(group, by_seed) for group in groups.values())


def _row(group: Sequence[Flight], by_seed: bool) -> dict[str, Any]:
    first = group[0]
    spec, whole = first.spec, [f for f in group if not f.log.terminated]
    steady = np.array([f.steady for f in whole])
    everything = np.array([np.inf if f.log.terminated else f.steady for f in group])
    peaks, cross = [f.peak for f in group], [f.cross_track for f in whole if f.cross_track is not None]
    return {
        "disturbance": spec.scenario.disturbance,
        "method": spec.method,
        "plant": spec.scenario.plant,
        "vehicle": first.vehicle,
        "sensors": spec.scenario.sensors,
        "thrust_error": spec.scenario.thrust_error,
        **({"reference": spec.scenario.reference} if spec.scenario.reference else {}),
        **({"seed": spec.seed} if by_seed else {}),
        "metric": first.metric,
        "mean": float(steady.mean()) if len(steady) else None,
        "std": float(steady.std(ddof=1)) if len(steady) > 1 else None,
        "median": _finite(float(np.median(everything))),
        "peak_after_5s": _finite(float(np.median(peaks))),
        "settle_s": _finite(float(np.median([f.settle_s for f in group]))),
        **({"cross_track_m": float(np.mean(cross))} if cross else {}),
        "n": len(group),
        "crashes": sum(f.log.terminated for f in group),
        "errors": [_finite(float(e)) for e in everything],
    }


def cell(row: dict[str, Any]) -> str:
    """Return mean +- standard deviation [m], with the flights that were terminated."""
    if row["mean"] is None:
        return f"crashed, {row['crashes']} of {row['n']}"
    text = f"{row['mean']:.3f}" + (f" ± {row['std']:.3f}" if row["std"] is not None else "")
    return text + (f", {row['crashes']} of {row['n']} crashed" if row["crashes"] else "")


def _finite(value: float) -> float | None:
    """JSON has no infinity: None."""
    return value if np.isfinite(value) else None
