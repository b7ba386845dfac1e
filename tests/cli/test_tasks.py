"""Tracking, vision and low-rank adaptation from the command line, at reduced size."""

import numpy as np
import pytest

from commands import SMALL, results, retrim

pytestmark = pytest.mark.usefixtures("as_a_user")

TINY = (
    SMALL.replace("num_updates = 150", "num_updates = 80\nnum_envs = 8\nhorizon = 60")
    + 'window = 50\n[track]\nreference = "star"\n'
)
SEE = (
    SMALL.replace("num_updates = 150", "num_updates = 10\nnum_envs = 4\nhorizon = 40") + "[vision]\nencoder_steps = 5\n"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, as_a_user):
    """Return a folder with a trajectory file, and a small policy in t/ trained on a family of references."""
    here = tmp_path_factory.mktemp("user")
    (here / "tiny.toml").write_text(TINY)
    (here / "see.toml").write_text(SEE)
    rows = [f"{t:.1f},{np.sin(0.3 * t):.4f},{0.1 * t:.4f},{1 + 0.05 * t:.4f},{0.1 * t:.4f}" for t in np.arange(13.0)]
    (here / "mine.csv").write_text("t,x,y,z,yaw\n" + "\n".join(rows) + "\n")
    words = "--config", "tiny.toml", "--reference", "circle+figure8", "--out", "t"
    out = retrim("pretrain", "track", *words, cwd=here)
    assert "track error in its own model" in out
    return here


def test_track_adapts_by_low_rank_and_flies_delta_again(folder):
    words = "fly", "--policy", "t", "--seconds", "3", "--disturbance", "small", "--reference", "mine.csv"
    retrim(*words, "--adapt", "lora", "--out", "f", cwd=folder)
    base, lora = results(folder / "f")["rows"]
    assert (base["method"], lora["method"]) == ("base", "lora")
    assert base["metric"] == "tracking_error_m"
    assert base["reference"] == lora["reference"] == "mine.csv"
    assert 0 <= lora["cross_track_m"] <= lora["mean"] + 1e-6
    assert (folder / "f" / "track_small.png").stat().st_size > 10_000
    assert (folder / "f" / "delta.safetensors").stat().st_size < 20_000
    retrim(*words, "--delta", "f/delta.safetensors", "--adapt", "none", "--out", "d", cwd=folder)
    assert results(folder / "d")["rows"][0]["mean"] != base["mean"]


def test_fly_star_warns(folder):
    words = "--policy", "t", "--seconds", "2", "--adapt", "none", "--reference", "star", "--out", "star"
    out = retrim("fly", *words, cwd=folder)
    assert "warning: vehicle small cannot fly all of reference star" in out
    assert "velocity jumps by 3.0" in out


def test_family_requires_reference_option(folder):
    out = retrim("fly", "--policy", "t", "--out", "never", cwd=folder, code=1)
    assert "trained on circle+figure8: choose one, as in --reference circle" in out
    assert not (folder / "never").exists()


def test_pretrain_vision_and_fly_with_occlusion(folder):
    words = "--config", "see.toml", "--out", "v"
    assert "vision error in its own model" in retrim("pretrain", "vision", *words, cwd=folder)
    # 03_vision.py covers adaptation
    words = "--adapt", "base-do", "--seconds", "2", "--disturbance", "none", "--out", "vf"
    retrim("fly", "--policy", "v", *words, cwd=folder)
    assert (folder / "vf" / "vision_none.png").exists()
    assert results(folder / "vf")["rows"][0]["n"] == 1
