"""Conformance of every plant. A new plant needs one row in PLANTS."""

import importlib.util
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import random_state
from retrim import ConfigError, PlantError, load
from retrim.cli.arguments import FlightArguments
from retrim.config import PRESETS, Scenario, Setup
from retrim.control import AbstractController
from retrim.errors import RetrimError
from retrim.physics import Command, Constant, Payload, State, small, so3
from retrim.plants import Plant, crazyflow
from retrim.plants.bridges import ros2
from retrim.plants.crazyflow import CrazyflowPlant
from retrim.plants.mujoco import MujocoPlant
from retrim.plants.rotorpy import RotorpyPlant
from retrim.ros2 import backends
from retrim.runtime import ControllerPilot, FunctionPilot, fly

EXTRAS = ("rotorpy", "mujoco", "crazyflow")


def maker(plant):
    """Return the function from a disturbance by name to the plant."""
    return lambda disturbance: Scenario(disturbance, plant).make()


PLANTS = {name: maker(name) for name in ("bem", "simple", *EXTRAS)}
START = State.at(jnp.array([0.3, -0.2, 1.5]))


@pytest.fixture(params=list(PLANTS))
def make(request):
    """Return the plant under disturbances by name; skip the test if its extra is not installed."""
    if request.param in EXTRAS and importlib.util.find_spec(request.param) is None:
        pytest.skip(f"the extra {request.param} is not installed")
    return PLANTS[request.param]


@pytest.fixture
def plant(make):
    return make("none")


def after(plant, ticks, c=9.81, omega=(0.0, 0.0, 0.0)):
    """Return the state after that many ticks of one command."""
    plant.reset(START)
    for _ in range(ticks):
        measurement, _ = plant.step(Command(jnp.array(c), jnp.array(omega)))
    return measurement.x


def test_is_a_plant(plant):
    assert isinstance(plant, Plant)


def test_reset_sets_state(plant, key):
    for x0 in (START, random_state(key, 0.3)):
        measurement = plant.reset(x0)
        assert measurement.t == 0.0
        jax.tree.map(np.testing.assert_array_equal, measurement.x, x0)
        jax.tree.map(np.testing.assert_array_equal, measurement.truth, x0)


def test_default_reset_is_a_metre_above_ground(plant):
    measurement = plant.reset(None)
    np.testing.assert_array_equal(measurement.x.vector(), State.at(jnp.array([0.0, 0.0, 1.0])).vector())


def test_time_advances_by_ticks(plant):
    plant.reset(START)
    times = [plant.step(Command.hover())[0].t for _ in range(5)]
    np.testing.assert_allclose(times, plant.dt * np.arange(1, 6), atol=1e-12)


def test_reset_clears_history(plant):
    def flight():
        plant.reset(START)
        return [plant.step(Command(jnp.array(11.0), jnp.array([1.0, 0.5, 0.2])))[0].x.vector() for _ in range(10)]

    np.testing.assert_array_equal(flight(), flight())


def test_hover_command_hovers(plant):
    assert float(jnp.linalg.norm(after(plant, 10).p - START.p)) < 0.05


def test_command_acts_after_delay_and_is_accepted(plant):
    """The command of tick k moves the vehicle from tick k + delay on, and not before."""
    rolling, plain = [], []
    for rates, into in ((jnp.array([3.0, 0.0, 0.0]), rolling), (jnp.zeros(3), plain)):
        plant.reset(START)
        for _ in range(4):
            u = Command(jnp.array(9.81), rates)
            measurement, accepted_command = plant.step(u)
            assert accepted_command is u
            into.append(np.asarray(measurement.x.R))
    assert np.array_equal(rolling[0], plain[0])  # 20 ms of delay: one tick
    assert not np.array_equal(rolling[1], plain[1])


@pytest.mark.parametrize("axis", range(3))
def test_rates_rotate_about_body_axes(plant, axis):
    """1 rad/s for 0.4 s, minus the delay and the lag of the rate loop."""
    angles = so3.log(after(plant, 20, omega=jnp.zeros(3).at[axis].set(1.0)).R)
    assert 0.25 < float(angles[axis]) < 0.4
    assert float(jnp.linalg.norm(angles)) == pytest.approx(float(angles[axis]), rel=0.05)


