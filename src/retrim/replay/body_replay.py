"""Reports on a log of commands, gyroscope and accelerometer, with a reason for each value that is not determined."""

from collections.abc import Collection
from pathlib import Path

from ..config.setup import Setup
from ..errors import LogError
from ..io.logs import BodyLog
from ..runkit.document import Document, TableSection
from ..runkit.interrupts import interrupts_only_set
from ..runkit.reporter import Reporter
from ..runkit.run import Run
from .body_identification import BodyIdentification, identify_body
from .files import clear_outputs, write_vehicle
from .identification import Estimate
from .report import agreement_section, warning_of

REMARK = "The delay counts from the setpoint in the autopilot; add the delay of the link that sends commands to it."
RATES, THRUST = "needs commanded rates that change", "needs an accelerometer, and a thrust that changes"
NEEDS_STATES = "needs positions or velocities, and attitudes"
GAINS = (0.8, 1.25)  # limits for the ratio of measured to commanded rates; a rate controller reaches 1


def replay_body(
    log: BodyLog,
    path: Path,
    setup: Setup,
    run: Run,
    reporter: Reporter,
    *,
    identify: bool,
    seed: int,
    adapt: str,
    keep: Collection[Path] = (),
) -> Document:
    """Report on a log without attitudes and velocities in ``replay.md`` and ``replay.json``.

    Args:
        log: The log.
        path: Its file.
        setup: Set-up with the vehicle for the values that are not identified.
        run: Run whose folder receives the files.
        reporter: Receives the tables and the progress.
        identify: Whether a vehicle file is written.
        seed: Seed for the bootstrap.
        adapt: Method that adapts a policy; it must be ``none``, since the log has no states.
        keep: Input files, which stay in the folder.

    Raises:
        LogError: The log is too short, or a policy is to be adapted to it.
    """
    if adapt != "none":
        raise LogError(
            f"{path}: --adapt {adapt}: the log has no attitudes and velocities, so no residual can be computed from it"
        )
    with reporter.progress("identifying") as advance:
        advance(0.0, "delay and lags")
        result = identify_body(log, seed=seed)
        advance(1.0, "done")
    intro = "The log has commands, a gyroscope and perhaps an accelerometer, but no attitudes and no velocities."
    intro = f"{warning_of(log)}\n\n{intro}" if log.warnings else intro
    clear_outputs(run.folder, keep)
    document = Document(run, "replay", f"Replay of {path.name}", intro, [seed], reporter)
    document.more["agreement"] = dict(log.agreement)
    document.more["identified"] = _figures(result)
    with run.interruptible():
        document.add(agreement_section(log))
        document.add(body_section(log, result))
        if identify and result.known:
            write_vehicle(document, result.vehicle, setup, path.name, remark=REMARK)
    with interrupts_only_set(run.stop):
        document.write()
    return document


def body_section(log: BodyLog, result: BodyIdentification) -> TableSection:
    """Return a table of the identified values, and of the reasons why others are not identified."""

    def line(name: str, what: Estimate | None, unit: str, need: str, scale: float = 1.0) -> tuple[str, str]:
        return name, need if what is None else what.text(unit, scale)

    vehicle = result.vehicle
    lines = [
        line("delay from the autopilot's setpoint to the rates", vehicle.delay, "ms", RATES, 1000.0),
        line("lag of roll and pitch rates", vehicle.rate_lag, "ms", RATES, 1000.0),
        line("damping ratio of roll and pitch rates", vehicle.rate_damping, "",
             RATES if vehicle.rate_lag is None else "none: the response is of first order"),
        line("roll and pitch rate per command", vehicle.rate_gain, "", RATES),
        line("lag of yaw rate", vehicle.yaw_lag, "ms", RATES, 1000.0),
        line("yaw rate per command", vehicle.yaw_gain, "", RATES),
        line("motor command at hover", result.hover, "", THRUST),
        line("share of the thrust that is quadratic in the command", result.curve, "",
             THRUST if log.curve is None else "is stated by the map"),
        line(f"full thrust, from commands up to {result.largest:.2f}", vehicle.full_thrust, "m/s^2", THRUST),
        line("lag of thrust", vehicle.thrust_lag, "ms", THRUST, 1000.0),
        ("linear drag", NEEDS_STATES),
        ("residual acceleration, its prediction, and a policy adapted to it", NEEDS_STATES),
    ]  # fmt: skip
    about = (
        f"{log.seconds:.1f} s of flight, a tick of {1000 * log.dt:.3g} ms. Estimates with intervals of 90 %, of a "
        f"bootstrap over blocks of the log. {REMARK}"
    )
    gains = {"roll and pitch": vehicle.rate_gain, "yaw": vehicle.yaw_gain}
    for name, gain in gains.items():
        if gain is not None and not GAINS[0] <= gain.value <= GAINS[1]:
            about += (
                f" **The {name} rates are {gain.value:.2f} times the commanded ones**: the unit or the scale of one of "
                f"them may be wrong."
            )
    about += "".join(f" {note[0].upper()}{note[1:]}." for note in log.notes if note not in log.warnings)
    if not result.known:
        about += " The log determines no value of the vehicle, so no vehicle file is written: roll, pitch and yaw."
    return TableSection(("", "estimate"), tuple(lines), "What the vehicle is", about)


def _figures(result: BodyIdentification) -> dict[str, object]:
    """Return the estimates for the JSON file; null for those that the log does not determine."""
    vehicle = {
        name: None if value is None else [float(x) for x in value]
        for name, value in vars(result.vehicle).items()
        if name not in ("drag", "unexplained")
    }
    more = {name: None if value is None else [float(x) for x in value]
            for name, value in (("hover", result.hover), ("curve", result.curve))}  # fmt: skip
    return vehicle | more | {"explained": result.explained, "largest": result.largest}
