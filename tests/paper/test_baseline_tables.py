"""Tables of the baselines' settings and of the design study, at reduced size."""

import contextlib
import importlib
import inspect
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from commands import results, retrim
from helpers import brief_preset, random_command, random_state, tiny_preset
from retrim import ConfigError, PlantError, Setup
from retrim.config import load, named_presets
from retrim.control.baselines import BASELINES
from retrim.evaluation import compute_cost as effort
from retrim.runkit import Run, provenance
from retrim.runkit.reporter import Silent
from retrim_paper import design, tables
from retrim_paper.cli.reproduce import COMMANDS

# The package exports functions with the names of these modules.
NAMES = ("design", "efficiency", "everything", "phase", "quick", "tuning", "vision")
design_table, efficiency_table, everything, phase_table, quick, tuning_table, vision_table = (
    importlib.import_module(f"retrim_paper.tables.{n}") for n in NAMES
)

pytestmark = pytest.mark.usefixtures("as_a_user")


def test_every_baseline_has_a_range_for_every_setting():
    for baseline in BASELINES.values():
        assert set(baseline.settings) == set(baseline.settings_from_keypoints) == set(baseline.ranges)
        assert all(0.0 < low < high for low, high in baseline.ranges.values())


@pytest.mark.parametrize(("page", "field"), [("tuning", "settings"), ("tuning_keypoints", "settings_from_keypoints")])
def test_settings_are_those_of_published_search(page, field):
    rows = json.loads((Path(__file__).parents[2] / "docs" / "results" / f"{page}.json").read_text())["rows"]
    for name, baseline in BASELINES.items():
        best = min((row for row in rows if row["method"] == name), key=lambda row: row["score"])
        assert getattr(baseline, field) == {key: float(f"{value:.3g}") for key, value in best["settings"].items()}


@pytest.mark.parametrize(
    ("preset", "field"), [("hover/fast", "settings"), ("vision/retrim", "settings_from_keypoints")]
)
def test_baseline_settings_match_its_observation(preset, field):
    setup = Setup.from_preset(load(preset))
    assert all(each.settings_for(setup.flight_task) is getattr(each, field) for each in BASELINES.values())


@pytest.fixture
def one_condition(monkeypatch):
    """Keep one condition: on a reference, in wind, with measurement noise."""
    monkeypatch.setitem(tuning_table.CONDITIONS, "state", tuning_table.CONDITIONS["state"][2:])


@pytest.mark.usefixtures("one_condition")
def test_search_of_settings_by_its_command(tmp_path):
    words = "--methods", "indi", "--candidates", "3", "--starts", "1", "--seconds", "4", "--plant", "simple"
    out = retrim("reproduce", "tuning", *words, "--out", "t", cwd=tmp_path)
    assert "| present |" in out
    rows = json.loads((tmp_path / "t" / "tuning.json").read_text())["rows"]
    assert [row["method"] for row in rows] == ["indi"] * 4
    assert rows[0]["settings"] == dict(BASELINES["indi"].settings)
    for row in rows[1:]:
        assert all(low <= row["settings"][name] <= high for name, (low, high) in BASELINES["indi"].ranges.items())
    assert 0.0 < rows[0]["score"] < 0.1
    assert "no baseline with settings" in retrim("reproduce", "tuning", "--methods", "base", cwd=tmp_path, code=1)


@pytest.mark.parametrize(("rotors", "own"), [(False, True), (True, True), (True, False)])
def test_residual_gradients_do_not_change_values(rotors, own, key):
    setup = Setup.from_preset(tiny_preset())
    x, u = random_state(key, 0.3), random_command(key)

    def end(x, backprop):
        model = design.design_dynamics(setup, lambda x, u: -0.5 * x.v, design.Choice(rotors, own, backprop))
        return jnp.sum(model.state(model.step(model.init(x), u, jnp.zeros(3))).v)

    without, through = (jax.jit(jax.value_and_grad(lambda x, b=b: end(x, b)))(x) for b in (False, True))
    np.testing.assert_allclose(without[0], through[0], rtol=1e-6)
    np.testing.assert_allclose(through[1].v - without[1].v, -0.5 * 0.02, rtol=0.05)


def test_gradient_is_that_of_model_or_point_mass(key):
    setup, x, u = Setup.from_preset(tiny_preset()), random_state(key, 0.3), random_command(key)

    def jacobian(choice):
        model = design.design_dynamics(setup, lambda x, u: jnp.zeros(3), choice)
        return jax.jit(jax.jacobian(lambda v: model.state(model.step(model.init(x), v, jnp.zeros(3))).v))(u)

    simple, own, own_gradient = (
        jacobian(design.Choice(*c, False)) for c in ((False, True), (True, True), (True, False))
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), own_gradient, simple)
    assert float(jnp.abs(own.c - simple.c).max()) > 0.1 * float(jnp.abs(simple.c).max())  # motors have a lag


