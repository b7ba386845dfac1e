"""Conformance of links to vehicles, each flown against a peer that speaks its language.

What flies against the clock is slow, and wants the machine for itself: `make test-links` runs it, and so does CI.
"""

import importlib.util
import time

import jax.numpy as jnp
import numpy as np
import pytest

from peers import peer
from retrim import Command, ConfigError, PlantError, Scenario, State, testing
from retrim.config.plants import find_plant, is_vehicle
from retrim.plants.bridges import crazyflie, mavlink
from retrim.plants.bridges.mavlink_link import MavlinkLink

PORT = 24560
against_the_clock = pytest.mark.slow


def start_vehicle(speaks="mavlink", *words, port=PORT):
    """A process that stands in for an autopilot and its vehicle."""
    if speaks == "mavlink" and importlib.util.find_spec("pymavlink") is None:
        pytest.skip("the extra mavlink is not installed")
    return peer(speaks, "--plant", "simple", "--port", port, *words)


def link(port=PORT, speaks="mavlink", **changes):
    return Scenario(plant=f"{speaks}:udp:127.0.0.1:{port}", **changes).make("small")


@against_the_clock
def test_mavlink_conforms():
    with start_vehicle():
        testing.check_vehicle(link)


@against_the_clock
def test_a_crazyflie_conforms():
    with start_vehicle("crazyflie", port=PORT + 5):
        testing.check_vehicle(lambda: link(PORT + 5, "crazyflie"))


@against_the_clock
def test_another_vehicle_conforms():
    testing.check_vehicle(lambda: Scenario(plant="fake_vehicle:calm").make("small"))


def hovering(plant):
    """A plant that has just been handed over, a metre and a half above the ground."""
    plant.reset(State.at(jnp.array([0.0, 0.0, 1.5])))
    return plant


