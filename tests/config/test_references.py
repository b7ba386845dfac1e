"""References by name: files with suffixes, families, and invalid names."""

import math

import numpy as np
import pytest

from retrim.config.loading import changed, load
from retrim.config.pacing import is_paced, plain_name
from retrim.config.references import REFERENCES, make_reference
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.errors import ConfigError
from retrim.physics import large, small
from retrim.tasks import Reference
from retrim.tasks.shapes import circle


@pytest.fixture
def lap(tmp_path):
    """Return a closed trajectory file of one round."""
    file = tmp_path / "lap.csv"
    angles = np.linspace(0.0, 2.0 * math.pi, 101)
    file.write_text("\n".join(f"{a / 2.0},{math.sin(a)},{math.cos(a)},1" for a in angles))
    return file


def is_periodic(reference):
    return float(reference.lap[0]) < float(reference.lap[1])


def test_suffix_of_file_name_selects_repetition(lap):
    assert is_periodic(make_reference(str(lap)))
    assert is_periodic(make_reference(f"{lap}:laps"))
    assert not is_periodic(make_reference(f"{lap}:once"))


def test_open_file_is_not_a_lap(tmp_path):
    file = tmp_path / "Open.CSV"
    file.write_text("0,0,0,1\n2,1,0,1\n4,2,0,1\n6,3,0,1\n")
    assert not is_periodic(make_reference(str(file)))
    with pytest.raises(ConfigError, match=r"Open\.CSV: its last point is 3\.000 m from its first"):
        make_reference(f"{file}:laps")


def test_file_in_family(lap):
    family = make_reference(f"circle+{lap}:once")
    assert family.joins.shape == (2, 2)
    assert not is_periodic(family)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("{}:twice", "'twice' is not 'laps' or 'once'"),
        ("{}x.csv", r"x\.csv: No such file"),
        ("{}x.csv:once", r"x\.csv: No such file"),
        ("circel", "no reference 'circel'; .*circle.* or a CSV file"),
        ("math:cos", "reference math:cos: "),
        ("math:pi", "reference 'math:pi' is a float, not a function that returns a Reference"),
        ("builtins:dict", "is a dict, not a function that returns a Reference"),
    ],
)
def test_invalid_references_are_refused(name, message, lap):
    with pytest.raises(ConfigError, match=message):
        make_reference(name.format(lap))


def test_every_registered_name_builds_a_reference():
    for name in REFERENCES:
        assert isinstance(make_reference(name), Reference)


# ---- requirements of a flight


def test_flight_lasts_as_long_as_finite_reference(lap):
    """The last seconds are scored; a longer flight would be scored in hover."""
    preset = load("track/preview")
    assert Setup.from_preset(preset, str(lap)).flight_task.flight_seconds == 60.0
    assert Setup.from_preset(preset, f"{lap}:once").flight_task.flight_seconds == pytest.approx(math.pi, abs=1e-3)
    assert Setup.from_preset(preset, "circle").flight_task.flight_seconds == 60.0
    assert Setup.from_preset(preset).flight_task.flight_seconds == 60.0


def test_limits_are_those_of_flight_vehicle():
    """The circle needs rates that the large vehicle reaches (10 rad/s) and the small one from training (6 rad/s) does
    not.
    """
    preset = load("track/preview")
    hasty = circle(radius=3.0, period=1.4)
    assert hasty.infeasibility(small()) != hasty.infeasibility(large())
    setup = Setup.from_preset(preset, hasty)
    for vehicle in (None, "small", "large"):
        flies = Scenario(vehicle=vehicle).make_vehicle(preset.vehicle)
        assert setup.limits_exceeded(flies) == hasty.infeasibility({"large": large()}.get(vehicle, small()))
    assert setup.limits_exceeded() == hasty.infeasibility(small())
    assert Setup.from_preset("hover/fast").limits_exceeded() is None


@pytest.mark.parametrize("name", ["circle=max", "{}=max", "{}:once=max"])
def test_paced_reference_has_path_of_its_name(lap, name):
    name = name.format(lap)
    paced, plain = make_reference(name), make_reference(plain_name(name))
    np.testing.assert_array_equal(paced.rows, plain.rows)
    assert is_paced(name) and not is_paced(plain_name(name)) and not is_paced(f"{name}+circle=max")  # noqa: PT018


def test_paced_flight_trains_on_references_of_pretraining():
    setup = Setup.from_preset("track/paced", "star=max")
    assert setup.pace is not None
    assert setup.learner.env.task.reference is setup.env.task.reference
    assert setup.env.task.reference.joins.shape[0] == 24  # 3 references, 2 tables of each, with 3 copies of each table
    assert Setup.from_preset("track/paced", "star").pace is None
    assert Setup.from_preset("track/paced").pace is None  # a family
    single = changed(load("track/paced"), track={"reference": "star=max", "gravity_copies": 0})
    assert Setup.from_preset(single).pace is not None


def test_unknown_paced_reference_is_refused():
    with pytest.raises(ConfigError, match="no reference 'circel'"):
        make_reference("circel=max")
