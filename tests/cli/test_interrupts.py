"""Ctrl-C, SIGTERM or SIGHUP at any moment: exit code 130, no traceback, and finished work is saved."""

import importlib
import re
import shutil
import signal

import jax
import pytest

from commands import SMALL, results, retrim, run_interrupted
from helpers import tiny_preset
from retrim import Fleet, Setup, load_policy, save_policy
from retrim.config import named_presets as presets
from retrim.config.loading import overlaid
from retrim_paper import demo

pytestmark = pytest.mark.usefixtures("as_a_user")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, as_a_user):
    """Return a folder with an untrained policy in p/."""
    here = tmp_path_factory.mktemp("user")
    brief = SMALL.replace("[64, 64]", "[8]\nnum_envs = 2\nhorizon = 20").replace("= 150", "= 20")
    (here / "small.toml").write_text(brief)
    preset = tiny_preset()
    save_policy(here / "p" / "policy.safetensors", Setup.from_preset(preset).new_policy(jax.random.key(0)), preset)
    return here


IMPORT = """
import signal
from pathlib import Path

signal.raise_signal(signal.{name})
Path("imported").touch()


def slow():
    return lambda stop: Path("called").touch()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_interruption_of_imports_lets_them_finish_and_does_not_start_command(name, tmp_path, monkeypatch):
    main, module = importlib.import_module("retrim.cli.main"), f"command_{name}"
    (tmp_path / f"{module}.py").write_text(IMPORT.format(name=name))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(main, "own_commands", lambda: {"slow": ("Do something.", module)})
    monkeypatch.setattr(signal, "getsignal", lambda number: signal.SIG_DFL)  # the runner of the tests may ignore SIGHUP
    assert retrim("slow", cwd=tmp_path, code=130) == "interrupted\n"
    assert (tmp_path / "imported").exists()
    assert not (tmp_path / "called").exists()


HANG = """
import signal, time

