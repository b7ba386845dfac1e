"""Conformance of links to vehicles, each with a peer that uses its protocol.

Flights in real time are slow and need the whole machine; `make test-links` and CI run them.
"""

import importlib.util
import time

import jax.numpy as jnp
import numpy as np
import pytest

from peers import start_peer
from retrim import Command, ConfigError, PlantError, Scenario, State, testing
from retrim.config.plants import find_plant, is_vehicle
from retrim.plants.bridges import crazyflie, mavlink
from retrim.plants.bridges.mavlink_link import MavlinkLink

PORT = 24560
against_the_clock = pytest.mark.slow


def start_vehicle(protocol="mavlink", *words, port=PORT):
    """Start a process that simulates an autopilot and its vehicle."""
    if protocol == "mavlink" and importlib.util.find_spec("pymavlink") is None:
        pytest.skip("the extra mavlink is not installed")
    return start_peer(protocol, "--plant", "simple", "--port", port, *words)


def link(port=PORT, protocol="mavlink", **changes):
    return Scenario(plant=f"{protocol}:udp:127.0.0.1:{port}", **changes).make("small")


@against_the_clock
def test_mavlink_conformance():
    with start_vehicle():
        testing.check_vehicle(link)


@against_the_clock
def test_crazyflie_conformance():
    with start_vehicle("crazyflie", port=PORT + 5):
        testing.check_vehicle(lambda: link(PORT + 5, "crazyflie"))


@against_the_clock
def test_custom_vehicle_conformance():
    testing.check_vehicle(lambda: Scenario(plant="fake_vehicle:calm").make("small"))


def hovering_vehicle(plant):
    """Yield a plant that has just been handed over, 1.5 m above the ground."""
    plant.reset(State.at(jnp.array([0.0, 0.0, 1.5])))
    return plant


def step_for(plant, seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        plant.step(Command.hover())


@against_the_clock
def test_hover_thrust_is_learned_and_pilot_keeps_control():
    with start_vehicle("mavlink", "--takes-over", "1.0"):
        plant = hovering_vehicle(link())
        vehicle = Scenario(plant="simple").make_vehicle("small")  # the thrust is 3.5 % above the command
        assert plant.thrust.hover == pytest.approx(float(9.81 * vehicle.mass / vehicle.thrust_max / 1.035), rel=0.02)
        with pytest.raises(PlantError, match="left offboard mode"):
            step_for(plant, 5.0)
        began = time.monotonic()
        plant.stop()
        assert time.monotonic() - began < 1.0  # no command was sent


@against_the_clock
def test_silence_is_detected():
    with start_vehicle("mavlink", "--cut", "0.5", "60"):
        plant = hovering_vehicle(link())
        with pytest.raises(PlantError, match="silent for 2 s"):
            step_for(plant, 10.0)
        plant.stop()


@against_the_clock
def test_silent_crazyflie_is_detected():
    with start_vehicle("crazyflie", "--cut", "0.5", "60", port=PORT + 6):
        plant = hovering_vehicle(link(PORT + 6, "crazyflie"))
        vehicle = Scenario(plant="simple").make_vehicle("small")
        share = float(9.81 * vehicle.mass / vehicle.thrust_max / 1.035)
        assert plant.thrust.hover / 65_535 == pytest.approx(share, rel=0.02)
        with pytest.raises(PlantError, match="silent for 2 s; a Crazyflie stops its motors"):
            step_for(plant, 10.0)
        plant.stop()


def test_missing_crazyflie_is_reported(monkeypatch):
    monkeypatch.setattr(crazyflie, "ANSWERS_S", 0.3)
    with link(PORT + 7, "crazyflie") as plant, pytest.raises(PlantError, match=r"does not answer on port 13 in 0\.3 s"):
        plant.connect()


def test_missing_vehicle_is_reported(monkeypatch):
    monkeypatch.setattr(mavlink, "ANSWER_S", 0.3)
    with link(PORT + 1) as plant, pytest.raises(PlantError, match=r"no autopilot was heard there in 0\.3 s"):
        plant.connect()


def test_port_in_use_is_reported():
    pytest.importorskip("pymavlink")
    plant, other = link(PORT + 2), mavlink.open_endpoint(f"udp:127.0.0.1:{PORT + 2}")
    try:
        with pytest.raises(PlantError, match="cannot be opened"):
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
def test_vehicle_is_recognised_by_name_and_address(plant):
    assert is_vehicle(plant)
    assert find_plant(plant)[1] == plant.partition(":")[2]
    assert Scenario(plant=plant).entry.is_vehicle


@pytest.mark.parametrize("plant", ["bem", "simple", "fake_vehicle:point"])
def test_plant_in_lockstep_is_not_a_vehicle(plant):
    assert is_vehicle(plant) == plant.startswith("fake")


@pytest.mark.parametrize(
    ("calls", "why"),
    [
        ({"disturbance": "large"}, "a vehicle, which cannot be disturbed by name"),
        ({"sensors": "rough"}, "sensors 'rough' need bem, simple or second-order"),
        ({"thrust_error": 0.1}, "its own thrust map"),
        ({"delay": 0.05}, "its own command delay"),
    ],
)
def test_unsupported_options_are_refused_before_flight(calls, why):
    with pytest.raises(ConfigError, match=why):
        Scenario(plant="mavlink", **calls)


@pytest.mark.parametrize("address", ["udp:nowhere", "14540", "tcp:127.0.0.1:5760"])
def test_wrong_address_is_refused_before_flight(address):
    with pytest.raises(ConfigError, match="expected udp:HOST:PORT"):
        Scenario(plant=f"mavlink:{address}")


@pytest.mark.parametrize(
    "address", ["11311", "10.0.0.7:0", "10.0.0.7:70000", "10.0.0.7:11311/", "http://10.0.0.7:11311"]
)
def test_wrong_rosmaster_is_refused_before_flight(address):
    with pytest.raises(ConfigError, match="expected HOST:PORT of a rosmaster"):
        Scenario(plant=f"ros:{address}")


def test_crazyflie_on_serial_line_is_refused():
    with pytest.raises(ConfigError, match="a Crazyflie needs udp:HOST:PORT"):
        Scenario(plant="crazyflie:serial:/dev/ttyACM0:921600")


@pytest.mark.parametrize(("plant", "why"), [("mavlink", "10 to 250 Hz"), ("crazyflie", "10 to 100 Hz")])
def test_unsupported_rate_of_autopilot_is_refused(plant, why):
    with pytest.raises(ConfigError, match=why):
        Scenario(plant=plant).make("small", dt=0.2)


def test_commands_stay_within_limits_of_vehicle():
    plant = link()
    plant.thrust.learn(np.full(5, 0.5))

    class NoRates(MavlinkLink):
        def __init__(self):
            self.transmission, self.reading, self.last_message = None, None, 0.0

        def fly_rates(self, thrust, omega):
            self.transmission = thrust, omega

    plant._link = deaf = NoRates()
    extract = plant.send(np.array([1e3, 99.0, -99.0, 0.0]))
    assert deaf.transmission[0] == 1.0
    assert extract == pytest.approx([2 * 9.81, plant.high[1], plant.low[2], 0.0])