def test_measured_rates_and_acceleration_match_motion(plant):
    """Rates at the end of a tick and the mean acceleration over it agree with attitudes and velocities."""
    elapsed_time = [plant.reset(START)]
    for k in range(16):
        rates = jnp.array([1.5, -1.0, 0.5]) * (1.0 if k < 8 else -1.0)
        elapsed_time.append(plant.step(Command(jnp.array(11.0), rates))[0])
    for before, now in pairwise(elapsed_time):
        rates = so3.log(before.R.T @ now.R) / plant.dt
        ends = np.stack([before.omega, now.omega])
        slack = 0.15 + 0.25 * np.ptp(ends, axis=0)  # rates may have been higher within the tick
        assert np.all(rates > ends.min(axis=0) - slack)
        assert np.all(rates < ends.max(axis=0) + slack)
        np.testing.assert_allclose(now.a, (now.v - before.v) / plant.dt, atol=0.02)
    assert float(jnp.linalg.norm(elapsed_time[8].omega)) > 1.0
    assert float(elapsed_time[-1].omega @ elapsed_time[8].omega) < 0.0


def test_command_beyond_limits_has_effect_of_accepted_command(plant):
    low, high = small().command_min, small().command_max
    for calls in (Command(jnp.array(500.0), 1e3 * high.omega), Command(jnp.array(-5.0), 1e3 * low.omega)):
        plant.reset(START)
        plant.step(calls)
        _, accepted_command = plant.step(calls)
        assert 0.0 <= float(accepted_command.c) < 150.0
        beyond = plant.step(calls)[0]
        plant.reset(START)
        for _ in range(3):
            message, again = plant.step(accepted_command)
            assert again is accepted_command
        np.testing.assert_array_equal(beyond.x.vector(), message.x.vector())


def test_thrust_is_per_mass(plant):
    """2 m/s^2 above hover, for 0.1 s after the motors have settled."""
    rise = [float(after(plant, ticks, c=11.81).v[2] - after(plant, ticks).v[2]) for ticks in (10, 15)]
    assert 0.15 < rise[1] - rise[0] < 0.23


def test_push_accelerates(make):
    """0.5 m/s^2 per axis for 0.1 s."""
    with_push, calm = after(make("small"), 5), after(make("none"), 5)
    np.testing.assert_allclose(with_push.v - calm.v, 0.05, rtol=0.1)


def test_wind_accelerates_downwind(make):
    """The wind is along (1, 1, 0)."""
    blown, calm = after(make("wind"), 50), after(make("none"), 50)
    shift = blown.p - calm.p
    assert float(shift[0] + shift[1]) / 2**0.5 > 0.03
    assert abs(float(shift[0] - shift[1])) < 0.1 * float(shift[0] + shift[1])


def test_wind_is_in_world_frame(make):
    """The result is independent of the heading."""
    plant = make("wind")
    plant.reset(State(START.p, so3.exp(jnp.array([0.0, 0.0, 2.5])), START.v))
    for _ in range(50):
        measurement, _ = plant.step(Command.hover())
    shift = measurement.x.p - START.p
    assert float(shift[0]) > 0.02
    assert float(shift[1]) > 0.02


def support(make, disturbance):
    try:
        return after(make(disturbance), 10)
    except PlantError as error:
        pytest.skip(str(error))


def test_load_accelerates_downwards(make):
    """A load of 70 g exceeds the thrust at hover."""
    assert float(support(make, "payload").v[2] - after(make("none"), 10).v[2]) < -0.3


def test_weak_rotor_tilts_towards_itself(make):
    """The weak rotor is front right."""
    up = support(make, "weak-rotor").R[:, 2] - after(make("none"), 10).R[:, 2]
    assert float(up[0]) > 1e-3
    assert float(up[1]) < -1e-3


def test_unsupported_disturbance_is_refused_at_construction():
    pytest.importorskip("rotorpy")
    plant = RotorpyPlant(Payload.of(0.07, picked=0.2))
    plant.reset(START)
    for _ in range(10):
        before, _ = plant.step(Command.hover())
    for _ in range(2):
        with pytest.raises(PlantError, match="cannot carry a load or weaken rotors; it supports pushes and wind"):
            plant.step(Command.hover())
    assert before.t == pytest.approx(0.2)
    with pytest.raises(PlantError, match="cannot carry a load"):
        after(PLANTS["rotorpy"]("weak-rotor"), 1)


