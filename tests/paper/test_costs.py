"""Pages of searches, costs and numbers of flights: the requested flights, and the content of the page."""

import importlib

import jax
import numpy as np
import pytest

from commands import results
from fake_flights import Imaginary, Watching, flight
from helpers import brief_preset
from retrim import ConfigError, Scenario
from retrim.config import named_presets
from retrim.evaluation.study import Study
from retrim.runkit import Run
from retrim.runkit.reporter import Silent
from retrim.runkit.stopwatch import Stopwatch
from retrim_paper.design import Retraining

# The package exports functions with the names of these modules.
NAMES = ("design", "efficiency", "scaling", "tuning")
design, efficiency, scaling, tuning = (importlib.import_module(f"retrim_paper.tables.{name}") for name in NAMES)
SEEDS = (0, 3)


def test_scaling_flies_requested_number_and_discards_flights(tmp_path, presets, pictures, monkeypatch):
    """Half of the flights adapt; errors count when flights finish, and crashes are counted separately."""
    done, setup = Imaginary(lambda spec: None if spec.start == 0 and spec.method == "full" else 0.25), []

    class Fleet:
        def __init__(self, preset, policies, scenarios, **how):
            setup.append((policies, tuple(scenarios), how))
            self._study, self._scenarios, self._how = Study(preset, policies, ()), scenarios, how

        def run(self, *, stop, progress, on_result, forget):
            assert forget
            flight = done.fly(self._study, self._scenarios, None, None, **self._how).flights
            for k in range(0, len(flight), 2):
                on_result(flight[k : k + 2])
                progress(k + 2.0, len(flight))

    monkeypatch.setattr(scaling, "Fleet", Fleet)
    monkeypatch.setattr(scaling, "train_all", done.train)
    message = pictures(scaling, "panel_figure", "save")
    scaling.scaling(Run("test", tmp_path), Silent(), flights=(4, 12), seconds=8.0)
    assert [seeds for _, seeds in done.trainings] == [(0,)]
    assert setup == [
        ({0: "policy 0"}, tuple(map(Scenario, scaling.CONDITIONS)),
         {"methods": scaling.METHODS, "starts": starts, "seconds": 8.0})
        for starts in (1, 3)
    ]  # fmt: skip
    result = results(tmp_path, "scaling.json")["rows"]
    assert [(row["flights"], row["seconds"], row["crashes"], row["mean"]) for row in result] == [
        (4, 8.0, 2, 0.25), (12, 8.0, 2, 0.25)
    ]  # fmt: skip
    assert all(row["compile_s"] >= 0.0 and 0.0 < row["run_s"] < 30.0 for row in result)
    assert all(row["flight_bytes"] > 1000 for row in result)
    text = (tmp_path / "scaling.md").read_text()
    assert "4 of 16 flights crashed." in text
    (((_, (time, memory)), _),) = message["panel_figure"]
    measurement, linear = time.curves
    np.testing.assert_array_equal(measurement.x, [4, 12])
    assert linear.y[0] == pytest.approx(measurement.y[1] / 3.0)
    assert linear.y[1] == pytest.approx(measurement.y[1])
    np.testing.assert_allclose(memory.curves[0].y, [row["peak_mb"] for row in result])


@pytest.mark.parametrize("flights", [(), (0,), (6,), (4, -4)])
def test_invalid_numbers_of_flights_are_refused_before_training(flights, tmp_path, monkeypatch):
    monkeypatch.setattr(scaling, "train_all", lambda *_: pytest.fail("trains"))
    with pytest.raises(ConfigError, match="must be a positive multiple of 4"):
        scaling.scaling(Run("test", tmp_path), Silent(), flights=flights, seconds=8.0)


def test_scaling_rows_are_rates():
    class Watch(Stopwatch):
        compile_s, total_s = 3.0, 5.0

    row = scaling._row(8, 10.0, Watch(), [0.1, np.nan, 0.3])
    assert (row["compile_s"], row["run_s"], row["crashes"], row["mean"]) == (3.0, 2.0, 1, pytest.approx(0.2))
    assert scaling._row(1, 10.0, Watch(), [np.nan])["mean"] is None
    assert scaling._time(59.0) == "59 s"
    assert scaling._time(150.0) == "2.5 minutes"
    assert scaling._time(3 * 3600.0) == "3.0 hours"
    assert scaling._time(3 * 86_400.0) == "3.0 days"


