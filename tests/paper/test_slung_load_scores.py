"""The reference with a stop, and the load swing that follows from the log of a flight."""

import jax.numpy as jnp
import numpy as np
import pytest

from helpers import at
from retrim.config import Scenario
from retrim.physics import Command, State, small
from retrim.physics.slung_load import swing_angle
from retrim.runkit.flights import Flight, FlightSpec
from retrim.runtime import FunctionPilot, fly
from retrim_paper.slung_load import BRAKING, END, STOP, circle_and_stop, seconds_to_calm, swing_angles


def record_of(log, disturbance):
    spec = FlightSpec(Scenario(disturbance, plant="simple"), "base", 0)
    return Flight(spec, "small", log, np.zeros(len(log.t)), "tracking_error_m", 10.0)


def test_reference_stops_smoothly_and_is_feasible():
    reference = circle_and_stop()
    assert reference.infeasibility(small()) is None
    points = at(reference, np.arange(0.0, END, 0.02))
    speed, t = np.linalg.norm(points.v, axis=1), np.arange(0.0, END, 0.02)
    np.testing.assert_allclose(speed[(t > 4.0) & (t < STOP)], 2.0 * np.pi / 3.0, rtol=1e-2)
    assert speed[t > STOP + BRAKING + 0.03].max() < 1e-3
    assert np.linalg.norm(np.diff(points.p, axis=0), axis=1).max() < 0.05


@pytest.fixture(scope="module")
def flight():
    """Return a flight of 2 s with an alternating tilt, and the true swing."""
    plant = Scenario("slung-load=0.3", plant="simple").make(small())
    angles = []

    def act(measurement):
        state = plant._state
        angles.append(float(swing_angle(state.disturbance[0], plant.simulation.true(state))))
        return Command(jnp.array(12.5), jnp.array([0.8 * np.sin(3.0 * measurement.t), 0.0, 0.0]))

    log = fly(plant, FunctionPilot(act), State.at(jnp.array([0.0, 0.0, 1.0])), ticks=100)
    return record_of(log, "slung-load=0.3"), np.array(angles[1:])


def test_swing_follows_from_log(flight):
    flight_log, true = flight
    angles = swing_angles(flight_log)
    assert true.max() > 0.05
    np.testing.assert_allclose(angles[: len(true)], true, atol=0.01)


def test_flight_without_load_has_no_swing(flight):
    with pytest.raises(ValueError, match="'none' has no load on a cable"):
        swing_angles(record_of(flight[0].log, "none"))
    assert seconds_to_calm(flight[0]) == 0.0  # the flight ends before the stop