def test_flights_in_threads_equal_serial_flights(make):
    def flight(_):
        return after(make("wind"), 30, 10.0, (0.5, 0.2, 0.1)).vector()

    with ThreadPoolExecutor(2) as pool:
        for result in pool.map(flight, range(4)):
            np.testing.assert_array_equal(result, flight(None))


def test_flight_has_dtype_of_start(make):
    plant = make("wind")
    with jax.enable_x64(False):
        plant32 = make("wind")
        x0 = Setup.from_preset(PRESETS["hover/fast"]).flight_starts(1)[0]
        assert plant32.reset(x0).x.p.dtype == jnp.float32
        assert plant32.step(Command.hover())[0].x.p.dtype == jnp.float32
    assert plant.reset(START).x.p.dtype == jnp.float64
    assert plant.step(Command.hover())[0].x.p.dtype == jnp.float64


@pytest.mark.parametrize(
    ("c", "omega", "name"),
    [(float("nan"), [0, 0, 0], "c = nan"), (9.81, [0, float("inf"), 0], r"omega\[1\] = inf")],
)
def test_nonfinite_command_is_refused(plant, c, omega, name):
    plant.reset(START)
    with pytest.raises(PlantError, match=f"command refused, {name} is not finite"):
        plant.step(Command(jnp.array(c), jnp.array(omega, dtype=float)))
    assert plant.step(Command.hover())[0].t == pytest.approx(plant.dt)  # and nothing was lost


def test_stop_is_idempotent_and_final(plant):
    plant.stop()
    plant.reset(START)
    plant.stop()
    plant.stop()
    with pytest.raises(PlantError, match="call reset first"):
        plant.step(Command.hover())
    assert plant.reset(START).t == 0.0


class FailingController(AbstractController[None]):
    def init(self, x):
        return None

    def __call__(self, memory, t, x):
        return Command(jnp.where(t > 0.05, jnp.nan, 9.81), jnp.zeros(3)), None


def test_flight_stops_plant_after_command_that_is_not_finite(plant):
    assert fly(plant, ControllerPilot(FailingController()), START, ticks=10).terminated
    with pytest.raises(PlantError, match="call reset first"):
        plant.step(Command.hover())


def test_context_exit_stops_plant(plant):
    with plant as entries:
        assert entries is plant
        plant.reset(START)
        plant.step(Command.hover())
    with pytest.raises(PlantError, match="call reset first"):
        plant.step(Command.hover())


def test_log_has_every_tick(plant):
    log = fly(plant, FunctionPilot(lambda measurement: Command.hover()), START, ticks=7)
    assert log.t.shape == (8,)
    assert log.p.shape == (8, 3)
    assert log.R.shape == (8, 3, 3)
    assert log.u.shape == (8, 4)
    assert log.dt == plant.dt
    assert log.missed_ticks == 0
    assert not log.terminated


@pytest.mark.parametrize("name", ["bem", "simple"])
def test_command_beyond_limits_is_clipped_and_reported(name):
    """The reported command is the one that acts: the motion equals that under the clipped command."""
    low, high = small().command_min, small().command_max
    plant = PLANTS[name]("none")
    for wild, within in (
        (Command(jnp.array(500.0), jnp.array([50.0, 0.0, -50.0])), (high.c, high.omega[0], 0.0, low.omega[2])),
        (Command(jnp.array(-5.0), jnp.array([0.0, -50.0, 0.0])), (low.c, 0.0, low.omega[1], 0.0)),
    ):
        plant.reset(START)
        _, accepted_command = plant.step(wild)
        np.testing.assert_allclose(accepted_command.vector(), within)
        state = after(plant, 5, wild.c, wild.omega)
        np.testing.assert_array_equal(
            state.vector(), after(plant, 5, accepted_command.c, accepted_command.omega).vector()
        )


# ---- plants that need an extra


IMPORTED = {"rotorpy": "rotorpy.vehicles.hummingbird_params", "mujoco": "mujoco", "crazyflow": "crazyflow.sim.sim"}


@pytest.mark.parametrize("name", EXTRAS)
def test_missing_extra_error_states_installation(name, monkeypatch):
    monkeypatch.setitem(sys.modules, IMPORTED[name], None)
    monkeypatch.setattr(crazyflow, "_simulator", crazyflow._simulator.__wrapped__)  # the module cached the import
    expected = rf"plant '{name}' needs the package '{name}' .*`uv pip install -e '\.\[{name}\]'`.*`pip install {name}`"
    with pytest.raises(PlantError, match=expected) as error:
        PLANTS[name]("none")
    assert isinstance(error.value.__cause__, ImportError)


