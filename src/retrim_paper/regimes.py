"""Regimes of flight in which learning may pay: conditions, opponents, scores, and published values.

A regime is one row of ``docs/results/where_learning_pays.md``. To add one, append it to :func:`regimes`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from retrim.config.disturbances import disturbance
from retrim.config.hidden_vehicles import draw_vehicles
from retrim.config.loading import changed, load
from retrim.config.presets import Preset
from retrim.config.references import make_reference
from retrim.config.scenario import Scenario
from retrim.physics import State, TableEdge
from retrim.runkit.flights import Flight

from .rotor_benchmark.benchmark import PUBLISHED_ERRORS, SECONDS, benchmark_preset, title_of
from .slung_load import END, seconds_to_calm
from .vehicles import DELAY, THRUST_TO_WEIGHT, heavy_quadrotor, slow_quadrotor

PUSH = "early-step"  # 2 m/s^2 per axis from 4 s on
LAST, TAIL = 2.0, 10.0  # [s], scored intervals at the end of hover flights and of tracking flights
LAP_RATIO = 3.5  # smallest ratio of the times of the first and the last lap
CHANGES = 16.0  # [s], scored interval at the end of flights with a pick-up and a release
VEHICLES = 8  # number of hidden vehicles
VEHICLE_SEED = 48  # seed of their draw


@dataclass(frozen=True)
class Score:
    """A figure of a flight."""

    of: Callable[[Flight], float]
    """Function that returns the figure of a flight that was not lost, in m or s; cells show mm or ms."""
    about: str


@dataclass(frozen=True)
class Regime:
    """One row of the page."""

    name: str
    about: str
    preset: Preset
    scenarios: tuple[Scenario, ...]
    seconds: float
    """Length of a flight [s]."""
    score: Score
    adapted: str = "full"
    """Method of the column "adapted"."""
    published: str = "-"
    """Result of others in a comparable regime, with its source."""


def mean_error(flight: Flight) -> float:
    """Return the mean error over the last two seconds [m]."""
    return float(np.mean(flight.error[_tail(flight, LAST)]))


def tracking_error(flight: Flight) -> float:
    """Return the mean distance from the reference over the last ten seconds [m]."""
    return float(np.mean(flight.error[_tail(flight, TAIL)]))


def fastest_lap_error(flight: Flight) -> float:
    """Return the mean error of the last lap [m], or infinity if the first lap took less than 3.5 times as long.

    Raises:
        ValueError: The flight does not follow a paced reference.
    """
    name, phase = flight.spec.scenario.reference, flight.log.phase
    if name is None or phase is None:
        raise ValueError("fastest_lap_error needs a flight at a variable pace")
    start, end = (float(t) for t in make_reference(name).lap)
    laps = int((phase[-1] - start) // (end - start))
    ends = np.interp(start + (end - start) * np.arange(laps + 1), phase, flight.log.t)
    if laps < 2 or ends[1] - ends[0] < LAP_RATIO * (ends[-1] - ends[-2]):
        return float("inf")
    return float(np.mean(flight.error[(flight.log.t >= ends[-2]) & (flight.log.t <= ends[-1])]))


def rms_error(flight: Flight) -> float:
    """Return the root mean square of the distance from the reference over the last ten seconds [m]."""
    return float(np.sqrt(np.mean(flight.error[_tail(flight, TAIL)] ** 2)))


def rms_error_with_changes(flight: Flight) -> float:
    """Return :func:`rms_error` for the last 16 seconds, which contain a pick-up and a release [m]."""
    return float(np.sqrt(np.mean(flight.error[_tail(flight, CHANGES)] ** 2)))


def height_error(flight: Flight) -> float:
    """Return the root mean square of the height error over the last ten seconds [m].

    Raises:
        ValueError: The flight has no target.
    """
    if flight.target is None:
        raise ValueError("height_error needs a flight with a target")
    errors = flight.log.true.p[:, 2] - flight.target[:, 2]
    return float(np.sqrt(np.mean(errors[_tail(flight, TAIL)] ** 2)))


def height_error_above_table(flight: Flight) -> float:
    """Return :func:`height_error`, or infinity if the vehicle has touched the table or the floor [m]."""
    table, x = disturbance(flight.spec.scenario.disturbance), flight.log.true
    assert isinstance(table, TableEdge)
    clearance = jax.vmap(lambda p, R, v: table.clearance(State(p, R, v)))(*map(jnp.asarray, (x.p, x.R, x.v)))
    return height_error(flight) if float(clearance.min()) > 0.0 else float("inf")


def _tail(flight: Flight, seconds: float) -> np.ndarray:
    t = np.asarray(flight.log.t)
    rows: np.ndarray = t > t[-1] - seconds
    return rows


def regimes() -> tuple[Regime, ...]:
    """Return the rows of the page, in their order."""
    hover, any_hover = load("hover/retrim"), load("hover/any")
    tracking = load("track/retrim")
    over_places = changed(tracking, vehicle="large", adapt=replace(tracking.adapt, residual="place"))
    slow, paced = slow_quadrotor(), load("track/paced")
    with_load = changed(tracking, adapt=replace(tracking.adapt, residual="swing"))
    circle = "circle=1"
    hidden = tuple(vehicle.scenario(PUSH) for vehicle in draw_vehicles(VEHICLES, VEHICLE_SEED))
    at_rest = Score(mean_error, f"mean error, last {LAST:g} s")
    on_path = Score(tracking_error, f"mean error, last {TAIL:g} s")
    on_path_rms = Score(rms_error, f"RMS error, last {TAIL:g} s")
    calm = Score(seconds_to_calm, "time after the stop until the swing remains below 5° [ms]")
    in_height = Score(height_error, f"RMS height error, last {TAIL:g} s")
    per_lap = Score(fastest_lap_error, f"mean error, last lap; a ratio of lap times below {LAP_RATIO:g} counts as lost")
    above_table = Score(height_error_above_table, f"RMS height error, last {TAIL:g} s; a contact counts as lost")
    return (
        Regime(
            "S1 hidden vehicles",
            f"{VEHICLES} vehicles of 30 g to 3 kg, unknown to every method; a push of 2 m/s² per axis",
            any_hover, hidden, 10.0, at_rest, adapted="base-id",
            published="xadapt 100 % survive, 0.154 m; RAPTOR 0.1 to 0.3 m",
        ),
        Regime(
            "S2 slow rate loop",
            "body rates lag by 100 ms (vehicle file: 15 ms); a push",
            any_hover, (Scenario(PUSH, plant="second-order", vehicle=slow, delay=DELAY),), 10.0, at_rest,
            adapted="base-id", published="INDI acceptable below 40 ms (arXiv 2605.05483)",
        ),
        Regime(
            "S3 unknown delay",
            "commands act 60 ms late (declared: 20 ms); a push",
            any_hover, (Scenario(PUSH, delay=0.06),), 10.0, at_rest, adapted="base-id",
            published="RAPTOR oscillates from 10 to 30 ms on",
        ),
        Regime(
            "S4 growing speed",
            "a figure-8 of 3 m x 1 m as fast as possible, after 60 s; the first lap takes 8.2 s",
            changed(paced, vehicle="large"), (Scenario(reference="figure8=max"),), 60.0, per_lap,
            published="8.34 to 2.34 s in 100 s (LAFR)",
        ),
        Regime(
            "S4 sagging battery",
            f"the same with a thrust of {THRUST_TO_WEIGHT:g} times the weight, which falls by 0.2 % per second",
            changed(paced, vehicle=heavy_quadrotor()), (Scenario("battery", reference="figure8=max"),), 60.0, on_path,
        ),
        Regime(
            "corners",
            "the star, through its corners at constant speed",
            tracking, (Scenario(reference="star"),), 30.0, on_path,
        ),
        Regime(
            "S5 downwash",
            "a circle at 1 m/s, 0.75 m below a second vehicle; after the third pass",
            over_places, (Scenario("downwash", reference=circle),), 32.0, in_height,
            published="-75 % height error (arXiv 2304.07794)",
        ),
        Regime(
            "S6 table edge",
            "a circle at 1 m/s over the edge of a table, 2 cm above it; after eight passes",
            over_places, (Scenario("table-edge", reference=circle),), 38.0, above_table,
            published="-72 % height error (arXiv 2203.07747)",
        ),
        Regime(
            "S7 no load", "a figure-8 of 3 m by 1 m in 5 s without a load, for comparison",
            with_load, (Scenario(reference="figure8"),), 24.0, on_path_rms,
        ),
        Regime(
            "S7 slung load",
            "the same figure-8 with a load of 30 % of the mass on a cable of 0.5 m, unknown to every method",
            with_load, (Scenario("slung-load=0.3", reference="figure8"),), 24.0, on_path_rms,
            published="\"significantly outperforms\" (arXiv 2605.16015)",
        ),
        Regime(
            "S7 stop",
            "the same load; a circle of 1 m in 3 s, and a stop within 0.6 s",
            with_load, (Scenario("slung-load=0.3", reference="retrim_paper.slung_load:circle_and_stop"),), END, calm,
        ),
        Regime(
            "S7 pick-up and release",
            "the same load on a circle at 1 m/s, picked up at rest at 8 s and dropped at 20 s",
            with_load, (Scenario("slung-pickup=0.3", reference=circle),), 24.0,
            Score(rms_error_with_changes, f"RMS error, last {CHANGES:g} s"),
        ),
        Regime(
            "S8 off-centre load",
            "a third of the mass, 3 cm off the centre",
            hover, (Scenario("off-centre=0.03"),), 20.0, at_rest,
        ),
        Regime(
            "S8 far off the centre",
            "the same load, 10 cm off the centre; at 15.7 cm, two rotors would have to stop",
            hover, (Scenario("off-centre=0.1"),), 20.0, at_rest,
        ),
        *_public_benchmark(on_path),
        Regime(
            "S10 weak rotor, 50 %",
            "one rotor has half of its thrust",
            hover, (Scenario("weak-rotor=0.5"),), 20.0, at_rest,
            published="95 % survive, 0.129 m (arXiv 2505.08223)",
        ),
        Regime(
            "S10 weak rotor, 30 %",
            "one rotor has 30 % of its thrust",
            hover, (Scenario("weak-rotor=0.3"),), 20.0, at_rest,
            published="95 % survive, 0.129 m (arXiv 2505.08223)",
        ),
        Regime(
            "constant push",
            "2 m/s² per axis, known vehicle",
            hover, (Scenario("large"),), 20.0, at_rest, published="0.02 m (the paper, hover)",
        ),
        Regime(
            "steady wind", "6 m/s, known vehicle", hover, (Scenario("wind=6"),), 20.0, at_rest,
        ),
        Regime(
            "gusts", "4 m/s and Dryden turbulence, known vehicle", hover, (Scenario("gusts"),), 20.0, at_rest,
        ),
        Regime(
            "gusts, many vehicles",
            "the same; the policies were trained for many vehicles, and only the adapted ones identify theirs",
            any_hover, (Scenario("gusts"),), 20.0, at_rest, adapted="base-id",
        ),
    )  # fmt: skip


def _public_benchmark(score: Score) -> tuple[Regime, ...]:
    """Return the ten cells of the benchmark of GP-MPC and neural MPC; they command rotor thrusts, and retrim rates."""
    preset = benchmark_preset()
    return tuple(
        Regime(
            f"S9 {title_of(name)}",
            "the simulator of neural MPC; they command rotor thrusts, here thrust and body rates",
            preset,
            (Scenario(plant="neural-mpc", reference=name),),
            SECONDS,
            score,
            published=values.text(),
        )
        for name, values in PUBLISHED_ERRORS.items()
    )
