"""Presets: their numbers, and invalid combinations."""

import math

import pytest

from retrim import ConfigError
from retrim.config import PRESETS, Setup, changed, load
from retrim.config.loading import dump, parse
from retrim.config.presets import Preset


def test_presets_survive_json():
    for name, preset in PRESETS.items():
        assert preset.name == name
        assert parse(dump(preset), source="test") == preset


def test_numbers_of_paper():
    paper = load("hover/paper")
    p, a = paper.pretrain, paper.adapt
    assert (p.num_updates, p.num_envs, p.horizon, p.hidden_sizes) == (300, 100, 150, (512, 512))
    assert (a.window, a.fit_every, a.fit_steps, a.update_every, a.num_updates, a.num_envs) == (
        100,
        3.0,
        100,
        5.0,
        30,
        10,
    )
    assert (paper.command_history, paper.delay_ticks, paper.dt) == (0, 0, 0.02)
    assert Setup.from_preset(paper).env.task.observation.size == 15
    assert Setup.from_preset("hover/released").env.task.observation.size == 27
    assert load("track/paper").adapt.window == load("track/preview").adapt.window == 250
    vision = load("vision/paper")
    assert (vision.pretrain.num_updates, vision.pretrain.num_envs) == (500, 300)
    assert (vision.adapt.num_updates, vision.adapt.num_envs) == (50, 30)


def test_100_hz_preset_has_same_times():
    fast, fine = load("hover/fast"), load("hover/100hz")
    for ticks in (
        lambda p: p.pretrain.horizon,
        lambda p: p.adapt.window,
        lambda p: p.delay_ticks,
        lambda p: p.plant_delay_ticks,
        lambda p: p.command_history,
    ):
        assert ticks(fine) * fine.dt == pytest.approx(ticks(fast) * fast.dt)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"track": {"reference": "circle"}}, r"a table \[track\] needs task = 'track', not 'hover'"),
        ({"vision": {}}, r"a table \[vision\] needs task = 'vision', not 'hover'"),
        ({"options": {"a": 1}}, r"a table \[options\] is for a custom task, not for 'hover'"),
        ({"dt": 0.0205}, r"dt = 0\.0205 s must be a whole number of milliseconds"),
        ({"dt": 0.001}, r"dt: Input should be greater than or equal to 0\.002"),
        ({"plant_delay_ticks": 5, "adapt": {"window": 14}}, r"adapt\.window = 14 is too short for plant_delay_ticks"),
        ({"pretrain": {"hidden_sizes": []}}, r"pretrain\.hidden_sizes: "),
        ({"pretrain": {"max_grad_norm": 0.0}}, r"pretrain\.max_grad_norm: Input should be greater than 0"),
        ({"actuator_tau": -0.1}, r"actuator_tau: Input should be greater than 0"),
        (
            {"adapt": {"task_starts": 50, "num_envs": 10}},
            r"adapt\.task_starts must be at most adapt\.num_envs = 10, got",
        ),
        ({"reward": "sharp"}, r"reward = 'sharp' is for task = 'track', not for 'hover'"),
        ({"reward": "view"}, r"reward = 'view' is for task = 'vision', not for 'hover'"),
        ({"reward": "l3"}, r"reward: Input should be 'paper', 'l2', 'stiff', 'sharp', 'exact' or 'view'"),
    ],
)
def test_inconsistent_settings_are_refused(tables, message):
    with pytest.raises(ConfigError, match=message) as error:
        changed(load("hover/fast"), **tables)
    assert "\n" not in str(error.value)


def test_all_mistakes_are_reported():
    with pytest.raises(
        ConfigError, match=r"adapt\.window: .*; pretrain\.num_envs: |pretrain\.num_envs: .*; adapt\.window: "
    ):
        changed(load("hover/fast"), adapt={"window": 1}, pretrain={"num_envs": 0})