def test_design_study_rows_cover_all_seeds_and_flights():
    """Times are medians relative to the first trained model; a crash is counted and excluded from the means."""
    one, other = list(design.CHOICES)[:2]

    def row(model, order, epoch_s, errors, compile_s=1.0):
        return {"model": model, "order": order, "epoch_s": epoch_s, "errors": errors, "compile_s": compile_s,
                "residual_rms": 0.25 * (order + 1)}  # fmt: skip

    rows = [
        row(one, 0, [1.0, 2.0, 3.0], [0.1, 0.3], 4.0), row(other, 1, [8.0, 8.0], [0.5, np.nan]),
        row(one, 0, [2.0], [0.2, 0.2]),
    ]  # fmt: skip
    section = design_table._section(rows)
    assert section.rows == (
        (one, "2000.0 (1000.0 to 3000.0)", "1.00", "4.0", "0.250", "0.200 ± 0.082"),
        (other, "8000.0 (8000.0 to 8000.0)", "4.00", "1.0", "0.500", "0.500 ± 0.000, 1 crashed"),
    )
    (gap,) = design_table._section([row(one, 0, [1.0], [np.nan])]).rows
    assert gap[-1] == "all crashed"
    assert section.about == f"{design_table.PAPER[:1].upper()}{design_table.PAPER[1:]}."


def test_retraining_continues_from_policy():
    setup = Setup.from_preset(tiny_preset())
    policy = setup.new_policy(random.key(0))
    logs = design.fly_batch_of_policy(setup, policy, 2, 1.0, 0)
    result = design.retrain(setup, policy, logs, random.key(1), design.CHOICES["low fidelity, res-fwd"],
                            fit_epochs=20, epochs=10, envs=4)  # fmt: skip
    assert result.residual_rms < 3.0
    assert any(np.any(a.weight != b.weight) for a, b in zip(result.policy.layers, policy.layers, strict=True))


def test_interrupted_tables_are_continued(tmp_path, monkeypatch):
    """A finished table is not repeated, an interrupted one is, and with --quick all are."""
    setup, dying = [], [True]

    def one(run, reporter, *, size=0):
        assert run.policy_folder == tmp_path  # networks of DATT are shared by all tables
        setup.append(("one", size))

    def two(run, reporter, *, size=0):
        setup.append(("two", size))
        if dying.pop():
            raise RuntimeError("killed")
        dying.append(False)

    monkeypatch.setattr(everything, "PLAN", tuple((make, "Table", {"size": 9}) for make in (one, two)))
    for name in ("one", "two"):
        monkeypatch.setitem(quick.QUICK, name, {"size": 1})
    dying.insert(0, False)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.md").touch()
    table = lambda quick: everything.everything(Run("test", tmp_path), Silent(), quick=quick)  # noqa: E731
    with pytest.raises(RuntimeError, match="killed"):
        table(False)
    table(False)
    assert setup == [("one", 9), ("two", 9), ("two", 9)]
    assert "[two](two/two.md)" in (tmp_path / "everything.md").read_text()
    table(True)
    assert setup[3:] == [("one", 1), ("two", 1)]
    table(False)  # a quick run writes no page of the complete table
    assert setup[5:] == []
    assert "quick look" not in (tmp_path / "everything.md").read_text()  # it has its own overview
    assert "quick look" in (tmp_path / "everything_quick.md").read_text()
    (tmp_path / "one" / "one.md").unlink()
    table(False)
    assert setup[5:] == [("one", 9)]


def test_time_of_interrupted_table_is_counted_and_of_killed_table_unknown(tmp_path, monkeypatch):
    ends = iter(("interrupted", "interrupted", "done", "killed", "interrupted", "done"))

    def one(run, reporter):
        run.watch = SimpleNamespace(total_s=60.0, sentence=str)
        end = next(ends)
        if end == "killed":
            raise RuntimeError
        if end == "interrupted":
            run.stop.set()
        run.write_text("one.md", end)

    monkeypatch.setattr(everything, "PLAN", ((one, "Table", {}),))

    def capture():
        with contextlib.suppress(RuntimeError):
            everything.everything(Run("test", tmp_path), Silent())
        return (tmp_path / "everything.md").read_text().count("| 3.0 |"), results(tmp_path, "everything.json")["rows"]

    capture(), capture()
    assert capture() == (2, [{"table": "one", "what": "Table", "page": "one/one.md", "s": 180.0, "at_least": False}])
    assert capture()[0] == 2  # the table is computed
    (tmp_path / "one" / "one.md").unlink()
    capture(), capture()
    (row,) = capture()[1]
    assert (row["s"], row["at_least"]) == (120.0, True)
    assert "| at least 2.0 |" in (tmp_path / "everything.md").read_text()


