"""Times of changes in the conditions, and recovery times of flights."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from commands import retrim
from helpers import brief_preset
from retrim.config import named_presets as presets
from retrim.runkit.recovery import change_times, recoveries
from retrim_paper.conditions import conditions
from retrim_paper.tables.gauntlet import METRICS

HOME = jnp.array([0.0, 0.0, 1.0])


def find(error, changes, limit, **more):
    return recoveries(0.02 * np.arange(len(error)), np.asarray(error), changes, limit, **more)


@pytest.mark.parametrize(
    ("name", "seconds", "expected"),
    [
        ("none", 30.0, []),
        ("large", 30.0, []),
        ("kick", 30.0, [8.0]),
        ("step", 30.0, [8.0]),
        ("step", 5.0, []),
        ("reversing", 60.0, [15.0, 30.0, 45.0]),
        ("pickup", 30.0, [8.0, 20.0]),
        ("step+pickup", 30.0, [8.0, 20.0]),
        ("gusts", 30.0, []),
        ("battery", 30.0, []),
    ],
)
def test_times_of_changes(name, seconds, expected):
    np.testing.assert_allclose(change_times(name, HOME, seconds), expected)


def test_recovery_starts_at_last_excess():
    """The error exceeds the limit until 1 s and again at 1.5 s; then a change at 2 s lasts for half a second."""
    error = np.zeros(200)
    error[:50] = error[75] = error[100:125] = 0.1
    np.testing.assert_allclose(find(error, [0.0, 2.0], 0.05), [1.52, 0.5])
    np.testing.assert_allclose(find(error, [0.0, 2.0], 0.2), [0.0, 0.0])
    np.testing.assert_allclose(find(error, [], 0.05), [2.5])


def test_crash_or_lasting_excess_is_not_recovery():
    assert find(np.full(100, 0.1), [0.0, 1.0], 0.05) == [np.inf, np.inf]
    assert find(np.zeros(100), [0.5], 0.05, terminated=True) == [np.inf]
    assert find(np.zeros(10), [5.0], 0.05) == [np.inf]  # the flight ended earlier


def test_gauntlet_by_its_command(tmp_path, as_a_user, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "hover/retrim", brief_preset())
    words = "--only", "wind/simple", "wind/mujoco", "--methods", "base", "full", "--starts", "1", "--seconds", "6"
    out = retrim("gauntlet", *words, "--out", "g", cwd=tmp_path)
    assert "wind/simple" in out
    rows = json.loads((tmp_path / "g" / "results.json").read_text())["rows"]
    assert [(row["scenario"], row["method"], row["metric"]) for row in rows] == [
        (name, method, metric) for name in ("wind/simple", "wind/mujoco") for method in ("base", "full")
        for metric in METRICS
    ]  # fmt: skip
    for row in rows:
        assert row["value"] is None or 0.0 <= row["value"] <= row["worst"]
    text = (tmp_path / "g" / "gauntlet.md").read_text()
    assert text.count("| wind/simple |") == 2
    assert all((tmp_path / "g" / name).stat().st_size > 10_000 for name in ("gauntlet.png", "gauntlet_flights.png"))


@pytest.mark.parametrize("name", ["hover/retrim", "track/retrim", "track/fast"])
def test_conditions_have_distinct_scenarios(name):
    scenarios = list(conditions(presets.PRESETS[name]).values())
    assert len(set(scenarios)) == len(scenarios)