DEFAULTS = {
    "pretrain": (300, 100, 150, 5e-3, 0.999, None, (512, 512), "mlp", math.pi),
    "adapt": (
        *(
            100,
            "ensemble",
            0.5,
            0.05,
            3.0,
            100,
            1e-2,
            1e-3,
            5.0,
            30,
            10,
            1e-3,
            None,
            None,
            "bptt",
            "fresh",
            None,
            0.1,
            "world",
        ),
        *("free", False, 0.2, 1.0),
    ),
    "rest": ("small", 0.02, (0.0, 0.0, 1.0), 5.0, 0, 0, 1, None),
}
OURS = {
    "hover/paper": {"adapt": {"learning_rate": 5e-4, "low_rank_learning_rate": 1e-3}},
    "hover/retrim": {
        "jump_cost": 0.1,
        "reward": "l2",
        "command_history": 2,
        "delay_ticks": 1,
        "pretrain": {
            "num_updates": 300,
            "num_envs": 16,
            "learning_rate": 3e-3,
            "adam_b2": 0.95,
            "max_grad_norm": 1.0,
            "hidden_sizes": (128, 128),
            "max_start_yaw": 0.1 * math.pi,
        },
        "adapt": {
            "residual": "regression",
            "fit_every": 0.2,
            "update_every": 0.5,
            "num_updates": 5,
            "learning_rate": 1e-4,
            "low_rank_learning_rate": 3e-4,
            "max_grad_norm": 1.0,
            "optimiser": "carried",
            "task_starts": 2,
            "frame": "gravity",
            "trim": "rest",
            "fit_latency": 0.02,
            "update_latency": 0.1,
        },
    },
    "hover/fast": {
        "command_history": 2,
        "delay_ticks": 1,
        "pretrain": {
            "num_updates": 150,
            "num_envs": 16,
            "adam_b2": 0.95,
            "max_grad_norm": 1.0,
            "max_start_yaw": 0.1 * math.pi,
        },
        "adapt": {"max_grad_norm": 1.0},
    },
    "hover/released": {
        "command_history": 3,
        "delay_ticks": 2,
        "pretrain": {"num_updates": 200, "num_envs": 200},
    },
    "track/preview": {
        "task": "track",
        "reward": "l2",
        "command_history": 2,
        "delay_ticks": 1,
        "actuator_tau": 0.033,
        "track": {"reference": "circle+figure8+star", "observation": "preview", "start_spread": 1.0},
        "pretrain": {"num_updates": 600, "num_envs": 32, "horizon": 100, "learning_rate": 3e-3, "max_grad_norm": 1.0},
        "adapt": {"window": 250, "max_grad_norm": 1.0},
    },
    "track/paper": {
        "task": "track",
        "track": {"reference": "circle", "observation": "both", "start_spread": 0.1},
        "adapt": {"window": 250, "low_rank_learning_rate": 3e-3},
    },
    "track/blind": {
        "task": "track",
        "track": {"reference": "circle", "observation": "blind", "start_spread": 0.1},
        "adapt": {"window": 250, "low_rank_learning_rate": 3e-3},
    },
    "vision/paper": {
        "task": "vision",
        "delay_ticks": 1,
        "vision": {"occlusion": False, "pixel_noise": 0.0, "dropout": 0.0, "whiten_pixels": False}
        | {"encoder_steps": 10000, "encoder_motions": "wild"},
        "pretrain": {"num_updates": 500, "num_envs": 300, "learning_rate": 1e-3, "max_start_yaw": 0.1 * math.pi},
        "adapt": {"num_updates": 50, "num_envs": 30, "update_latency": 5.0},
    },
    "vision/ideal": {
        "task": "vision",
        "reward": "l2",
        "delay_ticks": 1,
        "vision": {"occlusion": False, "pixel_noise": 0.5, "dropout": 0.0, "whiten_pixels": True}
        | {"encoder_steps": 3000, "encoder_motions": "near"},
        "pretrain": {
            "num_updates": 300,
            "num_envs": 16,
            "learning_rate": 3e-3,
            "adam_b2": 0.95,
            "max_grad_norm": 1.0,
            "hidden_sizes": (256, 256),
            "max_start_yaw": 0.1 * math.pi,
        },
        "adapt": {"max_grad_norm": 1.0},
    },
}
OURS["track/retrim"] = OURS["track/preview"] | {
    "reward": "sharp",
    "jump_cost": 0.1,
    "track": {"reference": "circle+figure8+star", "observation": "flat", "gravity_copies": 7, "gravity_push": 4.0},
    "pretrain": OURS["track/preview"]["pretrain"]
    | {"num_updates": 1200, "learning_rate": 5e-3, "adam_b2": 0.95, "hidden_sizes": (128, 128)},
    "adapt": OURS["hover/retrim"]["adapt"]
    | {"window": 150, "residual": "layered", "fit_steps": 10, "memory": 2.0, "thrust_prior": 0.2, "trim": "free"},
}
OURS["track/fast"] = OURS["track/retrim"] | {
    "vehicle": "kingfisher",
    "track": OURS["track/retrim"]["track"] | {"reference": "circle=8+figure8=8+circle=4+figure8=4+star=1.5"},
}
OURS["track/paced"] = OURS["track/retrim"] | {
    "jump_cost": 0.01,
    "adapt": OURS["track/retrim"]["adapt"] | {"lap_learning": True},
    "track": OURS["track/retrim"]["track"] | {"reference": "circle=max+figure8=max+star=max", "gravity_copies": 3},
}
OURS["hover/any"] = OURS["hover/retrim"] | {
    "reward": "stiff",
    "axes": "heading",
    "command_history": 6,
    "jump_cost": 0.05,
    "family": {
        "delay": (0.0, 0.1), "rate_lag": (0.01, 0.25), "least_damping": 0.4, "thrust_lag": (0.01, 0.15),
        "least_frequency": 4.0, "excitation": False,
    },
    "pretrain": OURS["hover/retrim"]["pretrain"]
    | {"num_updates": 1000, "num_envs": 64, "learning_rate": 5e-3, "hidden_sizes": (256, 256)},
    "adapt": OURS["hover/retrim"]["adapt"] | {"window": 150, "trim": "free"},
}  # fmt: skip
OURS["track/any"] = OURS["track/retrim"] | {
    "command_history": 6,
    "jump_cost": 0.05,
    "family": OURS["hover/any"]["family"],
    "pretrain": OURS["track/retrim"]["pretrain"] | {"num_updates": 1500, "num_envs": 64, "hidden_sizes": (256, 256)},
}
OURS["vision/occluded"] = OURS["vision/ideal"] | {
    "vision": {"occlusion": True, "pixel_noise": 1.0, "dropout": 0.05, "whiten_pixels": True}
    | {"encoder_steps": 3000, "encoder_motions": "near"}
}
OURS["vision/retrim"] = OURS["vision/occluded"] | {
    "reward": "view",
    "actuator_tau": 0.033,
    "adapt": OURS["hover/retrim"]["adapt"] | {"trim": "free"},
}
OURS["hover/100hz"] = OURS["hover/fast"] | {
    "dt": 0.01,
    "command_history": 4,
    "delay_ticks": 2,
    "plant_delay_ticks": 2,
    "pretrain": OURS["hover/fast"]["pretrain"] | {"horizon": 300},
    "adapt": {"max_grad_norm": 1.0, "window": 200},
}


def test_defaults_are_those_of_paper():
    paper = Preset()
    assert tuple(vars(paper.pretrain).values()) == DEFAULTS["pretrain"]
    assert tuple(vars(paper.adapt).values()) == DEFAULTS["adapt"]
    names = ("vehicle", "dt", "goal", "termination_box", "command_history", "delay_ticks", "plant_delay_ticks")
    assert tuple(getattr(paper, name) for name in (*names, "actuator_tau")) == DEFAULTS["rest"]


def test_presets_of_published_results_are_unchanged():
    """The differences between each preset and the paper are listed again, since published results depend on them."""
    assert set(OURS) == set(PRESETS)
    for name, tables in OURS.items():
        assert PRESETS[name] == changed(Preset(), name=name, **tables), name
