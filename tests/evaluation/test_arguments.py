"""Command-line arguments determine the preset and the scenario, and inconsistent ones are refused."""

import dataclasses
import threading
from pathlib import Path

import pytest

from helpers import brief_preset
from retrim import ConfigError, Setup, changed, load
from retrim.cli.arguments import (
    FlightArguments,
    load_inputs,
    reference_of_flight,
    training_preset,
    with_residual,
)
from retrim.cli.fly import fly
from retrim.config.registry import describe_user_error
from retrim.config.trained_values import same_policy
from retrim.io.policies import load_policy, save_policy

SEVEN_INCH = Path(__file__).parents[2] / "examples" / "extensions" / "vehicle.toml"


def test_preset_is_that_of_task_with_overrides(tmp_path):
    assert training_preset("hover") == load("hover/retrim")
    assert training_preset("hover", "hover/fast") == load("hover/fast")
    overlay = tmp_path / "a.toml"
    overlay.write_text("delay_ticks = 2\n[pretrain]\nnum_updates = 7\nnum_envs = 3\n[adapt]\nnum_updates = 9\n")
    result = training_preset("hover", config=overlay, num_updates=5, num_envs=None, residual="zero", vehicle="large")
    assert (result.delay_ticks, result.pretrain.num_updates, result.pretrain.num_envs) == (2, 5, 3)
    assert (result.adapt.num_updates, result.adapt.residual, result.vehicle) == (9, "zero", "large")
    track_preset = training_preset("track", reference="circle")
    assert track_preset == changed(load("track/retrim"), track={"reference": "circle"})
    assert training_preset("hover", vehicle=str(SEVEN_INCH)).vehicle.mass == pytest.approx(1.2)
    with pytest.raises(ConfigError, match="--reference circle: a hover policy follows no reference"):
        training_preset("hover", reference="circle")
    with pytest.raises(ConfigError, match="'track/paper' is for track"):
        training_preset("hover", "track/paper")


def test_reference_must_suit_policy():
    family, blind = load("track/preview"), changed(load("track/blind"), track={"reference": "circle"})
    one = changed(family, track={"reference": "star"})
    assert reference_of_flight(load("hover/fast"), None) is None
    assert [reference_of_flight(one, name) for name in (None, "star", "figure8")] == ["star", "star", "figure8"]
    assert [reference_of_flight(blind, name) for name in (None, "circle")] == ["circle", "circle"]
    assert reference_of_flight(family, "circle") == "circle"
    for preset, name, text in (
        (load("hover/fast"), "circle", "a hover policy follows no reference"),
        (family, None, "choose one, as in"),
        (blind, "star", "does not observe its reference, and was trained on circle"),
    ):
        with pytest.raises(ConfigError, match=text):
            reference_of_flight(preset, name)


def test_flight_cannot_change_training_settings():
    original = load("track/retrim")
    free = changed(original, adapt={"num_updates": 3}, delay_ticks=0)
    assert same_policy(original, free, Path("a.toml")) is free
    for changes, text in (
        ({"vehicle": "large"}, "vehicle = 'large', but the policy was trained with 'small'"),
        ({"dt": 0.01}, "dt = 0.01, but the policy was trained with 0.02"),
        ({"command_history": 1}, "command_history = 1, but the policy was trained with 2"),
        ({"pretrain": {"num_updates": 3}}, r"\[pretrain\] cannot change for a policy that is trained"),
        ({"track": {"observation": "both"}}, "track.observation = 'both', but the policy was trained with 'flat'"),
    ):
        with pytest.raises(ConfigError, match=rf"a\.toml: {text}"):
            same_policy(original, dataclasses.replace(original, **_whole(original, changes)), Path("a.toml"))


def test_flight_may_excite_vehicle_but_not_change_its_family():
    original = load("hover/any")
    excitation = changed(original, family={"excitation": True})
    assert same_policy(original, excitation, Path("a.toml")) is excitation
    for other, text in (
        (changed(original, family={"delay": (0.0, 0.05)}), "family = "),
        (
            dataclasses.replace(original, axes="world"),
            "axes = 'world', but the policy was trained with 'heading'",
        ),
    ):
        with pytest.raises(ConfigError, match=rf"a\.toml: {text}"):
            same_policy(original, other, Path("a.toml"))


