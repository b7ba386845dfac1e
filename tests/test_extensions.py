"""Ten extensions of at most 20 lines, from files in an empty folder: flights, sweep, live flight and replay."""

import json
import shutil
import sys
from pathlib import Path

import pytest

from commands import results, retrim
from retrim.testing import check_plant

SOURCE = Path(__file__).parents[1] / "examples" / "extensions"
FILES = sorted(SOURCE.glob("*.*"))
PRESET = """
vehicle = "vehicle.toml"
[pretrain]
network = "network:residual"
num_updates = 150
num_envs = 16
horizon = 60
[adapt]
learner = "online_learner:make"
residual = "residual:constant"
num_updates = 5
num_envs = 4
fit_every = 0.6
update_every = 1.0
fit_latency = 0.1
update_latency = 0.2
"""
NAMES = ("network:residual", "online_learner:make", "residual:constant", "reward:task")
TRUST = [word for name in NAMES for word in ("--trust", name)]
SWEEP = """
presets = ["hover/fast"]
methods = ["base", "controller:pd"]
disturbances = ["disturbance:thermal=3"]
sensors = ["sensor:mocap"]
vehicles = ["vehicle.toml"]
seconds = 1.0
[overlay]
task = "task:task"
[overlay.pretrain]
num_updates = 10
num_envs = 4
horizon = 40
hidden_sizes = [8, 8]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory, as_a_user):
    """Return a folder with the user's files and a policy of their reward, network and vehicle."""
    folder = tmp_path_factory.mktemp("user")
    for path in FILES:
        shutil.copy(path, folder)
    (folder / "preset.toml").write_text(PRESET)
    (folder / "sweep.toml").write_text(SWEEP)
    before = list(sys.path), set(sys.modules)
    sys.path.insert(0, str(folder))
    retrim("pretrain", "reward:task", "--config", "preset.toml", *TRUST, "--out", "p", cwd=folder)
    yield folder
    sys.path[:] = before[0]
    for name in set(sys.modules) - before[1]:
        if str(folder) in (getattr(sys.modules[name], "__file__", "") or ""):
            del sys.modules[name]


def test_plant_obeys_laws(folder):
    import plant

    check_plant(lambda: plant.Toy(0.02))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_extension_has_at_most_twenty_lines(path):
    assert len([line for line in path.read_text().splitlines() if line.strip()]) <= 20


def test_extensions_fly_and_learn_in_lockstep(folder):
    where = "--disturbance", "disturbance:thermal=3", "--sensors", "sensor:mocap"
    retrim("fly", "--policy", "p", *TRUST, *where, "--seconds", "3", "--out", "f", cwd=folder)
    rows = {row["method"]: row for row in results(folder / "f")["rows"]}
    assert set(rows) == {"base", "full"}
    assert all(row["mean"] < 2.0 for row in rows.values())
    retrim("fly", "--policy", "p", *TRUST, "--plant", "plant:toy", "--disturbance", "none", "--seconds", "3",
           "--adapt", "controller:pd", "--out", "g", cwd=folder)  # fmt: skip
    assert {row["method"] for row in results(folder / "g")["rows"]} == {"base", "controller:pd"}


def test_extensions_fly_live_and_log_is_replayed(folder):
    where = "--disturbance", "disturbance:thermal=3", "--sensors", "sensor:mocap"
    retrim("live", "--policy", "p", *TRUST, *where, "--seconds", "5", "--no-page", "--out", "l", cwd=folder)
    events = [json.loads(line)["event"] for line in (folder / "l" / "events.jsonl").read_text().splitlines()]
    assert "residual" in events
    assert {"policy", "rejected"} & set(events)  # the gate may refuse a random step
    words = "--policy", "p", "--adapt", "full", "--updates", "2", "--buffer", "1", "--horizon", "0.5"
    out = retrim("replay", "l/flight.csv", *TRUST, *words, "--out", "r", cwd=folder)
    assert "2 of 2 updates" in out or "1 of 2 updates" in out


def test_extensions_are_axes_of_sweep(folder):
    names = "task:task", "controller:pd", "disturbance:thermal", "sensor:mocap"
    trust = [word for name in names for word in ("--trust", name)]
    retrim("sweep", "sweep.toml", *trust, "--out", "s", cwd=folder)
    rows = results(folder / "s", "sweep.json")["rows"]
    assert {(row["method"], row["disturbance"], row["sensors"]) for row in rows} == {
        (method, "disturbance:thermal=3", "sensor:mocap") for method in ("base", "controller:pd")
    }


def test_other_network_is_refused_where_perceptron_is_needed(folder):
    out = retrim("fly", "--policy", "p", *TRUST, "--adapt", "lora", "--seconds", "1", cwd=folder, code=1)
    assert "low-rank adaptation needs a perceptron" in out
    out = retrim("export", "p", "--to", "npz", *TRUST, cwd=folder, code=1)
    assert "export needs a perceptron" in out


BROKEN = """
import jax.numpy as jnp


def gust(key, size):
    return lambda t, x: jnp.zeros(4).reshape(9)
"""


def test_error_in_user_file_gives_line_with_location_or_traceback(folder):
    (folder / "broken.py").write_text(BROKEN)
    words = "fly", "--policy", "p", *TRUST, "--disturbance", "broken:gust", "--adapt", "none", "--seconds", "1"
    out = retrim(*words, cwd=folder, code=1)
    assert f"{folder}/broken.py, line 6: TypeError: cannot reshape array of shape (4,)" in out
    with pytest.raises(TypeError, match="cannot reshape"):
        retrim(*words, "--traceback", cwd=folder)
