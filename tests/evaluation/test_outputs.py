"""Files that a run writes: events, logs, and the learner state of the first complete flight."""

import dataclasses
import json
import os
from functools import partial

import jax
import numpy as np
import pytest

from fake_flights import DT, flight, log
from helpers import brief_preset
from retrim import Event, LoraPolicy, Scenario, Setup
from retrim.evaluation.metrics import failed_record, notes, summary
from retrim.io.logs.viewers import can_record
from retrim.io.policies import load_learner_state, load_policy
from retrim.runkit import FlightSpec, Run, outputs
from retrim.runkit.document import Document, TableSection
from retrim.runkit.outlet import Outlet
from retrim.runkit.outputs import clear_outputs
from retrim.runkit.reporter import Silent

SPECS = [FlightSpec(Scenario(), method, start, 4) for method in ("base", "full") for start in (0, 1)]


@pytest.fixture(scope="module")
def setup():
    return Setup.from_preset(brief_preset())


def make_learner_state(setup, seed, low_rank=False):
    policy = setup.new_policy(jax.random.key(seed))
    if low_rank:
        policy = setup.low_rank(policy, jax.random.key(seed))
    return setup.learner.init(policy, jax.random.key(0))


def weights(policy):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(policy.params)]


def test_event_lines_identify_flight(tmp_path):
    flights = [
        flight(0.1, spec=spec, events=[Event(1.23456789, "policy", f"note {k}"), Event(2.0, "skipped", "")])
        for k, spec in enumerate(SPECS)
    ]
    outputs.write_events(flights, tmp_path)
    rows = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [(row["method"], row["start"], row["event"]) for row in rows] == [
        (spec.method, spec.start, kind) for spec in SPECS for kind in ("policy", "skipped")
    ]
    assert {(row["disturbance"], row["seed"]) for row in rows} == {("none", 4)}
    assert (rows[2]["t"], rows[2]["note"]) == (1.234568, "note 1")


def test_recording_pairs_measurement_with_next_command(tmp_path):
    """Row i of a log has the command of the tick that ended there; a recording has the command of the tick that began
    there.
    """
    t = DT * np.arange(6)
    trajectory = log(t=t)
    u = np.arange(24.0).reshape(6, 4)
    true = trajectory.true._replace(p=np.arange(18.0).reshape(6, 3))
    setup = flight(0.1, flight=trajectory._replace(u=u, true=true, age=0.01, terminated=True))
    setup = dataclasses.replace(setup, target=np.ones((6, 3)))
    result = outputs.recording_of(setup)
    np.testing.assert_array_equal(result.command, [*u[1:], u[-1]])
    np.testing.assert_array_equal(result.true[:, :3], true.p)
    np.testing.assert_array_equal(result.measured[:, :3], 0.0)
    np.testing.assert_array_equal(result.true[:, 3:12].reshape(-1, 3, 3), np.tile(np.eye(3), (6, 1, 1)))
    np.testing.assert_array_equal(result.age, 0.01)
    np.testing.assert_array_equal(result.error, 0.1)
    np.testing.assert_array_equal(result.target, 1.0)
    assert result.terminated


def test_learner_state_of_first_complete_flight_is_saved(setup, tmp_path):
    """Flights that crashed or do not learn are excluded; a low-rank policy also saves its delta."""
    states = [make_learner_state(setup, seed) for seed in range(4)]
    brief = partial(flight, 0.1, seconds=0.2)
    flights = [
        brief(spec=SPECS[0]), brief(spec=SPECS[2], terminated=True), brief(spec=SPECS[3]),
        brief(spec=dataclasses.replace(SPECS[3], start=2)),
    ]  # fmt: skip
    flights = [
        flights[0],
        *(dataclasses.replace(f, learner_state=s) for f, s in zip(flights[1:], states, strict=False)),
    ]
    Outlet(tmp_path).write_flights(flights, setup.preset)
    policy, preset = load_policy(tmp_path / "adapted.safetensors")
    assert preset == setup.preset
    for one, other in zip(weights(policy), weights(states[1].policy.policy), strict=True):
        np.testing.assert_array_equal(one, other)
    state, _ = load_learner_state(tmp_path / "learner_state.safetensors")
    np.testing.assert_array_equal(weights(state.policy.policy)[0], weights(states[1].policy.policy)[0])
    names = sorted(path.name for path in (tmp_path / "logs").glob("*.npz"))
    assert names == ["base_seed4_start0.npz", "full_seed4_start0.npz", "full_seed4_start1.npz", "full_seed4_start2.npz"]
    if can_record(tmp_path / "flight.mcap"):
        assert len(list((tmp_path / "logs").glob("*.mcap"))) == 4
    low = dataclasses.replace(flights[2], learner_state=make_learner_state(setup, 0, low_rank=True))
    assert isinstance(low.learner_state.policy.policy, LoraPolicy)
    Outlet(tmp_path).write_flights([low], setup.preset)
    assert sorted(path.name for path in tmp_path.glob("*.safetensors")) == [
        "delta.safetensors",
        "learner_state.safetensors",
    ]
    assert [path.name for path in (tmp_path / "logs").glob("*.npz")] == [
        "full_seed4_start1.npz"
    ]  # no files of earlier runs
    Outlet(tmp_path).write_flights(flights[:1], setup.preset)
    assert not list(tmp_path.glob("*.safetensors"))
    assert (tmp_path / "events.jsonl").read_text() == ""


