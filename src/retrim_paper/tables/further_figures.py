"""Supplements a table of errors with further figures: intervals, recovery, worst error, phase and effort."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from retrim.config.methods import find_method
from retrim.evaluation.metrics import metres
from retrim.runkit.document import TableSection


def figures_table(rows: Sequence[dict[str, Any]], title: str, levels: Mapping[str, str]) -> TableSection:
    """Return a section's supplementary figures at its last level, with a row per method.

    Args:
        rows: Rows of results.
        title: Title of the section.
        levels: Disturbances and their labels.
    """
    level = list(levels)[-1]
    tracks = any(row.get("behind_s") is not None for row in rows)
    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "95 % interval [m]": lambda row: _interval(row["interval"]),
        "to 5 cm [s]": lambda row: _figure(row["settle_s"], 1),
        "worst after 5 s [m]": lambda row: _metres(row["peak_after_5s"]),
        **(DELAY_COLUMNS if tracks else {}),
        "body rates [rad/s]": lambda row: _figure(row["rates_rms"], 2),
        "their change in a tick [rad/s]": lambda row: _figure(row["rates_change_rms"], 3),
    }
    lines = tuple(
        (find_method(row["method"]).label, *(show(row) for show in columns.values()))
        for row in rows
        if row["disturbance"] == level
    )
    about = (
        "The interval is from a bootstrap over seeds and flights that did not crash; medians are over all flights, "
        "where a crash counts as infinite; rates are root mean squares of the commands after 5 s."
    )
    return TableSection(("method", *columns), lines, f"{title}: {levels[level]}", about)


DELAY_COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {
    "behind [s]": lambda row: _figure(row.get("behind_s"), 3),
    "error but for that [m]": lambda row: _metres(row.get("unshifted_m")),
}


def _interval(ends: Sequence[float] | None) -> str:
    if ends is None:
        return "-"
    low, high = (metres(end, 4) for end in ends)
    return high if high.startswith("<") else f"{low} to {high}"


def _metres(value: float | None) -> str:
    return "-" if value is None else metres(value)


def _figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
