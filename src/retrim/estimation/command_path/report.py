"""Describe the identified command path in one line."""

from jaxtyping import Array, Float

from .estimate import Estimate, PathEstimate


def describe_path(estimate: PathEstimate, declared: tuple[float, float] | None = None) -> str:
    """Return the command path in one line, for the terminal, the log and the page.

    Args:
        estimate: Identified command path.
        declared: Command delay and rate lag from the vehicle file [s]; None if the file does not state them.
    """
    thrust = "thrust gain " + _text(estimate.thrust_gain)
    if not (bool(estimate.delay.excited) and bool(estimate.rate_lag.excited)):
        return f"{thrust}; rate delay and lag not excited"
    result = f"{thrust}; rate delay {_milliseconds(estimate.delay.mean)}, lag {_milliseconds(estimate.rate_lag.mean)}"
    if declared is None:
        return result
    delay, lag = declared
    return f"{result} (vehicle file: {_milliseconds(delay)}, {_milliseconds(lag)})"


def _text(each: Estimate) -> str:
    return f"{float(each.mean):.2f} ± {max(float(each.deviation), 0.005):.2f}" if bool(each.excited) else "not excited"


def _milliseconds(seconds: Float[Array, ""] | float) -> str:
    return f"{1000.0 * float(seconds):.0f} ms"
