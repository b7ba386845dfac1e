"""Checks the monitor's promise, flight by flight: adapting is never worse than not adapting."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from retrim.config.methods import find_method
from retrim.evaluation.metrics import metres
from retrim.runkit.document import TableSection
from retrim.runkit.flights import Flight

ADAPTIVE_METHODS = ("full", "lora")
BASE, OBSERVER = "base", "base-do"
FACTOR, MARGIN = 1.2, 0.005  # bound on the steady error: factor times the better of base and observer, plus margin [m]
ABOUT = """\
crashed although the base policy survived: flights, paired by seed and start. steady: mean error over the last 2 s of
the flights that survived. bound: 1.2 times the smaller steady error of base policy and observer, plus 5 mm."""


def promise_rows(flights: Mapping[str, Sequence[Flight]]) -> list[dict[str, Any]]:
    """Return a row for each combination of condition and adapting method.

    Args:
        flights: Flights by condition, with all methods.
    """
    result = list[dict[str, Any]]()
    for condition, group in flights.items():
        crashes = {(f.spec.method, f.spec.seed, f.spec.start): f.log.terminated for f in group}
        bound = FACTOR * min(_steady(group, method) for method in (BASE, OBSERVER)) + MARGIN
        for method in ADAPTIVE_METHODS:
            own = [f for f in group if f.spec.method == method]
            if not own:
                continue
            worse = sum(f.log.terminated and not crashes.get((BASE, f.spec.seed, f.spec.start), True) for f in own)
            steady = _steady(group, method)
            result.append(
                {
                    "scenario": condition,
                    "method": method,
                    "n": len(own),
                    "crashes": sum(f.log.terminated for f in own),
                    "crashes_base": sum(crashes[key] for key in crashes if key[0] == BASE),
                    "crashed_although_base_survived": worse,
                    "steady": steady if np.isfinite(steady) else None,
                    "bound": bound if np.isfinite(bound) else None,
                    "holds": bool(worse == 0 and (steady <= bound or not np.isfinite(bound))),
                }
            )
    return result


def promise_section(rows: Sequence[dict[str, Any]]) -> TableSection:
    """Return the rows as a table."""
    columns = (
        "condition",
        "method",
        "crashed",
        "base crashed",
        "crashed although the base policy survived",
        "steady [m]",
        "bound [m]",
        "holds",
    )
    lines = [
        (
            row["scenario"],
            find_method(row["method"]).label,
            f"{row['crashes']} of {row['n']}",
            f"{row['crashes_base']} of {row['n']}",
            str(row["crashed_although_base_survived"]),
            *("–" if row[key] is None else metres(row[key]) for key in ("steady", "bound")),
            "yes" if row["holds"] else "**no**",
        )
        for row in rows
    ]
    return TableSection(columns, tuple(lines), "Adapting compared with not adapting", ABOUT)


def _steady(flights: Sequence[Flight], method: str) -> float:
    """Return the mean steady error of the flights that did not crash; infinite if all crashed."""
    survivors = [f.steady for f in flights if f.spec.method == method and not f.log.terminated]
    return float(np.mean(survivors)) if survivors else float("inf")
