"""The simulated vehicle for PX4's firmware: sensors, motors and signs, with a program in place of PX4."""

import contextlib
import socket
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from retrim.config.disturbances import disturbance
from retrim.config.vehicles import make_vehicle
from retrim.errors import ConfigError, PlantError
from retrim.physics.state import STANDARD_GRAVITY
from retrim.testing import px4, px4_world
from retrim.testing.px4_world import HOME, METRES, Px4World, parameters_of, thrust_factor
from retrim_paper.latency import free_port

mavlink = pytest.importorskip("pymavlink.dialects.v20.common")
X500 = str(Path(__file__).parents[2] / "examples/x500.toml")
HOVER = 0.5  # share of the motors at hover, about
FRONT_RIGHT, REAR_LEFT, FRONT_LEFT, REAR_RIGHT = range(4)
pytestmark = pytest.mark.usefixtures("as_a_user")


class Autopilot:
    """A program that answers each measurement with the same motor commands."""

    def __init__(self, port):
        self.line = socket.create_connection(("127.0.0.1", port), timeout=5.0)
        self.line.settimeout(0.2)
        self.codec = mavlink.MAVLink(None, srcSystem=1)
        self.newest = {}

    def answer(self, motors):
        controls = [*map(float, motors), *(0.0,) * 12]
        self.line.sendall(mavlink.MAVLink_hil_actuator_controls_message(0, controls, 0, 0).pack(self.codec))

    def receive(self):
        for message in self.codec.parse_buffer(self.line.recv(65_535)) or ():
            self.newest[message.get_type()] = message


@pytest.fixture
def fly(monkeypatch):
    """Return a function that runs a world with constant motor commands, and returns the world and the last messages."""
    with contextlib.ExitStack() as stack:

        def run(motors, steps=50, *, push=False):
            monkeypatch.setattr(px4_world, "PORT", free_port())
            world = stack.enter_context(contextlib.closing(Px4World(make_vehicle(X500), disturbance("push-x"))))
            autopilot = Autopilot(px4_world.PORT)
            stack.callback(autopilot.line.close)
            world.connect()
            if push:
                world.disturb()
            for _ in range(steps):
                autopilot.answer(motors)
                world.step()
                autopilot.receive()
            return world, autopilot.newest

        yield run


def test_sensors_at_rest_measure_gravity_and_field(fly):
    world, messages = fly(np.zeros(4), 20)
    x = messages["HIL_SENSOR"]
    np.testing.assert_allclose([x.xacc, x.yacc, x.zacc], [0.0, 0.0, -STANDARD_GRAVITY], atol=0.3)
    np.testing.assert_allclose([x.xgyro, x.ygyro, x.zgyro], 0.0, atol=0.02)
    # The nose points east, so north is to the left.
    np.testing.assert_allclose([x.xmag, x.ymag, x.zmag], [0.0, -0.21, 0.43], atol=0.01)
    np.testing.assert_allclose(world.capture().p, 0.0, atol=3e-3)


@pytest.mark.parametrize(
    ("stronger", "axis", "sign"),
    [
        ((FRONT_LEFT, REAR_LEFT), "xgyro", 1.0),  # roll to the right
        ((FRONT_LEFT, FRONT_RIGHT), "ygyro", 1.0),  # nose up
        ((FRONT_RIGHT, REAR_LEFT), "zgyro", 1.0),  # these turn counter-clockwise, so the body turns clockwise
    ],
)
def test_motors_turn_vehicle_as_px4_expects(fly, stronger, axis, sign):
    motors = np.full(4, HOVER + 0.1)
    motors[list(stronger)] += 0.04
    world, messages = fly(motors, 40)
    rates = {name: getattr(messages["HIL_SENSOR"], name) for name in ("xgyro", "ygyro", "zgyro")}
    assert max(rates, key=lambda name: abs(rates[name])) == axis
    assert sign * rates[axis] > 0.05
    assert world.capture().p[2] > 0.0


def test_vehicle_leaves_floor_only_with_enough_thrust(fly):
    world, _ = fly(np.full(4, HOVER - 0.1))
    assert abs(world.capture().p[2]) < 3e-3
    world, messages = fly(np.full(4, HOVER + 0.1))
    height = world.capture().p[2]
    assert 0.02 < height < 1.0
    assert 1e-3 * messages["HIL_STATE_QUATERNION"].alt == pytest.approx(HOME[2] + height, abs=0.02)


def test_disturbance_begins_on_request(fly):
    """A push along x, which is east, moves the vehicle in flight, and the truth message reports the movement."""
    calm, _ = fly(np.full(4, HOVER + 0.1), 100)
    world, messages = fly(np.full(4, HOVER + 0.1), 100, push=True)
    assert abs(calm.capture().p[0]) < 0.01
    east = world.capture().p[0]
    assert 0.05 < east < 0.3
    degrees = 1e-7 * messages["HIL_STATE_QUATERNION"].lon - HOME[1]
    assert degrees * METRES * np.cos(np.radians(HOME[0])) == pytest.approx(east, abs=0.02)


def test_silent_autopilot_does_not_stop_world(fly):
    world, _ = fly(np.zeros(4), 1)
    began = time.monotonic()
    for _ in range(5):
        world.step()
    assert time.monotonic() - began < 1.0


def test_thrust_factor_fits_speed_controllers():
    vehicle = make_vehicle(X500)
    f, signal = thrust_factor(vehicle), np.linspace(0.0, 1.0, 11)
    speed = np.asarray(vehicle.esc.speed(jnp.asarray(signal, jnp.float32)))
    np.testing.assert_allclose(f * signal**2 + (1.0 - f) * signal, (speed / speed[-1]) ** 2, atol=0.03)
    parameters = parameters_of(vehicle)
    assert parameters["THR_MDL_FAC"] == f
    assert sum(parameters[f"CA_ROTOR{n}_PX"] for n in range(4)) == 0.0


def test_wrong_options_are_refused_in_one_line(capsys):
    for words, message in (
        (("nowhere", "--disturbance", "large"), "--disturbance needs --vehicle"),
        (("nowhere", "--vehicle", "missing.toml"), "missing.toml: no such file"),
        (("nowhere",), "nowhere: there is no bin/px4 there"),
    ):
        with pytest.raises((SystemExit, ConfigError, PlantError)) as error:
            px4.main(words)
        assert message in str(error.value) + capsys.readouterr().err


def test_port_in_use_is_reported(monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen(1)
        monkeypatch.setattr(px4_world, "PORT", taken.getsockname()[1])
        with pytest.raises(PlantError, match="to which PX4 connects, is in use"):
            Px4World(make_vehicle(X500), disturbance("none"))
