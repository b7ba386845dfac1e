"""A replay that is interrupted at any stage keeps its finished sections and is recorded as interrupted."""

import importlib
import json

import jax
import pytest

from fake_body_flight import fly_body
from fake_dataflash import body_messages, dataflash
from fake_log import MAP, columns, fly_once, write_csv, write_map
from helpers import tiny_preset
from retrim.config.setup import Setup
from retrim.io.policies import save_policy
from retrim.replay import body_replay
from retrim.replay.body_identification import BodyIdentification
from retrim.replay.identification import Estimate, IdentifiedVehicle
from retrim.replay.replay import Replay, replay
from retrim.runkit.reporter import Silent
from retrim.runkit.run import Run

replays = importlib.import_module("retrim.replay.replay")  # the module, not the function of the same name
LAG = Estimate(0.05, 0.04, 0.06)
FOUND = IdentifiedVehicle(None, None, None, None, LAG, None, None, None, None, (None, None, None), 0.1)


def interrupt(*_, **__):
    raise KeyboardInterrupt


def assert_is_recorded(run, *, sections):
    result = json.loads((run.folder / "replay.json").read_text())
    text = (run.folder / "replay.md").read_text()
    assert run.exit_code == 130
    assert result["interrupted"]
    assert "Interrupted: incomplete." in text
    assert text.count("\n## ") == sections + 1  # the last one is the provenance


@pytest.mark.parametrize(
    ("stage", "sections"),
    [("residual_section", 1), ("_score_predictions", 2), ("predict_log", 2), ("identify", 2), ("identified_section", 2),
     ("write_vehicle", 3), ("adapt_to", 3), ("write_state", 3)],
)  # fmt: skip
def test_interrupted_replay_is_recorded(tmp_path, monkeypatch, stage, sections):
    path, choice = write_csv(tmp_path / "log.csv", columns(fly_once(14.0))), write_map(tmp_path / "map.toml", MAP)
    preset = tiny_preset(adapt={"residual": "linear", "window": 100, "fit_every": 1.0})
    save_policy(tmp_path / "p.safetensors", Setup.from_preset(preset).new_policy(jax.random.key(0)), preset)
    monkeypatch.setattr(replays, "identify", lambda log, seed: FOUND)
    monkeypatch.setattr(replays, "adapt_to", lambda *_, **__: type("Result", (), {"state": None}))
    if stage != "predict_log":
        monkeypatch.setattr(replays, "_score_predictions", lambda *_: [])
    monkeypatch.setattr(replays, stage, interrupt)
    request = Replay(map=str(choice), buffer=2.0, horizon=1.0, identify=True, adapt="full",
                     policy=tmp_path / "p.safetensors")  # fmt: skip
    run = Run("replay", tmp_path / "out")
    replay(path, request, run, Silent())
    assert_is_recorded(run, sections=sections)


@pytest.mark.parametrize(("stage", "sections"), [("agreement_section", 0), ("body_section", 1), ("write_vehicle", 2)])
def test_interrupted_replay_of_rates_is_recorded(tmp_path, monkeypatch, stage, sections):
    (tmp_path / "flight.bin").write_bytes(dataflash(body_messages(fly_body(3.0)), without=("XKF1",)))
    found = BodyIdentification(FOUND, None, None, 0.5, {})
    monkeypatch.setattr(body_replay, "identify_body", lambda log, seed: found)
    monkeypatch.setattr(body_replay, stage, interrupt)
    run = Run("replay", tmp_path / "out")
    replay(tmp_path / "flight.bin", Replay(identify=True), run, Silent())
    assert_is_recorded(run, sections=sections)
