"""The conditions of the gauntlet have the content that their names state."""

from dataclasses import replace

import numpy as np
import pytest

from retrim.config import PRESETS, changed
from retrim.config.faults import FAULTS, NO_FAULT
from retrim.config.scenario import THRUST_ERROR, Scenario
from retrim.physics.vehicle import kingfisher, small
from retrim_paper.conditions import PUSH, WEATHERS, conditions, fault_conditions

AGREE = ("disturbance", "plant", "sensors", "reference", "thrust_error", "delay")


def numbers(vehicle):
    """Return the numbers that characterise a vehicle, built or from a file."""
    names = ("mass", "inertia", "arm", "thrust_max", "motor_tau", "drag_area")
    return {name: np.asarray(getattr(vehicle, name), dtype=float) for name in names}


def ratios(spec, like):
    mine, theirs = numbers(spec), numbers(like)
    return {name: mine[name] / theirs[name] for name in mine}


def test_hover_condition_is_disturbance_with_one_change():
    result = conditions(PRESETS["hover/retrim"])
    for name, scenario in result.items():
        what, _, where = name.partition("/")
        if what.startswith("thrust"):
            what, where = "step", what
        disturbance = "wind+payload+battery+weak-rotor" if what == "all" else what
        differs = {
            "": {}, "mocap": {"sensors": "mocap"}, "onboard": {"sensors": "onboard"}, "rough": {"sensors": "rough"},
            "thrust+20": {"thrust_error": 0.2}, "thrust-20": {"thrust_error": -0.2}, "delay-40ms": {"delay": 0.04},
            "simple": {"plant": "simple"}, "rotorpy": {"plant": "rotorpy"}, "mujoco": {"plant": "mujoco"},
            "crazyflow": {"plant": "crazyflow"},
        }.get(where, {})  # fmt: skip
        plain = {"plant": "bem", "sensors": "ideal", "reference": None, "thrust_error": THRUST_ERROR, "delay": 0.02}
        assert {field: getattr(scenario, field) for field in AGREE} == plain | {"disturbance": disturbance} | differs
        if where in ("kingfisher", "large-quadrotor"):
            assert scenario.vehicle == where.removesuffix("-quadrotor")
        else:
            assert (scenario.vehicle is not None) == where.startswith(("random", "slow"))
    slow = ratios(result["step/slow-motors"].vehicle, small())
    assert {name: np.unique(np.round(ratio, 6)).tolist() for name, ratio in slow.items()} == {
        name: [2.0 if name == "motor_tau" else 1.0] for name in slow
    }


def test_fault_condition_is_push_with_one_fault():
    result = fault_conditions(PRESETS["hover/retrim"])
    assert set(FAULTS) - {NO_FAULT} <= set(result)
    for name, scenario in result.items():
        differs = {field for field in (*AGREE, "fault") if getattr(scenario, field) != getattr(Scenario(PUSH), field)}
        assert len(differs) == 1, name
        if "fault" in differs:
            assert scenario.fault == name
    heavier = result["mass+50"].disturbance.removeprefix(f"{PUSH}+payload=")
    assert float(heavier) == pytest.approx(0.5 * float(small().mass), rel=1e-3)
    assert (result["delay-60ms"].delay, result["thrust-50"].thrust_error) == (0.06, -0.5)


@pytest.mark.parametrize("preset", ["hover/retrim", "track/retrim"])
def test_sensor_option_replaces_default_sensors_only(preset):
    ideal, rough = conditions(PRESETS[preset]), conditions(PRESETS[preset], "rough")
    assert {scenario.sensors for scenario in rough.values()} == {"rough"}
    for name, scenario in ideal.items():
        if name in rough:
            assert scenario == replace(rough[name], sensors="ideal")
        else:
            assert scenario.sensors != "ideal" or not scenario.entry.has_sensors


@pytest.mark.parametrize(("preset", "own"), [("track/retrim", small), ("track/fast", kingfisher)])
def test_references_are_flown_in_every_wind_and_first_one_on_other_vehicles(preset, own):
    base = PRESETS[preset]
    references = base.track.reference.split("+")
    result = conditions(base)
    assert {scenario.reference for scenario in result.values()} == set(references)
    for name, scenario in result.items():
        reference, _, what = name.rpartition("/")
        assert scenario.reference == reference
        if what in WEATHERS:
            assert (scenario.disturbance, scenario.sensors, scenario.vehicle) == (*WEATHERS[what], None)
        else:
            assert reference == references[0]
    of_first = {name.removeprefix(f"{references[0]}/"): scenario for name, scenario in result.items()}
    assert of_first["thrust+20"].thrust_error == 0.2
    assert of_first["thrust-20"].thrust_error == -0.2
    assert of_first["delay-40ms"].delay == 0.04
    assert (of_first["simple"].plant, of_first["simple"].disturbance) == ("simple", "wind")
    slow = ratios(of_first["slow-motors"].vehicle, own())
    assert float(slow.pop("motor_tau")) == pytest.approx(2.0)
    for ratio in slow.values():
        np.testing.assert_allclose(ratio, 1.0)


def test_conditions_of_custom_vehicle_are_similar_vehicles():
    heavy = changed(PRESETS["track/retrim"], vehicle="large")
    slow = next(s.vehicle for name, s in conditions(heavy).items() if name.endswith("/slow-motors"))
    assert slow.mass == pytest.approx(0.6, rel=0.05)


def test_random_vehicles_are_plausible_and_differ():
    """Mass varies from 0.7 to 1.6, inertia with the mass, and thrust and motors within factors of 1.33 and 2."""
    result = [conditions(PRESETS["hover/retrim"])[f"step/random-{n}"].vehicle for n in range(3)]
    message = [ratios(spec, small()) for spec in result]
    for of in message:
        assert 0.7 <= of["mass"] <= 1.6
        np.testing.assert_allclose(of["inertia"], of["inertia"][0])
        assert 0.8 <= of["inertia"][0] / of["mass"] <= 1.25
        assert 0.8 <= of["thrust_max"] <= 1.2
        assert 0.7 <= of["motor_tau"] <= 2.0
        np.testing.assert_allclose(of["arm"], 1.0)
        np.testing.assert_allclose(of["drag_area"], 1.0)
    assert [spec.name for spec in result] == ["random-0", "random-1", "random-2"]
    assert len({round(float(of["mass"]), 6) for of in message}) == 3
    assert all(spec.rates_max == tuple(np.asarray(small().omega_max).tolist()) for spec in result)
