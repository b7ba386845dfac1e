"""Tracking, vision and low-rank adaptation as a user commands them, at reduced size."""

import json

import numpy as np
import pytest
from test_commands import retrim

SMALL = """
[pretrain]
hidden = [64, 64]
epochs = 150
envs = 16
horizon = 60
[adapt]
window = 50
epochs = 2
envs = 2
iters = 10
refine_every = 1.0
improve_every = 1.5
refine_charge = 0.1
improve_charge = 0.3
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a small tracking policy in t/ and a trajectory of the user's."""
    here = tmp_path_factory.mktemp("user")
    (here / "small.toml").write_text(SMALL)
    (here / "see.toml").write_text("represent = 5\n" + SMALL)
    rows = [
        f"{t:.1f},{0.3 * np.sin(t):.4f},{0.2 * t:.4f},{1 + 0.05 * t:.4f},{0.1 * t:.4f}" for t in np.arange(0, 6, 0.5)
    ]
    (here / "mine.csv").write_text("t,x,y,z,yaw\n" + "\n".join(rows) + "\n")
    out = retrim("pretrain", "track", "--config", "small.toml", "--out", "t", cwd=here)
    assert "track error in its own model" in out
    return here


def results(folder, name):
    return json.loads((folder / name / "results.json").read_text())


def test_track_adapts_and_its_delta_flies_again(folder):
    words = "fly", "--policy", "t", "--seconds", "4", "--disturbance", "small"
    retrim(*words, "--reference", "circle", "--adapt", "lora", "--out", "f", cwd=folder)
    base, lora = results(folder, "f")["rows"]
    assert (base["method"], lora["method"]) == ("base", "lora")
    assert base["metric"] == "tracking_error_m"
    assert 0 <= lora["cross_track_m"] <= lora["mean"] + 1e-6
    assert (folder / "f" / "track_small.png").stat().st_size > 10_000
    assert (folder / "f" / "delta.safetensors").stat().st_size < 20_000
    delta = "--delta", "f/delta.safetensors"
    retrim(*words, *delta, "--reference", "circle", "--adapt", "none", "--out", "d", cwd=folder)
    assert results(folder, "d")["rows"][0]["mean"] != base["mean"]
    retrim("pretrain", "track", "--config", "small.toml", "--seed", "1", "--out", "other", cwd=folder)
    out = retrim("fly", "--policy", "other", *delta, "--reference", "circle", cwd=folder, code=1)
    assert "made for another base policy" in out


def test_track_follows_a_file_and_full_adaptation_is_kept(folder):
    words = "--policy", "t", "--seconds", "4", "--adapt", "full", "--reference", "mine.csv", "--out", "c"
    retrim("fly", *words, cwd=folder)
    assert results(folder, "c")["rows"][1]["n"] == 1
    retrim(
        "fly",
        "--policy",
        "c/adapted.safetensors",
        "--reference",
        "circle",
        "--adapt",
        "none",
        "--seconds",
        "3",
        cwd=folder,
    )


def test_star_is_flown_with_a_warning(folder):
    words = "--policy", "t", "--seconds", "3", "--adapt", "none", "--reference", "star"
    assert "velocity jumps by 3.0" in retrim("fly", *words, cwd=folder)


def test_vision_learns_to_see_and_flies_honestly(folder):
    words = "--preset", "vision-honest", "--config", "see.toml", "--out", "v"
    assert "vision error in its own model" in retrim("pretrain", "vision", *words, cwd=folder)
    retrim("fly", "--policy", "v", "--seconds", "3", "--disturbance", "none", "--out", "vf", cwd=folder)
    assert (folder / "vf" / "vision_none.png").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pretrain", "track", "--preset", "fast"), "preset 'fast' is for hover, not for track"),
        (("pretrain", "track", "--reference", "square"), "no reference 'square'; there are circle, figure8, star"),
        (("pretrain", "track", "--reference", "no.csv"), "no.csv"),
        (("fly", "--policy", "t"), "say which to fly, as --reference circle"),
        (("fly", "--policy", "t", "--reference", "moon"), "no reference 'moon'"),
        (("fly", "--policy", "t", "--reference", "circle", "--delta", "none"), "none: no such file"),
    ],
)
def test_wrong_input_gives_one_clear_message(folder, words, message):
    assert message in retrim(*words, cwd=folder, code=1)