def test_page_of_different_code_is_recomputed(tmp_path, monkeypatch):
    """This also holds if the present code made the table earlier, since the folder contains one page."""
    codes = iter(("a", "a", "b", "a"))

    def one(run, reporter):
        run.write_text("one.md", provenance.code())

    monkeypatch.setattr(everything, "PLAN", ((one, "Table", {}),))
    for code in codes:
        monkeypatch.setattr(provenance, "code", lambda code=code: code)
        everything.everything(Run("test", tmp_path), Silent())
        assert (tmp_path / "one" / "one.md").read_text() == code


def test_formulations_differ_as_stated(tmp_path, monkeypatch):
    sections = []
    monkeypatch.setattr(phase_table, "fly_levels", lambda document, result, **_: sections.extend(result))
    phase_table.phase(Run("test", tmp_path), Silent(), references=("circle",))
    presets = [section.preset for section in sections]
    assert {section.scenario.reference for section in sections} == {presets[0].track.reference} == {"circle"}
    assert [preset.track.observation for preset in presets] == ["blind", "relative", "relative", "both"]
    assert [(preset.delay_ticks, preset.command_history) for preset in presets] == [(0, 0), (0, 0), (1, 2), (0, 0)]
    assert [Setup.from_preset(preset).env.task.observation.size for preset in presets] == [15, 15, 23, 21]
    assert presets[3] == load("track/paper")
    for wrong in ({"readings": ("printd",)}, {"references": ("line",)}):
        with pytest.raises(ConfigError, match="there are"):
            phase_table.phase(Run("test", tmp_path), Silent(), **wrong)


def test_table_without_its_package_is_reported_as_skipped(tmp_path, monkeypatch):
    def lacking(run, reporter):
        raise PlantError("method 'raptor' needs the package")

    monkeypatch.setattr(everything, "PLAN", ((lacking, "beside RAPTOR", {}),))
    everything.everything(Run("test", tmp_path), Silent())
    assert "lacking, left out: method 'raptor' needs the package" in (tmp_path / "everything.md").read_text()


def test_planned_tables_have_planned_options():
    for make, _, full in everything.PLAN:
        assert {*full, *quick.QUICK.get(make.__name__, {})} <= set(inspect.signature(make).parameters), make.__name__
    assert "all" in COMMANDS


def test_resumable_command_has_fixed_folder():
    """A quick run has a separate folder; otherwise it would overwrite the complete pages."""
    setup = {make.__name__: make for make in (*tables.TABLES, tables.everything)}
    assert set(quick.PIECES) <= set(setup)
    folders = {str(quick.folder_of(setup[name], quick=look)) for name in quick.PIECES for look in (False, True)}
    assert len(folders) == 2 * len(quick.PIECES) - 1  # the command for all tables has one folder for quick runs
    assert str(quick.folder_of(tables.everything)) == "runs/reproduce-all"
    assert quick.folder_of(tables.design) is None
    assert "runs/reproduce-hover, where the command resumes by default" in quick.help_of(tables.hover)


def test_quick_options_of_every_table_exist():
    setup = {make.__name__: make for make in tables.TABLES}
    of_paper = {"hover", "track", "vision", "reversing", "design", "efficiency", "transfer"}
    assert of_paper <= set(quick.QUICK) <= set(setup)
    for name, smaller in quick.QUICK.items():
        options = {each.name: each.default for each in quick.options_of(setup[name])}
        assert options["quick"] is False
        assert all(each.annotation is not inspect.Parameter.empty for each in quick.options_of(setup[name]))
        assert set(smaller) <= set(options), name
        assert any(options[option] != value for option, value in smaller.items()), name