def test_scaling_lines_are_flights_by_time(tmp_path, pictures):
    pictures(scaling, "panel_figure", "save")
    rows = [
        {"flights": n, "seconds": 10.0, "compile_s": 3.4, "run_s": took, "peak_mb": 512.3, "crashes": n // 4}
        for n, took in ((4, 2.0), (40, 8.0))
    ]
    section = scaling._section(rows, Run("test", tmp_path))
    assert section.rows == (("4", "3", "2.0", "2.0", "20", "512"), ("40", "3", "8.0", "5.0", "50", "512"))
    assert section.about == "11 of 44 flights crashed."


def test_search_flies_every_candidate_under_every_condition(tmp_path, monkeypatch):
    """The score is the root mean square after 3 s, averaged over conditions; a crash counts as one metre."""
    trajectory = []

    def fly_together(plants, pilots, starts, *, ticks, stop):
        trajectory.append((plants, pilots, starts, ticks))
        return range(len(plants))

    t = 0.02 * np.arange(301)

    def score(setup, spec, log):
        if log % 4 == 3:  # the second start of every second candidate
            return flight(3.0, terminated=True, seconds=1.0)
        return flight(np.where(t > 3.0 + 1e-9, 0.3, 5.0), seconds=6.0)

    monkeypatch.setattr(tuning, "fly_together", fly_together)
    monkeypatch.setattr(tuning, "cut_at_termination", lambda task, log: log)
    monkeypatch.setattr(tuning, "score_flight", score)
    tuning.tuning(
        Run("test", tmp_path), Silent(), methods=("indi", "mppi"), candidates=5, starts=2, seconds=6.0, seed=7
    )
    assert [len(pilots) for _, pilots, *_ in trajectory] == [12] * 3 + [6] * 3  # a third of the candidates for MPPI
    for plants, _, starts, ticks in trajectory:
        assert ticks == 300
        assert len(plants) == len(starts)
        np.testing.assert_array_equal(starts[0].p, starts[2].p)  # all candidates have the same starts
        assert np.any(starts[0].p != starts[1].p)
    result = results(tmp_path, "tuning.json")["rows"]
    np.testing.assert_allclose([row["score"] for row in result if row["method"] == "indi"], [0.3, 0.65] * 3)
    np.testing.assert_allclose([row["score"] for row in result if row["method"] == "mppi"], [0.3, 0.65, 0.3])
    for name in ("indi", "mppi"):
        ranges = tuning.BASELINES[name].ranges
        attempts = [row["settings"] for row in result if row["method"] == name][1:]
        assert all(low <= one[key] <= high for one in attempts for key, (low, high) in ranges.items())
        assert len({tuple(one.values()) for one in attempts}) == len(attempts)
    text = (tmp_path / "tuning.md").read_text()
    assert "## INDI" in text
    assert "from 2 starts (seed 7)" in text


def test_best_settings_are_listed_below_present_ones():
    section = tuning._section("indi", [{"k": 1.0}, {"k": 2.0}, {"k": 3.0}, {"k": 4.0}], np.array([0.4, 0.3, 0.1, 0.2]))
    assert section.columns == ("settings", "k", "score [m]")
    assert section.rows == (
        ("present", "1", "0.4000"), ("best", "3", "0.1000"), ("2.", "4", "0.2000"), ("3.", "2", "0.3000")
    )  # fmt: skip


def test_design_study_covers_every_choice_and_seed(tmp_path, presets, monkeypatch):
    done, log_records, trainings, watching = Imaginary(None), [], [], Watching()
    monkeypatch.setattr(design, "train_all", done.train)

    def fly(setup, policy, n, seconds, seed):
        log_records.append((policy, n, seconds, seed))
        return [f"log {seed}.{k}" for k in range(n)]

    def retrain(setup, policy, logs, key, choice, *, epochs):
        trainings.append((policy, tuple(logs), choice, epochs, jax.random.key_data(key).tolist()))
        return Retraining(f"re-{policy}", 2.0, [0.5, 0.7], 0.25)

    monkeypatch.setattr(design, "fly_batch_of_policy", fly)
    monkeypatch.setattr(design, "retrain", retrain)
    monkeypatch.setattr(design, "cut_at_termination", lambda task, log: log)
    monkeypatch.setattr(design, "score_flight", lambda setup, spec, log: flight(0.1 * (1 + spec.seed), seconds=4.0))
    design.design(Run("test", tmp_path), watching, seeds=SEEDS, starts=5, epochs=30)
    n = len(design.CHOICES)
    assert [seeds for _, seeds in done.trainings] == [SEEDS]
    for k, seed in enumerate(SEEDS):
        first, *others = log_records[k * (n + 1) : (k + 1) * (n + 1)]
        assert first == (f"policy {seed}", design.ROLLOUTS, design.ROLLOUT_S, 1000 + seed)
        assert others == [(f"re-policy {seed}", 5, design.SCORE_S, seed)] * n
        mine = trainings[k * n : (k + 1) * n]
        assert [choice for _, _, choice, *_ in mine] == list(design.CHOICES.values())
        assert all(
            (policy, logs[0], len(logs), epochs) == (f"policy {seed}", f"log {1000 + seed}.0", design.ROLLOUTS, 30)
            for policy, logs, _, epochs, _ in mine
        )
        assert {tuple(key) for *_, key in mine} == {tuple(jax.random.key_data(jax.random.key(seed)).tolist())}
    np.testing.assert_allclose(watching.shares, np.arange(2 * n) / (2 * n))
    with pytest.raises(ConfigError, match="--epochs 15 must be a positive multiple of 10"):
        design.design(Run("test", tmp_path), Silent(), epochs=15)
    result = results(tmp_path, "design.json")["rows"]
    assert [(row["model"], row["seed"], row["order"]) for row in result] == [
        (name, seed, k) for seed in SEEDS for k, name in enumerate(design.CHOICES)
    ]
    for row in result:
        np.testing.assert_allclose(row["errors"], [0.1 * (1 + row["seed"])] * 5)


def test_cost_page_has_measured_values(tmp_path, presets, monkeypatch):
    """Training excludes compilation, updates include it, a decision is in milliseconds, and DATT is trained again."""
    calls = []

    def train(setup, seed, *, reporter, stop):
        calls.append(("train", setup.preset, seed))
        return setup.new_policy(jax.random.key(0)), [1.0, 0.5, 0.2]

    def updates(setup, *, lora=False):
        calls.append(("updates", lora))
        return {"fit_s": 0.01, "update_s": 0.5, "compile_s": 7.0, "update_steps": 45_000, "window_s": 2.0 + lora}

    def datt(preset, seeds, run, reporter, *, steps):
        calls.append(("datt", list(seeds), steps, run.folder != tmp_path))
        return {0: "net"}

    monkeypatch.setattr(efficiency, "train", train)
    monkeypatch.setattr(efficiency, "updates", updates)
    monkeypatch.setattr(efficiency, "decision_s", lambda setup, controller: 0.0125)
    monkeypatch.setattr(efficiency, "train_datt", datt)
    monkeypatch.setattr(efficiency, "datt_of", lambda setup, net: net)
    efficiency.efficiency(Run("test", tmp_path), Silent(), presets=("hover/fast", "hover/paper"), datt_steps=16_384)
    small = brief_preset()
    result = {row["method"]: row for row in results(tmp_path, "efficiency.json")["rows"]}
    names = [named_presets.PRESETS[name].name for name in ("hover/fast", "hover/paper")]
    assert [each[0] for each in calls] == ["train", "updates", "updates"] * 2 + ["datt"]
    assert [lora for what, *lora in calls if what == "updates"] == [[False], [True]] * 2
    assert calls[-1] == ("datt", [0], 16_384, True)
    for name in set(names):
        row = result[name]
        assert row["steps"] == 3 * small.pretrain.num_envs * small.pretrain.horizon
        assert row["training_compile_s"] >= 0.0
        assert 0.0 <= row["training_s"] < 60.0
        assert row["decision_s"] == 0.0125
        assert "decision_s" not in result[f"{name}, LoRA"]
    line = efficiency._line({**result[names[0]], "training_s": 12.34, "training_compile_s": 3.21})
    assert line == (names[0], "120", "12.3", "3.2", "45,000", "0.0100 + 0.500", "2", "12.50")
    assert efficiency._line(result[f"{names[0]}, LoRA"]) == (
        f"{names[0]}, LoRA", "", "", "7.0", "45,000", "0.0100 + 0.500", "3", ""
    )  # fmt: skip
    assert efficiency._line(result["indi"]) == ("indi", "", "", "", "", "", "", "12.50")
    assert result["datt"]["steps"] == 16_384