def test_trained_policy_is_written_with_results(setup, tmp_path):
    policy = setup.new_policy(jax.random.key(7))
    for error, more in ((None, {}), (0.25, {"nominal_error_m": 0.25})):
        path = outputs.write_trained_policy(
            Run("test", tmp_path), setup, policy, [3.0, 2.0, 1.5], seed=7, error_m=error
        )
        assert path == tmp_path / "policy.safetensors"
        result = json.loads((tmp_path / "results.json").read_text())
        assert result["rows"] == [
            {"task": "hover", "preset": setup.preset.name, "updates": 3, "envs": 2, "loss": 1.5} | more
        ]
        assert (result["seeds"], result["losses"]) == ([7], [3.0, 2.0, 1.5])
    loaded_policy, _ = load_policy(path)
    np.testing.assert_array_equal(weights(loaded_policy)[0], weights(policy)[0])


def test_notes_report_crashes_and_missing_updates(setup):
    """The note states the earliest possible time of an update."""
    last = Event(3.0, "terminated", "below -0.5 m")
    crashes = flight(3.0, spec=SPECS[1], terminated=True, seconds=3.0, events=[last])
    assert notes([flight(0.1), crashes], setup.preset) == ["crashed: base, start 1, after 3.00 s: below -0.5 m"]
    idle = dataclasses.replace(flight(0.1, spec=SPECS[2]), learner_state=make_learner_state(setup, 0))
    a = setup.preset.adapt
    text = f"no policy update took effect; with fixed latencies the first one comes at {a.update_every + 0.2:g} s"
    assert notes([idle], setup.preset) == [text]
    swap = flight(0.1, spec=SPECS[2], events=[Event(1.0, "policy", "")])
    assert notes([dataclasses.replace(swap, learner_state=idle.learner_state), idle], setup.preset) == []


def test_failed_job_is_counted_and_not_scored():
    gap = failed_record(SPECS[0], "small", "steady_error_m", "OSError: gone")
    assert (gap["method"], gap["start"], gap["seed"], gap["vehicle"]) == ("base", 0, 4, "small")
    assert (gap["crashed"], gap["failed"], gap["error"]) == (False, "OSError: gone", None)
    row = summary([gap, gap])
    assert (row["n"], row["crashes"], row["failures"], row["mean"]) == (2, 0, ["OSError: gone"] * 2, None)
    assert (row["disturbance"], row["plant"], row["metric"]) == ("none", "bem", "steady_error_m")
    assert "reference" not in row  # a hover flight has no reference


def test_files_of_user_and_inputs_remain(tmp_path):
    logs = tmp_path / "logs"
    logs.mkdir()
    mine = [tmp_path / "flight.ulg", logs / "outdoor.mcap", logs / "field.npz", tmp_path / "delta.safetensors"]
    own = [logs / "base_seed0_start1.npz", logs / "a.b_seed0_start1.mcap", tmp_path / "adapted.safetensors"]
    for path in (*mine, *own):
        path.write_bytes(b"x")
    clear_outputs(tmp_path, [mine[-1].resolve()])
    assert all(path.exists() for path in mine)
    assert not any(path.exists() for path in own)


def test_runs_of_the_same_second_have_separate_folders(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    first = Run("fly").folder
    monkeypatch.setattr(os, "getpid", lambda: -1)
    assert Run("fly").folder != first


class Failing(Silent):
    """A reporter whose output cannot take the text."""

    def __init__(self):
        self.texts = []

    def say(self, text):
        self.texts.append(text)
        raise UnicodeEncodeError("ascii", text, 0, 1, "ordinal not in range(128)")


def test_document_is_written_even_if_its_text_cannot_be_printed(tmp_path, monkeypatch):
    document = Document(Run("test", tmp_path), "table", "Title", "Intro.", [0], Failing())
    with pytest.raises(UnicodeEncodeError):
        document.add(TableSection(("error",), (("1 ± 2 mm",),)), [{"n": 1}])
    assert "| 1 ± 2 mm |" in (tmp_path / "table.md").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "table.json").read_text())["rows"] == [{"n": 1}]
    monkeypatch.setattr(Run, "write_results", lambda *_, **__: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(UnicodeEncodeError):
        document.add(TableSection(("x",), (("2",),)))
    assert "| 2 |" in document.reporter.texts[-1]  # also printed if it cannot be written