@pytest.mark.parametrize(
    ("name", "changes", "text"),
    [
        ("track/blind", {"track": {"reference": "figure8"}}, "track.reference = 'figure8', .* with 'circle"),
        ("track/blind", {"goal": (0.0, 0.0, 2.0)}, r"goal = \(0.0, 0.0, 2.0\), .* with \(0.0, 0.0, 1.0\)"),
        ("track/paper", {"track": {"observation": "blind"}}, "track.observation = 'blind'"),
        ("vision/paper", {"vision": {"whiten_pixels": True}}, "vision.whiten_pixels = True, .* with False"),
        ("vision/paper", {"vision": {"encoder_steps": 7}}, "vision.encoder_steps = 7, .* with 10000"),
        ("vision/paper", {"vision": {"encoder_motions": "near"}}, "vision.encoder_motions = 'near', .* with 'wild'"),
        ("vision/paper", {"goal": (0.0, 0.0, 2.0)}, "goal = "),
    ],
)
def test_flight_cannot_change_what_policy_observes(name, changes, text):
    """Values that the policy cannot observe, or that change its observation, are those of its training."""
    original, task = load(name), {"task": changes["task"]} if "task" in changes else {}
    with pytest.raises(ConfigError, match=rf"^a\.toml: {text}"):
        same_policy(changed(original, **task), changed(original, **changes), Path("a.toml"))


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("track/retrim", {"track": {"reference": "star"}, "goal": (0.0, 0.0, 2.0)}),
        ("track/blind", {"reward": "l2"}),
        ("vision/paper", {"vision": {"occlusion": True, "pixel_noise": 0.5}, "reward": "view"}),
        ("hover/fast", {"goal": (0.0, 0.0, 2.0), "reward": "paper"}),
    ],
)
def test_flight_can_change_its_conditions_and_its_learning(name, changes):
    original = load(name)
    other = changed(original, **changes)
    assert same_policy(original, other, Path("a.toml")) is other


def _whole(preset, changes):
    return {
        name: dataclasses.replace(getattr(preset, name), **value) if isinstance(value, dict) else value
        for name, value in changes.items()
    }


def test_zero_and_empty_text_are_not_defaults():
    """An option is a default only if it is not given; 0 and an empty text are values, and refused."""
    preset = changed(load("track/retrim"), track={"reference": "circle"})
    with pytest.raises(ConfigError, match=r"^no disturbance ''"):
        FlightArguments(disturbance="").scenario(preset)
    with pytest.raises(ConfigError, match="reference ''"):
        Setup.from_preset(preset, reference_of_flight(preset, ""))
    with pytest.raises(ConfigError, match=r"^no preset ''"):
        training_preset("hover", "")
    vehicle = FlightArguments(plant="mavlink:udp:127.0.0.1:14540")
    with pytest.raises(ConfigError, match=r"^--seconds 0 must be between 1 and"):
        fly(Path("h"), flight=vehicle, seconds=0.0)(threading.Event())


def test_residual_can_change_except_in_resumed_flight(key):
    preset = load("hover/fast")
    assert with_residual(preset, None, None) is preset
    assert with_residual(preset, "regression", None).adapt.residual == "regression"
    setup = Setup.from_preset(brief_preset())
    state = setup.learner.init(setup.new_policy(key), key)
    assert with_residual(preset, None, state) is preset
    with pytest.raises(ConfigError, match="keeps its own residual"):
        with_residual(preset, "regression", state)


def test_flight_arguments_build_scenario():
    preset = load("track/preview")
    result = FlightArguments("wind=3", "simple", "figure8", "large", "mocap", 0.01, 0.04).scenario(preset)
    assert (result.disturbance, result.plant, result.reference) == ("wind=3", "simple", "figure8")
    assert (result.vehicle, result.sensors, result.thrust_error, result.delay) == ("large", "mocap", 0.01, 0.04)
    assert FlightArguments().scenario(load("hover/fast")).disturbance == "large"
    assert FlightArguments(plant="mavlink:udp:127.0.0.1:14550").scenario(load("hover/fast")).disturbance == "none"


def test_weights_come_from_policy_or_earlier_flight(tmp_path, key):
    preset = brief_preset()
    save_policy(tmp_path / "policy.safetensors", Setup.from_preset(preset).new_policy(key), preset)
    weights, result, state = load_inputs(tmp_path, None)
    assert (result, state) == (preset, None)
    assert weights.layers[0].weight.shape == load_policy(tmp_path)[0].layers[0].weight.shape
    with pytest.raises(ConfigError, match="give either --policy FILE or --resume FILE"):
        load_inputs(None, None)
    with pytest.raises(ConfigError, match="give either --policy FILE or --resume FILE"):
        load_inputs(tmp_path, tmp_path)
    with pytest.raises(ConfigError, match="--resume contains its own"):
        load_inputs(None, tmp_path, tmp_path)


def test_error_in_custom_module_is_reported_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_that_fails.py").write_text("def wind():\n    return 1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ZeroDivisionError) as error:
        __import__("mine_that_fails").wind()
    text = describe_user_error(error.value, ["retrim", "fly"])
    assert text.startswith(f"{tmp_path / 'mine_that_fails.py'}, line 2: ZeroDivisionError: division by zero")
    with pytest.raises(KeyError) as ours:
        {}["x"]
    assert describe_user_error(ours.value, ["retrim", "fly", "--starts", "1"]) is None
    assert "KeyError: 'x'" in describe_user_error(ours.value, ["retrim", "fly", "--disturbance", "mine:wind"])
