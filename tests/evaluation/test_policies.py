"""A run trains each policy once; finished policies can be flown."""

import jax
import numpy as np
import pytest

from helpers import tiny_preset
from retrim import load_policy
from retrim.config.hidden_vehicles import draw_vehicles
from retrim.evaluation import policies
from retrim.evaluation.policies import train_policies
from retrim.evaluation.study import train_all
from retrim.runkit import Run, provenance
from retrim.runkit.reporter import Silent
from retrim.runkit.training import TrainingResult


@pytest.fixture
def requests(monkeypatch):
    """Return the list of (preset, seed) for which training was requested; no training takes place."""
    result = []

    def train(setup, seed, *, reporter, stop):
        result.append((setup.preset.name, seed))
        return TrainingResult(setup.new_policy(jax.random.key(seed)), [])

    monkeypatch.setattr(policies, "train", train)
    return result


def assert_identical(one, other):
    return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


def test_policy_is_trained_once_per_folder(tmp_path, requests, monkeypatch):
    preset = tiny_preset()
    first = train_policies(preset, (3, 0), Run("test", tmp_path / "a", policy_folder=tmp_path), Silent())
    again = train_policies(preset, (0, 1, 3), Run("test", tmp_path / "b", policy_folder=tmp_path), Silent())
    assert (list(first), list(again)) == ([3, 0], [0, 1, 3])
    assert requests == [(preset.name, seed) for seed in (3, 0, 1)]
    assert all(assert_identical(first[seed], again[seed]) for seed in first)
    assert not assert_identical(again[0], again[1])
    train_policies(tiny_preset(pretrain={"learning_rate": 0.5}), (0,), Run("test", tmp_path), Silent())
    monkeypatch.setattr(provenance, "code", lambda: "changed")
    train_policies(preset, (0,), Run("test", tmp_path), Silent())
    assert requests[3:] == [(preset.name, 0)] * 2
    assert len(list((tmp_path / "policies").glob("*-seed0.safetensors"))) == 3


def test_policy_of_vehicle_file_with_delay_is_trained_once(tmp_path, requests):
    """The delay of the vehicle file replaces that of the preset when the stored policy is read."""
    vehicle = draw_vehicles(1)[0].spec
    assert round(vehicle.command_delay / tiny_preset().dt) != tiny_preset().delay_ticks
    preset, run = tiny_preset(vehicle=vehicle), Run("test", tmp_path)
    for _ in range(2):
        train_policies(preset, (0,), run, Silent())
    assert requests == [(preset.name, 0)]


def test_stored_policy_keeps_preset_and_damaged_one_is_retrained(tmp_path, requests):
    preset, run, reporter, text = tiny_preset(), Run("test", tmp_path), Silent(), []
    reporter.say = text.append
    trained_policies = train_policies(preset, (0,), run, reporter)
    (path,) = (tmp_path / "policies").iterdir()
    policy, flight = load_policy(path)
    assert flight == preset
    assert assert_identical(policy, trained_policies[0])
    path.write_bytes(path.read_bytes()[:-40])
    assert assert_identical(train_policies(preset, (0,), run, reporter)[0], policy)
    assert assert_identical(load_policy(path)[0], policy)
    assert len(requests) == 2
    assert sum("made again" in line for line in text) == 1


def test_interruption_keeps_finished_policies(tmp_path, requests, monkeypatch):
    preset, run, whole = tiny_preset(), Run("test", tmp_path), policies.train

    def stop_run(setup, seed, *, reporter, stop):
        if seed == 1:
            stop.set()
        return whole(setup, seed, reporter=reporter, stop=stop)

    monkeypatch.setattr(policies, "train", stop_run)
    assert list(train_policies(preset, (0, 1, 2), run, Silent())) == [0]
    monkeypatch.setattr(policies, "train", whole)
    requests.clear()
    study = train_all(preset, (0, 1, 2), Run("test", tmp_path), Silent())
    assert requests == [(preset.name, 1), (preset.name, 2)]
    assert list(study.policies) == [0, 1, 2]
    assert all(np.isfinite(study.errors))
    assert len(study.errors) == 3