def step_for(plant, seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        plant.step(Command.hover())


@against_the_clock
def test_hover_thrust_is_learnt_and_a_pilot_who_takes_over_is_left_alone():
    with start_vehicle("mavlink", "--takes-over", "1.0"):
        plant = hovering(link())
        vehicle = Scenario(plant="simple").make_vehicle("small")  # whose thrust is 3.5 % more than commanded
        assert plant.thrust.hover == pytest.approx(float(9.81 * vehicle.mass / vehicle.thrust_max / 1.035), rel=0.02)
        with pytest.raises(PlantError, match="left offboard mode"):
            step_for(plant, 5.0)
        began = time.monotonic()
        plant.stop()
        assert time.monotonic() - began < 1.0  # nothing was asked of it


@against_the_clock
def test_silence_is_noticed():
    with start_vehicle("mavlink", "--cut", "0.5", "60"):
        plant = hovering(link())
        with pytest.raises(PlantError, match="silent for 2 s"):
            step_for(plant, 10.0)
        plant.stop()


@against_the_clock
def test_a_crazyflie_that_is_silent_is_noticed():
    with start_vehicle("crazyflie", "--cut", "0.5", "60", port=PORT + 6):
        plant = hovering(link(PORT + 6, "crazyflie"))
        vehicle = Scenario(plant="simple").make_vehicle("small")
        share = float(9.81 * vehicle.mass / vehicle.thrust_max / 1.035)
        assert plant.thrust.hover / 65_535 == pytest.approx(share, rel=0.02)
        with pytest.raises(PlantError, match="silent for 2 s; a Crazyflie stops its motors"):
            step_for(plant, 10.0)
        plant.stop()


def test_no_crazyflie_there_is_named(monkeypatch):
    monkeypatch.setattr(crazyflie, "ANSWERS_S", 0.3)
    with link(PORT + 7, "crazyflie") as plant, pytest.raises(PlantError, match=r"does not answer on port 13 in 0\.3 s"):
        plant.connect()


def test_nobody_there_is_named(monkeypatch):
    monkeypatch.setattr(mavlink, "LISTENS_S", 0.3)
    with link(PORT + 1) as plant, pytest.raises(PlantError, match=r"no autopilot was heard there in 0\.3 s"):
        plant.connect()


def test_a_port_that_is_taken_is_named():
    pytest.importorskip("pymavlink")
    plant, other = link(PORT + 2), mavlink.open_endpoint(f"udp:127.0.0.1:{PORT + 2}")
    try:
        with pytest.raises(PlantError, match="cannot be listened on"):
            plant.connect()
    finally:
        other.close()


@pytest.mark.parametrize(
    "plant",
    [
        "mavlink",
        "mavlink:udp:127.0.0.1:14540",
        "mavlink:serial:/dev/ttyACM0:921600",
        "crazyflie",
        "crazyflie:udp:10.0.0.7:19850",
        "ros",
        "ros:10.0.0.7:11311/quad1/mavros",
        "ros2",
        "ros2:zenoh@10.0.0.7:7447:px4/px4_1",
    ],
)
def test_a_vehicle_is_known_by_its_name_and_address(plant):
    assert is_vehicle(plant)
    assert find_plant(plant)[1] == plant.partition(":")[2]
    assert Scenario(plant=plant).entry.is_vehicle


@pytest.mark.parametrize("plant", ["bem", "simple", "fake_vehicle:point"])
def test_what_can_be_stopped_in_time_is_no_vehicle(plant):
    assert is_vehicle(plant) == plant.startswith("fake")


@pytest.mark.parametrize(
    ("calls", "why"),
    [
        ({"disturbance": "large"}, "a vehicle, whose world nobody can disturb by name"),
        ({"sensors": "rough"}, "sensors 'rough' need bem, simple or second-order"),
        ({"thrust_error": 0.1}, "its own thrust map"),
        ({"delay": 0.05}, "its own command delay"),
    ],
)
def test_what_a_vehicle_cannot_be_asked_is_refused_before_it_flies(calls, why):
    with pytest.raises(ConfigError, match=why):
        Scenario(plant="mavlink", **calls)


@pytest.mark.parametrize("address", ["udp:nowhere", "14540", "tcp:127.0.0.1:5760"])
def test_a_wrong_address_is_named_before_it_flies(address):
    with pytest.raises(ConfigError, match="expected udp:HOST:PORT"):
        Scenario(plant=f"mavlink:{address}")


@pytest.mark.parametrize(
    "address", ["11311", "10.0.0.7:0", "10.0.0.7:70000", "10.0.0.7:11311/", "http://10.0.0.7:11311"]
)
def test_a_wrong_rosmaster_is_named_before_it_flies(address):
    with pytest.raises(ConfigError, match="expected HOST:PORT of a rosmaster"):
        Scenario(plant=f"ros:{address}")


def test_a_crazyflie_is_not_reached_by_a_serial_line():
    with pytest.raises(ConfigError, match="a Crazyflie is reached by udp:HOST:PORT"):
        Scenario(plant="crazyflie:serial:/dev/ttyACM0:921600")


@pytest.mark.parametrize(("plant", "why"), [("mavlink", "10 to 250 Hz"), ("crazyflie", "10 to 100 Hz")])
def test_a_rate_that_an_autopilot_does_not_take_is_refused(plant, why):
    with pytest.raises(ConfigError, match=why):
        Scenario(plant=plant).make("small", dt=0.2)


def test_commands_stay_within_what_the_vehicle_takes():
    plant = link()
    plant.thrust.learn(np.full(5, 0.5))

    class Deaf(MavlinkLink):
        def __init__(self):
            self.transmission, self.reading, self.last_message = None, None, 0.0

        def fly_rates(self, thrust, omega):
            self.transmission = thrust, omega

    plant._link = deaf = Deaf()
    extract = plant.send(np.array([1e3, 99.0, -99.0, 0.0]))
    assert deaf.transmission[0] == 1.0
    assert extract == pytest.approx([2 * 9.81, plant.high[1], plant.low[2], 0.0])
