"""A large quadrotor with slow motors, described by seven lines, hovers in wind with a load; others are refused."""

import dataclasses

import jax
import numpy as np
import pytest
from jax import random

from retrim import ConfigError
from retrim.config import PRESETS, Scenario, Setup, changed, read_vehicle, register_vehicle
from retrim.config.baselines import baseline_request, slowness
from retrim.config.command_paths import lag_of
from retrim.config.vehicles import PUBLISHED, make_vehicle
from retrim.control.baselines import BASELINES
from retrim.physics.step_response import step_responses
from retrim.runtime import fly

SEVEN_LINES = """
mass = 4.0
inertia = [0.08, 0.08, 0.14]
arm = [0.23, 0.23]
thrust_max = 80.0
rates_max = [4.0, 4.0, 2.0]
motor_tau = 0.1
propeller_diameter = 15.0
"""


@pytest.fixture
def spec(tmp_path):
    (tmp_path / "four.toml").write_text(SEVEN_LINES)
    return read_vehicle(tmp_path / "four.toml")


def test_large_quadrotor_hovers_in_wind_with_load(spec):
    preset = changed(
        PRESETS["hover/retrim"], vehicle=spec, pretrain={"num_updates": 300, "num_envs": 16, "hidden_sizes": (64, 64)}
    )
    setup = Setup.from_preset(preset)
    with jax.numpy_dtype_promotion("standard"):  # optax's schedule divides integers
        policy = setup.pretrained()
    pilot = setup.pilot(policy, "base-do", random.key(0))
    plant = Scenario("wind=5+payload=0.8").make(spec)
    log = fly(plant, pilot, setup.flight_starts(1)[0], ticks=400)
    off = np.linalg.norm(log.p - np.array([0.0, 0.0, 1.0]), axis=1)
    assert off[-50:].max() < 0.1  # four times as close as the plain policy; full training gives 4 mm
    change = np.linalg.norm(np.diff(log.v[-50:], axis=0), axis=1) / 0.02
    assert change.max() < 0.5  # no oscillation


def test_training_model_has_lag_of_vehicle(spec):
    preset = PRESETS["hover/retrim"]
    for name in PUBLISHED:
        assert lag_of(changed(preset, vehicle=name), make_vehicle(name)) is None
    vehicle = make_vehicle(spec)
    lag = lag_of(changed(preset, vehicle=spec), vehicle)
    assert float(lag.c) == pytest.approx(0.1)
    np.testing.assert_allclose(lag.omega, [about.rise for about in step_responses(vehicle)])
    fast = dataclasses.replace(spec, motor_tau=0.03)
    quick = lag_of(changed(preset, vehicle=fast), make_vehicle(fast))
    assert float(quick.c) == pytest.approx(0.03)
    assert np.all(np.asarray(quick.omega) < 0.5 * np.asarray(lag.omega) + 0.05)
    measurement = dataclasses.replace(spec, rate_lag=(0.05, 0.06, 0.2))
    text = lag_of(changed(preset, vehicle=measurement), make_vehicle(measurement))
    np.testing.assert_allclose(text.omega, [0.05, 0.06, 0.2])


def test_gains_of_baselines_scale_with_vehicle_lag(spec):
    """If the lag is n times as long, gains in 1/s, 1/s^2 and 1/s^3 decrease by n, n^2 and n^3."""
    for name in ("hover/retrim", "hover/fast", "track/retrim", "track/fast"):
        assert slowness(Setup.from_preset(PRESETS[name])) == 1.0
    usual, slow = (Setup.from_preset(changed(PRESETS["hover/retrim"], vehicle=vehicle)) for vehicle in ("small", spec))
    n = slowness(slow)
    assert n == pytest.approx((0.02 + step_responses(slow.vehicle)[0].rise) / 0.053)
    for method in ("geometric-i", "indi"):
        one, other = (BASELINES[method].controller(baseline_request(setup)).gains for setup in (usual, slow))
        assert float(one.position) == pytest.approx(BASELINES[method].settings["position"])
        for part, power in (("position", 2), ("velocity", 1), ("attitude", 1), ("integral", 3)):
            assert float(getattr(one, part)) == pytest.approx(n**power * float(getattr(other, part)))


def test_unflyable_vehicle_is_refused_with_step_response(tmp_path):
    slow = dataclasses.replace(parse_vehicle(SEVEN_LINES, tmp_path), motor_tau=0.45)
    (tmp_path / "slow.toml").write_text(SEVEN_LINES.replace("motor_tau = 0.1", "motor_tau = 0.45"))
    register_vehicle("slow-one", slow.build)
    for use in (
        lambda: read_vehicle(tmp_path / "slow.toml"),
        lambda: make_vehicle(slow),
        lambda: make_vehicle("slow-one"),
        lambda: Setup.from_preset(changed(PRESETS["hover/fast"], vehicle=slow)),
        lambda: Scenario().make(slow),
    ):
        with pytest.raises(
            ConfigError, match=r"roll rate .* 1 rad/s overshoots by \d+% and reaches 63 % after"
        ) as error:
            use()
        assert "\n" not in str(error.value)
        assert "motor_tau = 0.45 s" in str(error.value)


def parse_vehicle(text, folder):
    (folder / "read.toml").write_text(text)
    return read_vehicle(folder / "read.toml")
