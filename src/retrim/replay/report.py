"""Builds the tables and the picture of the report on a log."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..io.logs import BodyLog, FlightLog
from ..io.logs.plausibility import DOUBT_LIMITS
from ..learn.residuals.targets import Targets
from ..runkit.document import TableSection
from .identification import Estimate, IdentifiedVehicle
from .prediction import PredictionScore, Protocol

SMOOTH = 0.3  # averaging time of the curves in the picture [s]
WORDS = {
    "motion": "motion of the position, by the velocity",
    "lift": "sideways acceleration, by the attitude",
    "thrust": "size of the acceleration along the thrust axis, by the thrust",
    "climb": "changes of the acceleration along the thrust axis, by the thrust",
    "turning": "turning, by the commanded rates",
    "gyroscope": "turning, by the measured rates",
}


def warning_of(log: FlightLog | BodyLog) -> str:
    """Return the introductory warning for a doubtful log, or an empty string for a consistent one."""
    if not log.warnings:
        return ""
    warnings = "; ".join(log.warnings)
    return f"**Warning: this log agrees badly with itself, and no figure below can be relied on: {warnings}.**"


def agreement_section(log: FlightLog | BodyLog) -> TableSection:
    """Return a table of the agreement between a log's quantities."""
    lines = tuple(
        (WORDS[name], f"{round(100 * score)} %", f"{round(100 * DOUBT_LIMITS[name])} %")
        for name, score in log.agreement.items()
    )
    about = warning_of(log) or (
        "What one quantity says of another; wind, drag and lags leave something unexplained in every log."
        if lines
        else "The vehicle hardly moves, so its quantities cannot be compared."
    )
    return TableSection(("", "agreement", "doubtful below"), lines, "How well the log agrees with itself", about)


def residual_section(log: FlightLog, rows: Targets) -> TableSection:
    """Return a table of the nominal model's error, axis by axis."""
    residuals = np.asarray(rows.a_res)[log.valid]
    slow = np.linalg.norm(log.v[log.valid], axis=1)
    parts = [("mean", residuals.mean(axis=0)), ("standard deviation", residuals.std(axis=0)),
             ("root mean square", np.sqrt(np.mean(residuals**2, axis=0)))]  # fmt: skip
    lines = tuple((name, *(f"{x:.2f}" for x in values), f"{np.linalg.norm(values):.2f}") for name, values in parts)
    about = (
        f"{log.seconds:.1f} s of flight, a tick of {1000 * log.dt:.4g} ms; speed {slow.mean():.2f} m/s on average, "
        f"{slow.max():.2f} m/s at most."
    )
    notes = "".join(f" {note[0].upper()}{note[1:]}." for note in log.notes if note not in log.warnings)
    return TableSection(("residual [m/s^2]", "x", "y", "z", "all"), lines, "Residual of the point mass", about + notes)


def prediction_section(results: Sequence[PredictionScore], protocol: Protocol) -> TableSection:
    """Return a table of the prediction errors over the next few seconds."""
    least = min(each.rmse for each in results)
    none = next((each.rmse for each in results if each.name == "zero"), None)
    lines = []
    for each in results:
        error = f"{each.rmse:.3f}"
        share = "" if not none else f"{100 * (1.0 - (each.rmse / none) ** 2):.0f} %"
        lines.append((each.name, f"**{error}**" if each.rmse == least else error, *(f"{x:.2f}" for x in each.per_axis),
                      share))  # fmt: skip
    about = (
        f"Fitted every {protocol.every:g} s to the last {protocol.buffer:g} s, the error over the next "
        f"{protocol.horizon:g} s; {len(results[0].per_window)} windows. Raw: noise of the derivative of velocity is in "
        f"every figure. `regression` is the model of a flight, for the next second."
    )
    title = "Prediction of the next seconds"
    return TableSection(("predictor", "error [m/s^2]", "x", "y", "z", "explained"), tuple(lines), title, about)


def identified_section(vehicle: IdentifiedVehicle) -> TableSection:
    """Return a table of the vehicle's identified parameters."""

    def line(name: str, what: Estimate | None, unit: str, scale: float = 1.0) -> tuple[str, str]:
        return name, "not determined by the log" if what is None else what.text(unit, scale)

    lines = (
        line("command delay", vehicle.delay, "ms", 1000.0),
        line("thrust per commanded thrust", vehicle.thrust_gain, ""),
        line("acceleration upwards without a command", vehicle.thrust_offset, "m/s^2"),
        *((line("full thrust", vehicle.full_thrust, "m/s^2"),) if vehicle.full_thrust else ()),
        line("lag of thrust", vehicle.thrust_lag, "ms", 1000.0),
        line("lag of roll and pitch rates", vehicle.rate_lag, "ms", 1000.0),
        line("roll and pitch rate per command", vehicle.rate_gain, ""),
        line("lag of yaw rate", vehicle.yaw_lag, "ms", 1000.0),
        line("yaw rate per command", vehicle.yaw_gain, ""),
        *(line(f"linear drag along body {axis}", each, "1/s") for axis, each in zip("xyz", vehicle.drag, strict=True)),
        ("acceleration left unexplained", f"{vehicle.unexplained:.2f} m/s^2"),
    )
    about = "Estimates with intervals of 90 %, of a bootstrap over blocks of 2 s of the log."
    if not vehicle.known:
        about = "The log determines no parameter of the vehicle, so no vehicle file is written: fly circles and yaw."
    return TableSection(("", "estimate"), lines, "What the vehicle is", about)


def picture(
    log: FlightLog, rows: Targets, results: Sequence[PredictionScore], protocol: Protocol, folder: Path
) -> list[Path]:
    """Draw the residual over time, and the prediction errors."""
    from ..viz.panels import Curve, Panel, panel_figure
    from ..viz.plots import save

    k = max(1, round(SMOOTH / log.dt))
    kernel = np.ones(k) / k
    residuals = np.where(log.valid[:, None], np.asarray(rows.a_res), np.nan)
    curves = [Curve(log.t, np.convolve(residuals[:, i], kernel, mode="same"), "xyz"[i]) for i in range(3)]
    scores = [each for each in results if each.name != "zero"]
    errors = [Curve(np.array(each.times), np.array(each.per_window), each.name) for each in scores]
    panels = [
        Panel("residual of the point mass", "time [s]", "residual acceleration [m/s^2]", curves, 3),
        Panel(f"error over the next {protocol.horizon:g} s", "time of the prediction [s]", "[m/s^2]", errors, 2),
    ]
    return save(panel_figure("Residual of the model, and its prediction", panels, across=2), folder, "replay")
