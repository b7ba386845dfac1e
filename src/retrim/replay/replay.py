"""Implements `retrim replay`: reads a log, predicts, identifies and adapts, and writes files to a run's folder."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jax import tree

from ..config.limits import check_seeds
from ..config.loading import changed, load, with_vehicle
from ..config.methods import find_method, learning_methods
from ..config.setup import Setup
from ..config.vehicles import name_of
from ..control.policy import AbstractPolicy
from ..errors import ConfigError, LogError
from ..io.logs import BodyLog, FlightLog, read_log, read_map
from ..io.policies import load_policy
from ..learn.residuals.targets import Targets
from ..runkit.document import Document, TableSection
from ..runkit.interrupts import interrupts_only_set
from ..runkit.outputs import write_state
from ..runkit.reporter import Reporter
from ..runkit.run import Run
from .adaptation import adapt_to, ends_of_windows
from .body_replay import replay_body
from .files import clear_outputs, write_vehicle
from .identification import blocks_of, identify
from .prediction import PredictionScore, Protocol, predict_log
from .predictors import model_factory, yardsticks
from .report import agreement_section, identified_section, picture, prediction_section, residual_section, warning_of
from .rows import rows_of

REPORT_MODELS = ("regression", "ensemble", "linear")  # residual models to compare with the baselines
ENSEMBLE_RATE = 1e-3  # learning rate; with that of hover/paper, an ensemble fits the noise in a real log
DEFAULT = "hover/retrim"
VEHICLE_NOTE = "values that the log does not determine are those of the vehicle in --vehicle"
SAMPLES = (12, 100_000)  # limits for the number of samples in a fit; the command delay is added to the minimum
LONGEST_TICK = 0.1  # [s]: the longest tick of a preset; a log's tick may differ slightly
LOST = 0.5  # [m]: above this error, the corrected model no longer describes the flight
SPANS = {"buffer": (0.2, 600.0), "horizon": (0.1, 600.0), "delay": (0.0, 1.0), "lag": (0.0, 5.0)}  # limits [s]


@dataclass(frozen=True)
class Replay:
    """Options of a replay."""

    map: str | None = None
    """TOML file with the name, unit and frame of each field; or a name: px4, px4-1.9, px4-dds,
    px4-dds-1.13, mavros, mavros-pose, ardupilot, ardupilot-rates, betaflight, betaflight-csv, crazyflie,
    crazyflie-quaternion, crazyswarm, crazyswarm-quaternion, crazyswarm-ros, retrim-csv, retrim-npz, retrim-mcap.
    Default: the format's first map whose fields exist."""
    flight: int | None = None
    """Number of the flight, from 1, in a Blackbox or dataflash file that contains several."""
    buffer: float = 5.0
    """Duration of the data to which residual models are fitted [s]."""
    horizon: float = 5.0
    """Duration of the following data, which residual models predict [s]."""
    residual: str | None = None
    """Residual model for --adapt, or module:name; by default the policy's. It is compared with regression,
    ensemble and linear."""
    delay: float = 0.0
    """Delay between a command and its thrust [s]; --identify estimates it."""
    lag: float = 0.0
    """Time constant of the thrust after the delay [s]."""
    identify: bool = False
    """Identify the thrust map, drag, command delay and lags, with intervals, and write a vehicle file."""
    vehicle: str | None = None
    """Vehicle for the values that are not identified: small, large, kingfisher, a vehicle file or
    module:name; by default the policy's."""
    policy: Path | None = None
    """Policy to adapt, or the folder that contains one."""
    trust: tuple[str, ...] = ()
    """Python names that the policy may refer to, for example mine:task; they are imported."""
    adapt: str = "none"
    """Re-train the policy in the model that the log has corrected: full (all weights), lora (low-rank), another
    learning method, or none."""
    updates: int = 60
    """Maximum number of updates."""
    seed: int = 0
    """Seed for the initial networks, the updates and the bootstrap."""

    def __post_init__(self) -> None:
        """Raise ``ConfigError`` if a value is out of range, or if options contradict each other."""
        for name, (least, most) in SPANS.items():
            if not least <= getattr(self, name) <= most:
                raise ConfigError(f"--{name} {getattr(self, name):g}: must be {least:g} to {most:g} s")
        if self.adapt != "none" and find_method(self.adapt).learns is None:
            raise ConfigError(f"--adapt {self.adapt}: must be {', '.join(learning_methods())} or none")
        if self.adapt != "none" and self.policy is None:
            raise ConfigError(f"--adapt {self.adapt} needs --policy; `retrim pretrain hover --out h` makes a policy")
        if self.policy is not None and self.adapt == "none" and not self.identify:
            raise ConfigError("--policy needs --adapt METHOD, or --identify for the vehicle of the policy")
        if self.flight is not None and self.flight < 1:
            raise ConfigError(f"--flight {self.flight}: flights are numbered from 1")
        if not 1 <= self.updates <= 10_000:
            raise ConfigError(f"--updates {self.updates}: must be 1 to 10000")
        check_seeds((self.seed,))

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that the options name."""
        return tuple(Path(name) for name in (self.map, self.vehicle, self.policy) if name is not None)


def replay(path: Path, request: Replay, run: Run, reporter: Reporter) -> Document:
    """Report on a log in ``replay.md``, ``replay.json`` and a picture; identify and adapt if requested.

    Args:
        path: The log.
        request: The options.
        run: Run whose folder receives the files.
        reporter: Receives the tables and the progress.

    Raises:
        LogError: The log cannot be used.
        ConfigError: A name does not exist or does not fit.
    """
    policy, preset = load_policy(request.policy, trust=request.trust) if request.policy else (None, load(DEFAULT))
    if request.vehicle is not None:
        preset = with_vehicle(preset, request.vehicle)
    setup = Setup.from_preset(
        preset if request.residual is None else changed(preset, adapt={"residual": request.residual})
    )
    chosen_map = None if request.map is None else read_map(request.map)
    log = read_log(path, chosen_map, dt=preset.dt, flight=request.flight)
    if request.identify and request.vehicle is None and request.policy is None:
        reporter.say(f"{VEHICLE_NOTE}, which is not stated: {name_of(setup.preset.vehicle)!r}")
    if isinstance(log, BodyLog):
        return replay_body(log, path, setup, run, reporter, identify=request.identify, seed=request.seed,
                           adapt=request.adapt, keep=request.files)  # fmt: skip
    rows, protocol = rows_of(log, delay=request.delay, lag=request.lag), Protocol(request.buffer, request.horizon)
    _check_log(request, protocol, setup, log, rows)
    clear_outputs(run.folder, request.files)
    late = f" Thrust acts {1000 * request.delay:g} ms late, with a lag of {1000 * request.lag:g} ms."
    intro = "Residual a - (c R e3 - g e3), world frame." + late * bool(request.delay or request.lag)
    intro = f"{warning_of(log)}\n\n{intro}" if log.warnings else intro
    document = Document(run, "replay", f"Replay of {path.name}", intro,
                        [request.seed], reporter)  # fmt: skip
    document.more["agreement"] = dict(log.agreement)
    with run.interruptible():
        document.add(agreement_section(log))
        document.add(residual_section(log, rows))
        if result := _score_predictions(request, protocol, setup, log, rows, reporter, run):
            picture_path = picture(log, rows, result, protocol, run.folder)[0]
            section = dataclasses.replace(prediction_section(result, protocol), picture=picture_path)
            document.add(section, [dataclasses.asdict(each) for each in result])
        if request.identify and not run.interrupted:
            _identify(log, path.name, setup, request.seed, document)
        if policy is not None and request.adapt != "none" and not run.interrupted:
            document.add(_adapt(request, setup, policy, rows, document))
    with interrupts_only_set(run.stop):
        document.write()
    return document


def _identify(log: FlightLog, name: str, setup: Setup, seed: int, document: Document) -> None:
    with document.reporter.progress("identifying") as advance:
        advance(0.0, "delays and lags")
        vehicle = identify(log, seed=seed)
        advance(1.0, "done")
    document.more["identified"] = tree.map(float, dataclasses.asdict(vehicle))
    document.add(identified_section(vehicle))
    if vehicle.known:
        write_vehicle(document, vehicle, setup, name)


def _check_log(request: Replay, protocol: Protocol, setup: Setup, log: FlightLog, rows: Targets) -> None:
    """Raise an error if a log is too short or too coarse for what is requested, before anything is written."""
    least, most = setup.preset.plant_delay_ticks + SAMPLES[0], SAMPLES[1]
    if not least <= round(request.buffer / log.dt) <= most:
        raise ConfigError(
            f"--buffer {request.buffer:g}: must be {least * log.dt:.2g} to {most * log.dt:.4g} s for a log that has a "
            f"sample every {1000 * log.dt:.3g} ms"
        )
    protocol.windows(np.asarray(rows.valid), log.dt)
    if request.identify:
        blocks_of(log)
    if request.adapt == "none":
        return
    dt = setup.preset.dt
    if abs(log.dt - dt) > 0.02 * dt:
        raise LogError(
            f"the log has a sample every {1000 * log.dt:.3g} ms, but the policy's tick is {1000 * dt:g} ms; "
            f"log states at least that often to adapt to them"
        )
    ends_of_windows(rows, setup)


def _score_predictions(
    request: Replay, protocol: Protocol, setup: Setup, log: FlightLog, rows: Targets, reporter: Reporter, run: Run
) -> list[PredictionScore]:
    result = list[PredictionScore]()
    home = np.mean(log.p[log.valid], axis=0)
    goal = tuple(float(x) for x in home)
    preset = changed(setup.preset, goal=goal, dt=min(max(0.001, round(log.dt, 3)), LONGEST_TICK))
    adapt: dict[str, Any] = {"window": round(protocol.buffer / log.dt), "fit_every": protocol.every}
    names = dict.fromkeys([*REPORT_MODELS, *([request.residual] if request.residual else [])])
    predictors = yardsticks(log.dt)
    for name in names:
        more = {"fit_learning_rate": ENSEMBLE_RATE} if name == "ensemble" else {}
        predictors[name] = model_factory(name, preset, setup.vehicle, request.seed, **adapt, **more)
    with reporter.progress("foretelling") as advance, run.interruptible():
        advance(0.0, next(iter(predictors)))
        for each in predict_log(rows, log.dt, predictors, protocol):
            result.append(each)
            advance(len(result) / len(predictors), f"{each.name}: {each.rmse:.3f} m/s^2")
    return result


def _adapt(request: Replay, setup: Setup, policy: AbstractPolicy, rows: Targets, document: Document) -> TableSection:
    result = adapt_to(
        rows,
        setup,
        policy,
        method=request.adapt,
        updates=request.updates,
        seed=request.seed,
        reporter=document.reporter,
    )
    document.files.append(write_state(result.state, setup.preset, document.run.folder))
    lines = (("as it was", f"{result.before:.3f}"), ("adapted", f"{result.after:.3f}"))
    about = (
        f"{result.admissions} of {result.attempts} updates passed the gate, residual `{setup.preset.adapt.residual}`. "
        "Error over the last half second of 6 s in the model that the log has corrected, 64 starts of the task."
    )
    if not result.after < LOST:
        about += (
            " **In that model the policy does not hold**: the residual says more than the log has shown. Try another "
            "`--residual`, `--delay` and `--lag` of `--identify`, or a log with more movement."
        )
    return TableSection(("policy", "error [m]"), lines, "A policy adapted to the log", about)