signal.raise_signal(signal.SIGINT)
signal.raise_signal(signal.SIGINT)
time.sleep(600)
"""


def test_second_interruption_ends_an_import(tmp_path, monkeypatch):
    main = importlib.import_module("retrim.cli.main")
    (tmp_path / "command_that_hangs.py").write_text(HANG)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(main, "own_commands", lambda: {"slow": ("Do something.", "command_that_hangs")})
    assert retrim("slow", cwd=tmp_path, code=130) == "interrupted\n"


PRETRAIN = "pretrain", "hover", "--config", "small.toml"


def test_interrupted_training_saves_policy(folder):
    code, out = run_interrupted((*PRETRAIN, "--updates", "100000", "--out", "cut"), folder, after=b"loss ")
    assert code == 130, out
    assert "Traceback" not in out
    result = results(folder / "cut")
    assert result["interrupted"]
    assert 0 < len(result["losses"]) < 100_000
    assert result["rows"][0]["updates"] == len(result["losses"])
    assert load_policy(folder / "cut")[1].pretrain.num_updates == 100_000
    retrim("fly", "--policy", "cut", "--seconds", "1", "--adapt", "none", "--out", "cut_flown", cwd=folder)


def interrupt_at(monkeypatch, place, name, *, after=False):
    """Let Ctrl-C arrive when a function begins or, with ``after``, when it has ended."""
    function = getattr(place, name)

    def call(*words, **more):
        result = function(*words, **more) if after else None
        signal.raise_signal(signal.SIGINT)
        return result if after else function(*words, **more)

    monkeypatch.setattr(place, name, call)


def test_interrupted_training_does_not_replace_a_policy(folder, monkeypatch):
    (folder / "again").mkdir()
    path = shutil.copy(folder / "p" / "policy.safetensors", folder / "again" / "policy.safetensors")
    before, train = path.read_bytes(), Setup.pretraining

    def interrupt_second_step(*words):
        for steps in train(*words):
            yield steps
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Setup, "pretraining", interrupt_second_step)
    out = retrim(*PRETRAIN, "--updates", "100000", "--out", "again", cwd=folder, code=130)
    assert path.read_bytes() == before
    assert "again/interrupted/policy.safetensors" in out
    assert results(folder / "again/interrupted")["interrupted"]
    assert load_policy(folder / "again/interrupted")[1].pretrain.num_updates == 100_000


def test_interrupted_compilation_saves_nothing(folder):
    # This program takes a minute to compile, so that there is time to interrupt it on any machine.
    setup = "import time; from retrim import Setup; Setup.pretraining = lambda *_: (time.sleep(60) for _ in range(2))"
    code, out = run_interrupted((*PRETRAIN, "--out", "never"), folder, after=b"compiling", setup=setup)
    assert code == 130, out
    assert "Traceback" not in out
    assert "interrupted before the first steps were done; nothing was saved" in out
    assert not (folder / "never").exists()


@pytest.mark.parametrize(
    ("module", "name", "after"),
    [("retrim.runkit.outputs", "save_policy", True), ("retrim.cli.pretrain", "nominal_error", False)],
)
def test_interruption_before_score_keeps_policy_and_results(folder, monkeypatch, module, name, after):
    interrupt_at(monkeypatch, importlib.import_module(module), name, after=after)
    out = retrim(*PRETRAIN, "--out", name, cwd=folder, code=130)
    assert "interrupted after 20 steps, which are saved" in out
    result = results(folder / name)
    assert len(result["losses"]) == result["rows"][0]["updates"] == 20
    assert load_policy(folder / name)[1].name == "hover/retrim"


@pytest.mark.parametrize(("place", "name"), [(demo, "fly_all"), (Fleet, "run")])
def test_interruption_of_demo_before_flights_keeps_policy_and_results(folder, monkeypatch, place, name):
    small = overlaid(presets.PRESETS["hover/retrim"], folder / "small.toml")
    monkeypatch.setitem(presets.PRESETS, "hover/retrim", small)
    interrupt_at(monkeypatch, place, name)
    folder_name = f"demo_{name}"
    retrim("demo", "--starts", "1", "--seconds", "3", "--out", folder_name, cwd=folder, code=130)
    assert len(results(folder / folder_name)["losses"]) == 20
    assert load_policy(folder / folder_name)[1].pretrain.hidden_sizes == (8,)


def test_interrupted_fly_saves_finished_flights(folder):
    words = "fly", "--policy", "p", "--seconds", "20", "--starts", "60", "--adapt", "none", "--plant", "simple"
    one_by_one = "--latency", "measured"  # flights in one program all end at the same time
    by = signal.SIGHUP  # signal of a closed terminal
    code, out = run_interrupted((*words, *one_by_one, "--out", "half"), folder, after=b" of 60 flights", by=by)
    assert code == 130, out
    assert "Traceback" not in out
    result = results(folder / "half")
    assert result["interrupted"]
    assert 0 < result["rows"][0]["n"] < 60
    assert (folder / "half" / "hover_large.png").exists()
    assert len(list((folder / "half" / "logs").glob("*.npz"))) == result["rows"][0]["n"]


def test_interrupted_live_lands_and_saves_flight(folder):
    """The flight has a page and a recording, and does not learn."""
    words = "live", "--policy", "p", "--plant", "simple", "--disturbance", "none", "--adapt", "base-do"
    display = "--page", "--page-port", "18280", "--record", "live.mcap", "--out", "live"
    code, out = run_interrupted((*words, *display), folder, after="│ policy".encode())
    assert code == 0, out  # without --seconds, Ctrl-C is the regular end of a flight
    assert "Traceback" not in out
    assert "interrupted" not in out
    assert "flight over: landed" in out
    assert re.search(r"page: http://127\.0\.0\.1:182\d\d/[\w-]{32}$", out, re.M)
    result = results(folder / "live")
    assert not result["interrupted"]
    assert {row["metric"]: row["value"] for row in result["rows"]}["policies"] == 0
    assert (folder / "live" / "flight.csv").exists()
    assert not list((folder / "live").glob("start*"))
    assert (folder / "live.mcap").stat().st_size > 10_000
