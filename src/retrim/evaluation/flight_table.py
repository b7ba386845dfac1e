"""Cells of the tables of flights: the error at the end, the worst moment and the settling time."""

from collections.abc import Mapping
from typing import Any

from ..runkit.flights import SETTLING_ERROR
from .metrics import with_counts

START_S = 5.0  # [s], flight to the goal, which the worst moment excludes


def figure_columns(seconds: float | None = None) -> tuple[str, str, str]:
    """Return the headings of :func:`figure_cells`.

    Args:
        seconds: Length of the flights [s]; the worst moment of a flight below 10 s is in its second half.
    """
    after = START_S if seconds is None else min(START_S, seconds / 2)
    return "error at the end [mm]", f"worst after {after:g} s [mm]", f"below {1000 * SETTLING_ERROR:g} mm from [s]"


def figure_cells(row: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return the error at the end, the worst moment and the settling time of flights under the same conditions.

    Args:
        row: Result from :func:`retrim.evaluation.metrics.summary`.
    """
    error = with_counts(row, _mean_and_deviation(row["mean"], row["std"]))
    if row["mean"] is None:
        return error, "-", "-"
    settling = "never" if row["settle_s"] is None else f"{row['settle_s']:.1f}"
    return error, millimetres(row["peak_after_5s"]), settling


def millimetres(value: float | None) -> str:
    """Return an error as text; a value that rounds to zero is written as an upper bound.

    Args:
        value: The error [m]; None for an infinite one.
    """
    return "-" if value is None else _format(1000 * value, _digits(1000 * value))


def _mean_and_deviation(mean: float | None, deviation: float | None) -> str:
    if mean is None:
        return ""
    digits = _digits(1000 * mean)
    text = _format(1000 * mean, digits)
    return text if deviation is None or text.startswith("<") else f"{text} ± {1000 * deviation:.{digits}f}"


def _digits(value: float) -> int:
    """Return the decimal places of an error [mm]."""
    return 0 if value >= 100 else 1 if value >= 1 else 3


def _format(value: float, digits: int) -> str:
    least = 10.0**-digits
    return f"{value:.{digits}f}" if value >= 0.5 * least else f"< {least:.{digits}f}"
