"""Scenarios: disturbances with sizes, sensors, and the plant that they configure."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from retrim import ConfigError, PlantError
from retrim.config import Scenario, disturbance
from retrim.config.disturbances import DISTURBANCES
from retrim.config.sensors import SENSORS, make_sensors
from retrim.physics import Command, State
from retrim.runtime import FunctionPilot, fly

HERE = State.at(jnp.array([0.0, 0.0, 1.0]))


def effects(name, t=0.0, seed=0):
    return disturbance(name, seed)(jnp.array(t), HERE)


# ---- disturbances


@pytest.mark.parametrize(
    ("name", "t", "push"),
    [
        ("none", 0.0, 0.0),
        ("small", 3.0, 0.5),
        ("large", 3.0, 2.0),
        ("push", 0.0, 1.0),
        ("kick", 7.9, 0.0),
        ("kick", 8.2, 0.0),
        ("step", 7.9, 0.0),
        ("step", 8.0, 2.0),
        ("step=-1", 29.0, -1.0),
        ("push=-3", 0.0, -3.0),
        ("early-step", 3.9, 0.0),
        ("early-step", 4.1, 2.0),
        ("reversing", 14.9, 0.5),
        ("reversing", 15.1, -0.5),
        ("reversing=2", 31.0, 2.0),
        ("push=2+large", 0.0, 4.0),
    ],
)
def test_push_acts_in_its_interval(name, t, push):
    result = effects(name, t)
    np.testing.assert_allclose(result.push, push)
    np.testing.assert_array_equal(result.wind, 0.0)
    np.testing.assert_array_equal(result.gain, 1.0)


@pytest.mark.parametrize(("name", "speed"), [("wind", 4.0), ("wind=6", 6.0), ("wind=0", 0.0)])
def test_wind_is_diagonal(name, speed):
    np.testing.assert_allclose(effects(name).wind, [speed / 2**0.5, speed / 2**0.5, 0.0])


@pytest.mark.parametrize(("name", "mean"), [("gusts", 4.0), ("gusts=8", 8.0)])
def test_gusts_have_stated_mean(name, mean):
    winds = np.stack([effects(name, t).wind for t in np.arange(0.0, 200.0, 5.0)])
    np.testing.assert_allclose(winds.mean(axis=0), [mean / 2**0.5, mean / 2**0.5, 0.0], atol=0.25 * mean)
    assert winds.std() > 0.05 * mean


def test_fan_acts_at_goal_only():
    fan = disturbance("fan")
    at_goal = np.stack([fan(jnp.array(t), HERE).wind for t in np.arange(0.0, 20.0, 1.0)]).mean(axis=0)
    assert np.linalg.norm(at_goal) == pytest.approx(4.0, rel=0.15)
    assert at_goal[0] == pytest.approx(at_goal[1], rel=0.25)
    aside = fan(jnp.array(0.0), State.at(jnp.array([1.0, -1.0, 1.0]))).wind
    assert float(jnp.linalg.norm(aside)) < 0.2
    faster = np.stack([disturbance("fan=9")(jnp.array(t), HERE).wind for t in np.arange(0.0, 20.0, 1.0)]).mean(axis=0)
    assert np.linalg.norm(faster) == pytest.approx(6.0, rel=0.15)
    disturbance("fan=0.1")
    with pytest.raises(ConfigError, match=r"disturbance 'fan=0': Fan: speed and width must be positive.*speed = 0\.0"):
        disturbance("fan=0")


def test_random_walk_has_stated_rate_and_bounds():
    after_a_second = np.stack([effects("walk", 1.0, seed=seed).push for seed in range(60)])
    np.testing.assert_allclose(after_a_second.std(), 0.5, rtol=0.25)
    late = np.stack([effects("walk=3", t).push for t in np.arange(0.0, 100.0, 0.5)])
    assert 0.8 < np.abs(late).max() <= 1.0


@pytest.mark.parametrize(
    ("name", "t", "mass"),
    [
        ("payload", 0.0, 0.07),
        ("payload=0.1", 50.0, 0.1),
        ("pickup", 7.9, 0.0),
        ("pickup", 8.1, 0.07),
        ("pickup=0.2", 19.9, 0.2),
        ("pickup", 20.1, 0.0),
    ],
)
def test_load_adds_mass(name, t, mass):
    assert float(effects(name, t).mass) == pytest.approx(mass)


@pytest.mark.parametrize(
    ("name", "t", "gain"), [("battery", 50.0, 0.9), ("battery=0.001", 50.0, 0.95), ("battery", 1000.0, 0.8)]
)
def test_battery_sag_reduces_thrust(name, t, gain):
    np.testing.assert_allclose(effects(name, t).gain, gain)


@pytest.mark.parametrize(("name", "gain"), [("weak-rotor", 0.9), ("weak-rotor=0.7", 0.7)])
def test_weak_rotor_is_first_rotor(name, gain):
    np.testing.assert_allclose(effects(name).gain, [gain, 1.0, 1.0, 1.0])


def test_sum_has_effects_of_both_disturbances():
    both = effects("push=2+wind=6")
    np.testing.assert_allclose(both.push, 2.0)
    assert float(jnp.linalg.norm(both.wind)) == pytest.approx(6.0)


def test_random_disturbances_follow_from_seed():
    for name in ("walk", "gusts", "fan"):
        same, again, other = effects(name, 2.0, 1), effects(name, 2.0, 1), effects(name, 2.0, 2)
        for field in ("push", "wind"):
            np.testing.assert_array_equal(getattr(same, field), getattr(again, field))
        assert not np.array_equal(same.push + same.wind, other.push + other.wind)
    twice = disturbance("walk+walk")(jnp.array(2.0), HERE).push  # each part has its own random numbers
    assert not np.allclose(twice, 2.0 * effects("walk", 2.0).push)


BOUNDS = {
    "push": (-10.0, 10.0),
    "push-x": (-10.0, 10.0),
    "step": (-10.0, 10.0),
    "early-step": (-10.0, 10.0),
    "kick": (0.0, 10.0),
    "reversing": (-10.0, 10.0),
    "walk": (0.0, 10.0),
    "wind": (0.0, 20.0),
    "gusts": (0.5, 20.0),
    "payload": (None, 20.0),
    "pickup": (None, 20.0),
    "off-centre": (-0.2, 0.2),
    "battery": (0.0, 0.1),
    "weak-rotor": (0.3, 1.0),
    "fan": (None, 20.0),
    "table-edge": (0.0, 0.5),
    "ceiling": (0.0, 1.0),
    "downwash": (0.3, 3.0),
    "slung-load": (0.02, 1.0),
    "slung-cable": (0.2, 3.0),
    "slung-pickup": (0.02, 1.0),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_sizes_have_bounds(name):
    low, high = BOUNDS[name]
    for fine in (low, high):
        if fine is not None:
            disturbance(f"{name}={fine}")
    for wrong in (high + 0.01, -99.0 if low is None else low - 0.01):
        with pytest.raises(ConfigError, match=f"disturbance '{name}={wrong}': a size of .* must be between"):
            disturbance(f"{name}={wrong}")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wind=fast", "disturbance 'wind=fast': 'fast' is not a number"),
        ("wind=", "'' is not a number"),
        ("wind=99", "a size of 99 m/s must be between 0 and 20"),
        ("wind=nan", "a size of nan m/s must be between"),
        ("payload=0", "disturbance 'payload=0': "),
        ("small=2", "this level is fixed; use push=SIZE"),
        ("none=2", "this level is fixed; use push=SIZE"),
        ("wind+", "no disturbance ''"),
        ("wind+weather", "no disturbance 'weather'"),
    ],
)
def test_invalid_sizes_are_refused(name, message):
    with pytest.raises(ConfigError, match=message) as error:
        disturbance(name)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("plant", ["bem", "simple", "rotorpy", "mujoco", "crazyflow"])
def test_every_plant_receives_control_period(plant):
    try:
        assert Scenario(plant=plant).make(dt=0.01).dt == 0.01
    except PlantError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("plant", ["rotorpy", "mujoco", "crazyflow", "betaflight"])
def test_plants_without_disturbance_state_refuse_slung_load(plant):
    for plain in ("payload", "none"):
        Scenario(plain, plant=plant)
    with pytest.raises(ConfigError, match=f"plant '{plant}' cannot carry a load on a cable; disturbance 'wind.slung"):
        Scenario("wind+slung-load", plant=plant)
    for able in ("bem", "simple", "second-order"):
        Scenario("wind+slung-load", plant=able)


@pytest.mark.parametrize("plant", ["bem", "simple"])
def test_plant_has_stated_delay(plant):
    assert Scenario(plant=plant, delay=0.035).make().simulation.delay == jnp.array(0.035)
    assert Scenario(plant=plant).make().simulation.delay == jnp.array(0.02)


@pytest.mark.parametrize(
    ("options", "dt", "text"),
    [
        ({"sensors": "rough"}, 0.025, "plant 'bem' with sensors 'rough' at dt = 0.025 s: .* of SensorModel"),
        ({"plant": "mujoco"}, 0.015, "plant 'mujoco' with sensors 'ideal' at dt = 0.015 s: .* the simulator's step"),
    ],
)
def test_indivisible_control_period_is_refused(options, dt, text):
    if "plant" in options:
        pytest.importorskip(options["plant"])
    with pytest.raises(ConfigError, match=text) as error:
        Scenario(**options).make(dt=dt)
    assert "\n" not in str(error.value)


def test_kick_reaches_its_speed_within_tenth_of_a_second():
    gain = sum(0.001 * effects("kick=4", 7.95 + 0.001 * ms).push for ms in range(300))
    np.testing.assert_allclose(gain, [4.0 / 2**0.5, 4.0 / 2**0.5, 0.0], rtol=0.02)


def test_bounds_cover_every_disturbance():
    assert set(DISTURBANCES) == set(BOUNDS) | {"none", "small", "large"}


# ---- sensors


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("mocap", (0.3e-3, 3e-3, 1e-3, 0.0, 0, 10, 0.01, 0.1)),
        ("onboard", (0.6e-3, 6e-3, 2e-3, 0.01, 10, 10, 0.02, 0.2)),
        ("rough", (1e-3, 10e-3, 3e-3, 0.05, 10, 10, 0.03, 0.3)),
    ],
)
def test_sensors_by_name(name, numbers):
    setup = SENSORS.find(name)()
    result = [float(getattr(setup, field.name)) for field in dataclasses.fields(setup)]
    np.testing.assert_allclose(result, numbers)
    assert make_sensors("ideal") is None


def test_thing_that_is_no_sensor_is_refused():
    with pytest.raises(ConfigError, match="sensors 'builtins:dict' is a dict, expected a"):
        make_sensors("builtins:dict")


# ---- the plant


def test_scenario_configures_plant():
    """Disturbance and sensors follow from the seed; the plant receives the vehicle and the control period."""

    def fly_once(seed, **options):
        plant = Scenario("walk", "simple", "large", "mocap", **options).make("small", dt=0.01, seed=seed)
        return fly(plant, FunctionPilot(lambda measurement: Command.hover()), HERE, ticks=20)

    one, again, other = fly_once(1), fly_once(1), fly_once(2)
    assert one.dt == 0.01
    np.testing.assert_array_equal(one.measured.p, again.measured.p)
    assert not np.array_equal(one.measured.p, other.measured.p)
    assert not np.array_equal(one.true.v, other.true.v)
    assert not np.array_equal(one.measured.p, one.true.p)


def test_vehicle_of_scenario_replaces_vehicle_of_training():
    for scenario, name, mass in (
        (Scenario(), "kingfisher", 0.752),
        (Scenario(vehicle="small"), "small", 0.19),
        (Scenario(plant="simple"), "kingfisher", 0.752),
    ):
        assert scenario.vehicle_name("kingfisher") == name
        assert float(scenario.make("kingfisher").simulation.model.vehicle.mass) == pytest.approx(mass)
    assert Scenario(plant="rotorpy").vehicle_name("small") == "hummingbird"
    assert Scenario(plant="crazyflow").vehicle_name("small") == "cf21B_500"


@pytest.mark.parametrize("plant", ["bem", "simple"])
@pytest.mark.parametrize(("error", "expected"), [(None, 0.035), (0.0, 0.0), (-0.1, -0.1)])
def test_plant_receives_thrust_map_error(plant, error, expected):
    """A hover command lifts the vehicle by this share of its weight; the default is 3.5 %."""
    scenario = Scenario(plant=plant) if error is None else Scenario(plant=plant, thrust_error=error)
    x0 = State.at(jnp.array([0.0, 0.0, 1.0]))
    log = fly(scenario.make(), FunctionPilot(lambda measurement: Command.hover()), x0, ticks=2)
    assert log.v[1, 2] / 0.02 == pytest.approx(9.81 * expected, abs=0.02 * 9.81 * abs(expected) + 0.01)


def test_invalid_scenarios_are_refused():
    for wrong, message in (
        ({"thrust_error": 1.2}, "thrust error 1.2 must be between"),
        ({"sensors": "mocap", "plant": "mujoco"}, "measures its true state"),
        ({"delay": -0.01}, "delay -0.01 s must be 0 to 0.2 s"),
        ({"delay": 0.3}, "delay 0.3 s must be 0 to 0.2 s"),
        ({"delay": 0.04, "plant": "mujoco"}, "plant 'mujoco' has its own command delay"),
        ({"thrust_error": 0.0, "plant": "mujoco"}, "plant 'mujoco' has its own thrust map"),
        ({"plant": "rotorpy", "vehicle": "large"}, "flies its own vehicle, hummingbird, not large"),
        ({"disturbance": "weather"}, "no disturbance 'weather'"),
        ({"plant": "outdoors"}, "no plant 'outdoors'"),
        ({"sensors": "eyes"}, "no sensor 'eyes'"),
        ({"vehicle": "bus"}, "no vehicle 'bus'"),
    ):
        with pytest.raises(ConfigError, match=message):
            Scenario(**wrong)