@pytest.mark.usefixtures("one_condition")
def test_quick_run_reduces_only_defaults(tmp_path):
    """The document states that it is a quick run."""
    choice = {"seconds": 30.0, "starts": 8, "seeds": (4,), "quick": True}
    options, remark = quick.quick_options(tables.hover, choice)
    assert (options["seconds"], options["starts"], options["seeds"]) == (12.0, 2, (4,))
    assert "not to quote" in remark
    assert quick.quick_options(tables.hover, {**choice, "quick": False}) == (
        {k: choice[k] for k in options if k in choice},
        "",
    )
    calls = inspect.signature(tables.hover).parameters
    names = {**{name: calls[name].default for name in calls if name not in ("run", "reporter")}, "quick": True}
    assert quick.quick_options(tables.hover, names)[0]["starts"] == 2
    assert quick.quick_options(tables.hover, names, ["--starts", "8"])[0]["starts"] == calls["starts"].default
    words = "--methods", "indi", "--candidates", "3", "--seconds", "4", "--plant", "simple", "--quick"
    retrim("reproduce", "tuning", *words, "--out", "t", cwd=tmp_path)
    assert remark in (tmp_path / "t" / "tuning.md").read_text()
    assert len(json.loads((tmp_path / "t" / "tuning.json").read_text())["rows"]) == 4
    assert "unrecognized" in retrim("reproduce", "buses", "--quick", cwd=tmp_path, code=2).lower()


def test_cost_table_by_its_command(tmp_path, monkeypatch):
    small = brief_preset()
    monkeypatch.setitem(named_presets.PRESETS, "hover/fast", small)
    monkeypatch.setattr(effort, "DECISIONS", 3)
    monkeypatch.setattr(effort, "TIMED_RUNS", 2)
    monkeypatch.setattr(efficiency_table, "BASELINES", {"indi": BASELINES["indi"]})
    monkeypatch.setattr(efficiency_table, "train_datt", lambda *_, **__: {})
    words = "--presets", "hover/fast", "--datt-steps", "1"
    out = retrim("reproduce", "efficiency", *words, "--out", "e", cwd=tmp_path)
    rows = {row["method"]: row for row in json.loads((tmp_path / "e" / "efficiency.json").read_text())["rows"]}
    assert {"hover/fast", "hover/fast, LoRA", "indi"} == set(rows)
    assert rows["hover/fast"]["steps"] == 10 * small.pretrain.num_envs * 20
    assert all(row["decision_s"] > 0 for name, row in rows.items() if "LoRA" not in name)
    assert "DATT, the paper's" in out


def test_vision_methods_depend_on_preset(tmp_path):
    """Baselines need a pose filter, and an observer needs a frame."""
    flyable = {name: set(vision_table._flyable(named_presets.PRESETS[name])) for name in vision_table.TITLES}
    assert set(BASELINES) | {"base-do", "lora"} <= flyable["vision/retrim"]
    assert set(BASELINES) <= flyable["vision/occluded"]
    assert "base-do" not in flyable["vision/occluded"]
    assert flyable["vision/paper"] == flyable["vision/ideal"] == {"base", "full", "lora"}
    text = retrim("reproduce", "vision", "--methods", "base", "datt", cwd=tmp_path, code=1)
    assert "--methods datt: it is trained by a measured state" in text
    text = retrim("reproduce", "vision", "--presets", "vision/paper", "--methods", "indi", cwd=tmp_path, code=1)
    assert "method 'indi' needs the state, and preset 'vision/paper' observes keypoints" in text


def test_retraining_continues_over_chunks_and_discards_first(monkeypatch):
    """The first chunk compiles: its result is discarded, and its time is reported separately."""
    setup = Setup.from_preset(tiny_preset())
    policy = setup.new_policy(random.key(0))
    logs = design.fly_batch_of_policy(setup, policy, 2, 1.0, 0)
    calls = []

    def chunk(state, env, key, optimiser, updates, envs):
        calls.append((state, env, random.key_data(key).tolist(), updates, envs))
        params = jax.tree.map(lambda leaf: leaf + 1.0, state.policy.params)
        return design.PolicyState(state.policy.with_params(params), state.optimiser), jnp.zeros(updates)

    monkeypatch.setattr(design, "train_chunk", chunk)
    result = design.retrain(setup, policy, logs, random.key(1), design.CHOICES["low fidelity, res-fwd"],
                            fit_epochs=5, epochs=30, envs=6)  # fmt: skip
    assert [(updates, envs) for *_, updates, envs in calls] == [(design.CHUNK, 6)] * 4
    assert len({tuple(key) for _, _, key, *_ in calls}) == 4
    begins = [float(state.policy.layers[0].weight[0, 0] - policy.layers[0].weight[0, 0]) for state, *_ in calls]
    np.testing.assert_allclose(begins, [0.0, 0.0, 1.0, 2.0], atol=1e-6)
    assert float(result.policy.layers[0].weight[0, 0] - policy.layers[0].weight[0, 0]) == pytest.approx(3.0, abs=1e-6)
    assert len(result.epoch_s) == 3
    assert all(0.0 < seconds < 1.0 for seconds in result.epoch_s)
    env = calls[0][1]
    assert (env.task, float(env.delay)) == (setup.env.task, float(setup.env.delay))