@pytest.mark.parametrize("name", [*EXTRAS, "mavlink"])
def test_missing_extra_is_reported_before_training(name, monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink" if name == "mavlink" else name, None)
    with pytest.raises(PlantError, match=rf"plant '{name}' needs the package .*`uv pip install -e '\.\[{name}\]'`"):
        FlightArguments(plant=name, disturbance="none").scenario(load("hover/retrim"))


def test_missing_ros_is_reported_before_training(monkeypatch):
    monkeypatch.setitem(sys.modules, "rospy", None)
    with pytest.raises(ConfigError, match="ROS 1 needs rospy from the system: apt install python3-rospy"):
        FlightArguments(plant="ros").scenario(load("hover/retrim"))


@pytest.mark.parametrize("installed", [set(), {"rosbags"}])
def test_missing_ros_2_packages_are_reported_before_training(installed, monkeypatch):
    for module in (ros2, backends):
        monkeypatch.setattr(module, "is_installed", lambda name: name in installed)
    why = "ROS 2 needs rclpy" if installed else "plant 'ros2' needs the package 'rosbags'"
    with pytest.raises(RetrimError, match=rf"{why}.*pip install cyclonedds rosbags"):
        FlightArguments(plant="ros2").scenario(load("hover/retrim"))


def test_missing_firmware_is_reported_before_training(monkeypatch):
    monkeypatch.setenv("RETRIM_BETAFLIGHT", "/nowhere")
    with pytest.raises(PlantError, match="RETRIM_BETAFLIGHT=/nowhere: not a program"):
        FlightArguments(plant="betaflight").scenario(load("hover/retrim"))


def python(code):
    """Run ``code`` in a fresh process; return its output."""
    env = {key: value for key, value in os.environ.items() if key != "SCIPY_ARRAY_API"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True, timeout=120
    )
    return done.stdout


def test_extras_are_not_imported_with_retrim():
    heavy = {*EXTRAS, "scipy"}
    assert python(f"import sys, retrim, retrim.config; print({heavy} & set(sys.modules))") == "set()\n"


def test_scipy_without_array_api_is_refused_with_remedy():
    pytest.importorskip("crazyflow")
    code = """
import scipy
from retrim import PlantError
from retrim.config import Scenario
try:
    Scenario("none", "crazyflow").make()
except PlantError as error:
    print(error)
"""
    assert "plant crazyflow: scipy has already been imported" in python(code)


def test_crazyflow_does_not_change_jax_settings():
    pytest.importorskip("crazyflow")
    after(PLANTS["crazyflow"]("none"), 1)
    config = jax.config.values
    assert config["jax_enable_x64"]
    assert (config["jax_numpy_dtype_promotion"], config["jax_numpy_rank_promotion"]) == ("strict", "raise")
    assert jnp.zeros(1).dtype == jnp.float64
    with pytest.raises(ValueError, match="rank"):
        jnp.zeros(3) + jnp.zeros((2, 3))


def test_mujoco_drag_is_that_of_vehicle():
    """A fall at 5 m/s along each axis: density / 2 c A v^2."""
    pytest.importorskip("mujoco")
    vehicle = small()
    plant = MujocoPlant(vehicle, Constant(jnp.zeros(3)))
    for axis in range(3):
        v = jnp.zeros(3).at[axis].set(5.0)
        plant.reset(State(START.p, START.R, v))
        slower = 5.0 - float(plant.step(Command.hover())[0].x.v[axis])
        drag = 0.5 * 1.225 * float(vehicle.drag_area[axis]) * 25.0 / float(vehicle.mass)
        assert slower / plant.dt == pytest.approx(drag, rel=0.01)


@pytest.mark.parametrize(("name", "cls"), [("mujoco", MujocoPlant), ("crazyflow", CrazyflowPlant)])
def test_tick_must_be_whole_steps(name, cls):
    pytest.importorskip(name)
    with pytest.raises(ValueError, match="not a multiple of the simulator's step"):
        cls(*([small()] if cls is MujocoPlant else []), Constant(jnp.zeros(3)), dt=0.003)
