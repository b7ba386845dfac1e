"""A flight at a variable pace starts slowly, waits for a displaced vehicle, and is the same in every pilot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from helpers import CheapModel, brief_preset
from retrim.config import Setup, disturbance
from retrim.config.loading import load
from retrim.config.pacing import pace_limits
from retrim.config.scenario import Scenario
from retrim.control.controller import AbstractController
from retrim.control.paced_flight import PacedFlight
from retrim.live.processes.controllers import plain_source
from retrim.onboard.pilot import LivePilot
from retrim.physics import Command, State, small
from retrim.plants import SimPlant
from retrim.runkit.flights import FlightSpec
from retrim.runkit.flying import score_flight
from retrim.runtime import ControllerPilot, fly
from retrim.runtime.together import fly_together
from retrim.tasks.shapes import figure8

TICKS = 60


class ExpectsMissingThrust(AbstractController[tuple[()]]):
    """A controller that commands hover and expects a share of the thrust to be missing."""

    missing: jax.Array

    def init(self, x):
        return ()

    def __call__(self, memory, t, x):
        return Command.hover(x.p.dtype), memory

    def disturbance(self, memory, x, u):
        return -self.missing * u.c * x.R[:, 2]


def final_clock(missing=0.0, off=0.0, ticks=1500, limits=None):
    """Return the last memory of a flight at a distance from the reference."""
    limits = limits or pace_limits(load("track/retrim"), small())
    controller = PacedFlight.of(ExpectsMissingThrust(jnp.array(missing)), figure8(), limits, 0.02)

    @jax.jit
    def run():
        def tick(memory, k):
            t = 0.02 * k
            p = controller.reference(memory.clock.phase_at(t)).p + jnp.array([0.0, off, 0.0])
            return controller(memory, t, State.at(p))[1], memory.share

        return lax.scan(tick, controller.init(State.at(jnp.zeros(3))), jnp.arange(ticks, dtype=float))

    return run()


def test_share_of_limits_grows_to_one_while_error_is_small():
    memory, shares = final_clock()
    assert (np.diff(shares) >= 0.0).all()
    assert float(shares[0]) < 0.5
    assert float(memory.share) == 1.0


def test_displaced_vehicle_flies_slow_lap():
    memory, shares = final_clock(off=0.3)
    np.testing.assert_allclose(shares, shares[0])
    assert float(memory.clock.pace) < 0.8


def test_missing_thrust_slows_flight():
    """A vehicle that can barely hover slows down until the thrust suffices for the most demanding part of the path."""
    limits = pace_limits(load("track/retrim"), small())
    weak = limits.__class__(jnp.array(14.0), limits.rates, limits.lag, limits.corner, limits.turning)
    full, sagging = (final_clock(missing=share, limits=weak)[0] for share in (0.0, 0.2))
    assert float(sagging.clock.phase) < 0.9 * float(full.clock.phase)


@pytest.fixture(scope="module")
def setup(as_a_user):
    return Setup.from_preset(brief_preset("track/retrim"), "figure8=max")


def plants(n):
    return [SimPlant(CheapModel(0.02), disturbance("small"), seed=i) for i in range(n)]


def pilots(setup, n):
    return [setup.pilot(None, "indi") for _ in range(n)]


def test_batch_has_phases_of_single_flights(setup):
    starts = setup.flight_starts(2)
    logs = fly_together(plants(2), pilots(setup, 2), starts, ticks=TICKS)
    singles = [fly(*each, ticks=TICKS) for each in zip(plants(2), pilots(setup, 2), starts, strict=True)]
    for log, single in zip(logs, singles, strict=True):
        assert log.phase is not None
        assert len(log.phase) == TICKS + 1
        np.testing.assert_allclose(log.phase, single.phase, atol=1e-4)
        np.testing.assert_allclose(log.p, single.p, atol=1e-4)
        assert (np.diff(log.phase) > 0.0).all()


def test_score_uses_reference_at_phase(setup):
    start = setup.flight_starts(1)[0]
    log = fly(plants(1)[0], pilots(setup, 1)[0], start, ticks=TICKS)
    flight = score_flight(setup, FlightSpec(Scenario(reference="figure8=max"), "indi", 0), log)
    targets = np.stack([np.asarray(setup.flight_reference(jnp.array(phase, log.p.dtype)).p) for phase in log.phase])
    np.testing.assert_allclose(flight.error, np.linalg.norm(log.p - targets, axis=1), atol=1e-5)
    plain = Setup.from_preset(setup.preset, "figure8")
    assert fly(plants(1)[0], plain.pilot(None, "indi"), start, ticks=3).phase is None


def test_live_pilot_has_same_pace(setup):
    controller = setup.pilot(None, "indi").controller
    live, pilot = LivePilot(plain_source(setup, controller)), ControllerPilot(controller)
    plant = plants(1)[0]
    measurement = plant.reset(setup.flight_starts(1)[0])
    pilot.reset(measurement)
    live.reset(vector(measurement.x))
    for _ in range(25):
        u = pilot.act(measurement)
        mine = live.act(measurement.t, 0.0, vector(measurement.x))
        np.testing.assert_allclose(mine, np.append(u.c, u.omega), atol=2e-3)
        for after in (0.0, 0.013, 0.9):
            t = measurement.t + after
            np.testing.assert_allclose(live.task_time(t), pilot.task_time(t), atol=1e-4)
        measurement, _ = plant.step(u)
    assert live.task_time(measurement.t) != pytest.approx(measurement.t, rel=1e-2)


def vector(x):
    return np.concatenate([np.asarray(x.p), np.asarray(x.R).ravel(), np.asarray(x.v)])
