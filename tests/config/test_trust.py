"""The trust boundary: Python names in files remain data until the user also names them."""

import os
import sys

import pytest
from jax import random

from helpers import tiny_preset
from retrim import CheckpointError, ConfigError, Setup, load_learner_state, load_policy, save_learner_state, save_policy
from retrim.config import changed, load, overlaid
from retrim.config.disturbances import DISTURBANCES
from retrim.config.faults import FAULTS
from retrim.config.methods import METHODS
from retrim.config.networks import NETWORKS
from retrim.config.plants import PLANTS
from retrim.config.residuals import RESIDUALS
from retrim.config.sensors import SENSORS
from retrim.config.tasks import TASKS
from retrim.config.trust import check_trust, python_names
from retrim.config.vehicles import VEHICLES
from retrim.evaluation.sweep import read_sweep
from retrim.io.logs import read_map


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Return a module of the current folder that creates a file when it is imported."""
    name = f"mine_{os.getpid()}_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(
        f"from pathlib import Path\nPath({str(tmp_path / 'mark')!r}).touch()\n"
        "from retrim.config.tasks import find_task\nfrom retrim.physics import small\n"
        "task, vehicle = find_task('hover'), small\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    yield name
    sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ("circle+star", ()),
        ("my.csv:once+circle=8", ()),
        ("a:b+c:d=3", ("a:b", "c:d")),
        ("my.csv:os:abort", ("my.csv:os:abort",)),
        ("my.csv:twice", ("my.csv:twice",)),
        ({"track": {"reference": "a:b"}, "options": {"url": "http://x"}}, ("a:b",)),
        ([("a:b",), {"x": ["c:d"]}], ("a:b", "c:d")),
        ({"references": ["my.csv:once"], "track": {"reference": "my.CSV:laps"}}, ()),
        ({"methods": ["my.csv:once"], "adapt": {"residual": "my.CSV:laps"}}, ("my.csv:once", "my.CSV:laps")),
    ],
)
def test_name_with_colon_is_python_unless_it_is_a_file_suffix(values, names):
    assert python_names(values) == names


def test_names_of_preset_are_its_imports():
    preset = changed(load("track/retrim"), vehicle="a:b", adapt={"residual": "c:d"}, track={"reference": "circle+e:f"})
    assert set(python_names(preset)) == {"a:b", "c:d", "e:f"}
    assert python_names(changed(load("hover/retrim"), task="g:h", options={"i": "j:k"})) == ("g:h",)


def test_names_of_preset_include_files_that_are_no_reference():
    preset = changed(load("track/retrim"), vehicle="a.csv:once", adapt={"learner": "b.csv:laps"})
    assert set(python_names(changed(preset, track={"reference": "c.csv:laps"}))) == {"a.csv:once", "b.csv:laps"}


def test_refusal_is_one_line_with_remedy():
    with pytest.raises(ConfigError, match=r"^f: names Python code, 'os:abort', .*pass --trust os:abort, or trust="):
        check_trust("os:abort", (), source="f")
    with pytest.raises(ConfigError) as error:
        check_trust("os:\n\x1b[2J" + 10**6 * "x", (), source="f")
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 500
    check_trust("os:abort", ("os:abort",), source="f")


@pytest.mark.parametrize("key", ["task", "vehicle"])
def test_policy_file_imports_only_trusted_names(mine, tmp_path, key):
    name, preset = f"{mine}:{key}", tiny_preset()
    setup = Setup.from_preset(preset)
    policy = setup.new_policy(random.key(0))
    state = setup.learner.init(policy, random.key(1))
    save_policy(tmp_path / "p.safetensors", policy, changed(preset, **{key: name}))
    save_learner_state(tmp_path / "l.safetensors", state, changed(preset, **{key: name}))
    for read, file in ((load_policy, "p.safetensors"), (load_learner_state, "l.safetensors")):
        for trust in ((), (f"{mine}:other",)):
            with pytest.raises(CheckpointError, match=f"names Python code, '{name}'"):
                read(tmp_path / file, trust=trust)
    assert not (tmp_path / "mark").exists()
    assert mine not in sys.modules
    for read, file in ((load_policy, "p.safetensors"), (load_learner_state, "l.safetensors")):
        assert getattr(read(tmp_path / file, trust=(name,))[1], key) == name
    assert (tmp_path / "mark").exists()


@pytest.mark.parametrize(
    "text",
    [
        "vehicle = '{name}'",
        "task = '{name}'",
        "[adapt]\nresidual = '{name}'",
    ],
)
def test_overlay_needs_trust_and_preset_below_does_not(mine, tmp_path, text):
    (tmp_path / "over.toml").write_text(text.format(name=f"{mine}:vehicle"))
    below = load("hover/retrim")
    with pytest.raises(ConfigError, match="names Python code"):
        overlaid(below, tmp_path / "over.toml")
    with pytest.raises(ConfigError, match="names Python code"):
        load("hover/retrim", tmp_path / "over.toml")
    assert overlaid(below, tmp_path / "over.toml", trust=(f"{mine}:vehicle",)) != below
    (tmp_path / "other.toml").write_text("dt = 0.01")
    typed_text = changed(below, vehicle=f"{mine}:vehicle")
    assert overlaid(typed_text, tmp_path / "other.toml").vehicle == f"{mine}:vehicle"


@pytest.mark.parametrize("key", ["methods", "disturbances", "plants", "vehicles", "sensors", "references"])
def test_sweep_file_needs_trust(mine, tmp_path, key):
    (tmp_path / "s.toml").write_text(f"{key} = ['{mine}:vehicle']")
    with pytest.raises(ConfigError, match=f"names Python code, '{mine}:vehicle'"):
        read_sweep(tmp_path / "s.toml")
    assert getattr(read_sweep(tmp_path / "s.toml", (f"{mine}:vehicle",)), key) == (f"{mine}:vehicle",)
    (tmp_path / "s.toml").write_text(f"[overlay]\nvehicle = '{mine}:vehicle'")
    with pytest.raises(ConfigError, match="names Python code"):
        read_sweep(tmp_path / "s.toml")
    assert mine not in sys.modules


def test_log_map_fields_are_looked_up_in_log_only(mine, tmp_path):
    (tmp_path / "m.toml").write_text(
        f"[time]\nfield = '{mine}:t'\n[position]\nfields = ['{mine}:p']\n[velocity]\nfields = ['{mine}:v']\n"
        f"[attitude]\nfields = ['{mine}:q']\nform = 'xyzw'\n[thrust]\nfields = ['{mine}:c']\nunit = 'm/s^2'\n"
    )
    assert read_map(tmp_path / "m.toml").position.fields == (f"{mine}:p",)
    assert mine not in sys.modules


def test_name_of_trajectory_file_imports_nothing(mine, tmp_path):
    """An import of ``x.csv`` runs ``x``, also if it then fails."""
    for registry in (DISTURBANCES, FAULTS, METHODS, NETWORKS, PLANTS, RESIDUALS, SENSORS, TASKS, VEHICLES):
        for suffix in ("csv:once", "csv:laps", "CSV:once"):
            with pytest.raises(ConfigError, match="no "):
                registry.find(f"{mine}.{suffix}")
    assert not (tmp_path / "mark").exists()
