"""Tables at reduced size, and their content."""

import dataclasses
import importlib
import inspect
import itertools
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

from commands import results, retrim
from fake_flights import DT, Watching, flight, log
from helpers import at, brief_preset, tiny_preset
from retrim import ConfigError, Scenario, Setup, changed, load
from retrim.config import named_presets as presets
from retrim.config.disturbances import DISTURBANCES
from retrim.config.loading import dump, with_vehicle
from retrim.config.presets import Adapt
from retrim.evaluation.batches import CPU_LIMIT
from retrim.evaluation.flight_groups import FLIGHTS
from retrim.evaluation.study import Study, fly_all, refuse_misfits, train_all
from retrim.runkit import Run, provenance
from retrim.runkit.document import Document, TableSection
from retrim.runkit.file_digests import file_digests, preset_names, scenario_names
from retrim.runkit.reporter import Silent
from retrim_paper.datt import training as rivals
from retrim_paper.tables.levels import Levels, fly_levels
from retrim_paper.tables.reversing import METHODS, _errors, _moments, _section

# The package exports functions with the names of some of these modules.
TABLES = "retrim_paper.tables"
fast, levels, scaling = (importlib.import_module(f"{TABLES}.{name}") for name in ("fast", "levels", "scaling"))

pytestmark = pytest.mark.usefixtures("as_a_user")

LEVELS = ("none", "small", "large")


def make_untrained(preset, seeds, run, reporter):
    """Return untrained policies, for tests in which the quality of the policy does not matter."""
    policy = Setup.from_preset(preset).new_policy(jax.random.key(0))
    return Study(preset, dict.fromkeys(seeds, policy), (0.1,) * len(seeds))


def test_hover_table_by_its_command(tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "hover/fast", brief_preset())
    words = "--presets", "fast", "--seeds", "0", "3", "--seconds", "1", "--starts", "1", "--plant", "simple"
    words += "--methods", "base", "indi", "full"
    out = retrim("reproduce", "hover", *words, "--out", "t", cwd=tmp_path)
    text = (tmp_path / "t" / "hover.md").read_text()
    assert text.startswith("# Hover (Table I of the paper)\n")
    assert "training seeds 0, 3." in text
    assert " (0.128 ± 0.004) |" in text
    assert "| DATT, the paper's | (0.013 ± 0.004) | (0.009 ± 0.005) | (0.231 ± 0.004) |" in text
    assert "t/hover.md" in out
    result = results(tmp_path / "t", "hover.json")
    methods = list(dict.fromkeys(row["method"] for row in result["rows"]))
    assert methods == ["base", "indi", "full"]
    assert [(row["disturbance"], row["method"], row["n"]) for row in result["rows"]] == [
        (level, method, 2) for level in LEVELS for method in methods
    ]
    for row in result["rows"]:
        assert row["crashes"] == 2 or f"{row['mean']:.3f} ± {row['std']:.3f}" in text
    assert (tmp_path / "t" / "hover_fast.png").stat().st_size > 10_000


def test_tracking_section_has_cross_track_error_and_rows_of_paper(tmp_path, monkeypatch):
    monkeypatch.setattr(levels, "train_all", make_untrained)
    preset = brief_preset("track/preview", track={"reference": "circle"})
    scenario = Scenario(plant="simple", reference="circle")
    circle = Levels(
        "circle", preset, scenario, "x", ("base", "indi"), {"base": ("1", "2", "3"), "datt": ("4", "5", "6")}
    )
    document = Document(Run("test", tmp_path), "table", "Title", "Intro.", [0], Silent())
    fly_levels(document, [circle], starts=1, seconds=1.0)
    (section, figures), result = document.sections, results(tmp_path, "table.json")["rows"]
    assert [(row["disturbance"], row["method"], row["reference"]) for row in result] == [
        (level, method, "circle") for level in LEVELS for method in ("base", "indi")
    ]
    assert [row[0] for row in section.rows] == [
        "base policy", "... in step; cross-track", "INDI", "... in step; cross-track", "DATT, the paper's"
    ]  # fmt: skip
    assert section.rows[0][1].endswith(" (1)")
    assert section.rows[-1] == ("DATT, the paper's", "(4)", "(5)", "(6)")
    assert section.rows[1][1] == f"{result[0]['unshifted_m']:.3f}; {result[0]['cross_track_m']:.3f}"
    assert result[0]["unshifted_m"] <= result[0]["mean"] + 1e-9
    assert section.picture == tmp_path / "x.png"
    assert figures.title == "circle: large, 2 m/s² per axis"
    assert [row[0] for row in figures.rows] == ["base policy", "INDI"]
    assert "behind [s]" in figures.columns


def test_interrupted_run_is_continued(tmp_path, imagine, monkeypatch):
    """Finished sections are not repeated, and the table is equal; for a different size or different code, they are
    repeated.

    Every flight is different, so that a repeated section is distinguishable.
    """
    errors = itertools.count(1)
    done = imagine(levels, lambda spec: None if spec.method == "indi" else 0.01 * next(errors))

    def draw(flights, setup, scenario, folder, *, stem):
        (folder / f"{stem}.png").write_text(str([flight.error[-1] for flight in flights]))
        return [folder / f"{stem}.png"]

    monkeypatch.setattr(levels, "picture", draw)
    preset = brief_preset()
    one, two = (
        Levels(f"{n}", preset, Scenario(plant=plant), f"x{n}", ("base", "indi"))
        for n, plant in ((1, "simple"), (2, "bem"))
    )

    def table(*sections, starts=1):
        """Fly, and return the plants of the flights, and the table."""
        done.flights.clear()
        document = Document(Run("test", tmp_path), "table", "Title", "Intro.", [0], Silent())
        fly_levels(document, sections, starts=starts, seconds=1.0)
        setup = document.sections, results(tmp_path, "table.json")["rows"]
        return [scenarios[0].plant for _, scenarios, *_ in done.flights], setup

    flight, (kill, rows) = table(one)
    assert flight == ["simple"]
    flight, whole = table(one, two)
    assert flight == ["bem"]
    assert (whole[0][: len(kill)], whole[1][: len(rows)]) == (kill, rows)
    unfinished = tmp_path / FLIGHTS / "of_another_section.npz"
    unfinished.parent.mkdir()
    unfinished.touch()
    assert table(one, two) == ([], whole)
    assert unfinished.exists()  # a reused section keeps the flights of an unfinished one
    assert "An earlier run had made 2 of the parts" in (tmp_path / "table.md").read_text()
    flight, other = table(one, two, starts=2)
    assert flight == ["simple", "bem"]
    assert not unfinished.exists()
    assert other != whole
    (tmp_path / "x1.png").write_bytes(b"what another table of this folder drew")
    assert table(one)[0] == ["simple"]
    monkeypatch.setattr(provenance, "code", lambda: "changed")
    assert table(one)[0] == ["simple"]


def test_section_is_recomputed_for_each_changed_input(tmp_path, monkeypatch):
    base = Levels("title", brief_preset(), Scenario(plant="simple"), "x", ("indi", "datt"))
    calls = []
    monkeypatch.setattr(levels, "_fly_section", lambda *a, **k: calls.append(0) or (TableSection((), ()), []))
    monkeypatch.setattr(levels, "figures_table", lambda *_: TableSection((), ()))

    def fly(section=base, *, seeds=(0,), starts=1, seconds=1.0, datt_steps=1):
        calls.clear()
        document = Document(Run("test", tmp_path), "table", "Title", "Intro.", list(seeds), Silent())
        fly_levels(document, [section], starts=starts, seconds=seconds, datt_steps=datt_steps)
        return len(calls)

    assert [fly(), fly()] == [1, 0]
    sections = [
        dataclasses.replace(base, title="other"), dataclasses.replace(base, methods=("indi", "geometric")),
        dataclasses.replace(base, preset=brief_preset(goal=(0.0, 0.0, 2.0))),
        dataclasses.replace(base, scenario=Scenario()), dataclasses.replace(base, levels={"none": "calm"}),
    ]  # fmt: skip
    assert [fly(section) for section in sections] == [1] * len(sections)
    assert [fly(seeds=(1,)), fly(starts=2), fly(seconds=2.0), fly(datt_steps=2)] == [1] * 4
    # no training takes place here
    assert fly(dataclasses.replace(base, methods=("indi", "geometric")), datt_steps=2) == 0
    assert fly() == 0
    monkeypatch.setattr(levels, "file_digests", lambda *names: {"my_wind:breeze": "changed"})
    assert fly() == 1


def test_section_depends_on_vehicle_file_and_module(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    Path("my_quad.py").write_text("from retrim.physics.vehicle import small as make\n")
    preset = with_vehicle(load("hover/retrim"), "my_quad:make")
    assert set(file_digests(*preset_names(preset))) == set(
        file_digests(*scenario_names(Scenario(vehicle="my_quad:make")))
    )
    assert set(file_digests(*preset_names(preset))) == {"my_quad:make"}
    text = (Path(__file__).parents[2] / "examples" / "extensions" / "vehicle.toml").read_text()
    Path("my.toml").write_text(text)
    before = dump(with_vehicle(preset, "my.toml"))
    Path("my.toml").write_text(text.replace("mass = 1.2", "mass = 1.3"))
    assert dump(with_vehicle(preset, "my.toml")) != before


def test_progress_of_flights_is_complete(tmp_path):
    preset, watching = brief_preset(), Watching()
    study = Study(preset, {0: Setup.from_preset(preset).new_policy(jax.random.key(0))}, ())
    flight = fly_all(study, [Scenario(plant="simple")], Run("test", tmp_path), watching,
                    methods=("indi",), starts=2, seconds=1.0)  # fmt: skip
    assert len(flight.flights) == 2
    assert (watching.shares[0], watching.shares[-1]) == (0.0, 1.0)
    assert watching.shares == sorted(watching.shares)


def test_inconsistent_options_are_refused_before_training():
    refuse = partial(refuse_misfits, load("hover/fast"), starts=1, seconds=1.0)
    refuse([Scenario()], methods=["base"])
    with pytest.raises(ConfigError, match="no method 'best'"):
        refuse([Scenario()], methods=["base", "best"])
    with pytest.raises(ConfigError, match="method 'raptor' reads the state on board"):
        refuse([Scenario(sensors="mocap")], methods=["raptor"])
    with pytest.raises(ConfigError, match="a hover policy follows no reference"):
        refuse([Scenario(), Scenario(reference="circle")], methods=["base"])
    with pytest.raises(ConfigError, match="flights of 0 s"):
        refuse_misfits(load("hover/fast"), [Scenario()], methods=["base"], starts=1, seconds=0.0)
    with pytest.raises(ConfigError, match="0 starts"):
        refuse_misfits(load("hover/fast"), [Scenario()], methods=["base"], starts=0, seconds=1.0)


def test_section_depends_on_files_behind_its_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my_wind.py").write_text("def breeze(key, size):\n    pass\n")
    Path("lap.csv").write_text("t,x,y,z\n")
    DISTURBANCES.find("my_wind:breeze")
    names = "my_wind:breeze=3+none", "lap.csv:laps", "bem", None
    before = file_digests(*names)
    assert set(before) == {"my_wind:breeze=3", "lap.csv:laps"}
    Path("lap.csv").write_text("t,x,y,z,yaw\n")
    after = file_digests(*names)
    assert [after[name] == before[name] for name in sorted(before)] == [False, True]


@pytest.fixture
def small_datt(monkeypatch):
    for name, size in (("envs", 8), ("steps", 16)):
        monkeypatch.setitem(rivals.DATT_PPO, name, size)


@pytest.mark.usefixtures("small_datt")
def test_datt_is_trained_once_per_folder(tmp_path, monkeypatch):
    """Training is repeated for a different seed, vehicle or code, and for a damaged file."""
    text = []
    reporter = Silent()
    reporter.say = text.append
    run, preset, steps = Run("test", tmp_path), load("hover/retrim"), 4 * rivals.round_steps(1)
    first = rivals.train_datt(preset, [0, 1], run, reporter, steps=steps)
    again = rivals.train_datt(preset, [0], run, reporter, steps=steps)
    jax.tree.map(np.testing.assert_array_equal, first[0], again[0])
    assert any(np.any(a != b) for a, b in zip(jax.tree.leaves(first[0]), jax.tree.leaves(first[1]), strict=True))
    (file,) = tmp_path.glob("datt_*_seed0.safetensors")
    file.write_bytes(file.read_bytes()[:-100])
    other = rivals.train_datt(preset, [0], run, reporter, steps=steps)
    assert "made again" in text[0]
    jax.tree.map(np.testing.assert_array_equal, first[0], other[0])
    monkeypatch.setattr(provenance, "code", lambda: "changed")
    rivals.train_datt(preset, [0], run, reporter, steps=steps)
    assert len(list(tmp_path.glob("datt_*_seed0.safetensors"))) == 2
    with pytest.raises(ConfigError, match=r"DATT looks ahead in steps of 0\.06 s, which must be whole control periods"):
        rivals.check_period(changed(preset, dt=0.025))


@pytest.mark.usefixtures("small_datt")
def test_interrupted_datt_training_is_continued(tmp_path):
    """The network is equal bit for bit; if the saved state is unreadable, training starts again."""
    preset, size, text = load("hover/retrim"), rivals.DATT_PPO["envs"] * rivals.DATT_PPO["steps"], []

    def train(name, stops_at=2.0):
        run = Run("test", tmp_path / name)
        watching = Watching(lambda share: share > stops_at and run.stop.set())
        watching.say = text.append
        nets = rivals.train_datt(preset, [0], run, watching, steps=4 * size)
        return nets, [round(4 * share) for share in watching.shares]

    (whole, shares), (nothing, first) = train("whole"), train("cut", stops_at=0.4)
    assert (shares, nothing, first) == ([1, 2, 3, 4], {}, [1, 2])
    (partly,) = (tmp_path / "cut").glob("datt_*_state.safetensors")
    store = partly.read_bytes()
    again, losses = train("cut")
    assert (losses, text) == ([3, 4], ["DATT, seed 0: continues after2 of 4 updates"])
    assert not partly.exists()
    (setup,) = (tmp_path / "cut").glob("datt_*")
    setup.unlink()
    partly.write_bytes(store[:-50])
    afresh, shares = train("cut")
    assert (shares, "made again" in text[1]) == ([1, 2, 3, 4], True)
    for other in (again, afresh):
        jax.tree.map(np.testing.assert_array_equal, *(eqx.filter(n[0], eqx.is_array) for n in (whole, other)))


def test_datt_file_depends_on_vehicle_lag_steps_and_seed(tmp_path, monkeypatch):
    """A change of one of these gives a different file; the learned state continues from update to update."""
    preset, watching, calls = load("hover/retrim"), Watching(), []

    def ppo(problem, state, settings, *, steps):
        calls.append((problem, tuple(jax.random.key_data(state.key).tolist()), steps))
        for i in range(settings.updates(steps)):
            net = jax.tree.map(lambda leaf: leaf + 1.0 if eqx.is_array(leaf) else leaf, state.net)
            state = dataclasses.replace(state, net=net, made=state.made + 1)
            yield state, {"reward": i}

    monkeypatch.setattr(rivals, "ppo", ppo)
    size = rivals.DATT_PPO["envs"] * rivals.DATT_PPO["steps"]

    def weights(net):
        return jax.tree.leaves(eqx.filter(net, eqx.is_array))

    def train(preset=preset, seeds=(0,), steps=2 * size):
        return rivals.train_datt(preset, seeds, Run("test", tmp_path), watching, steps=steps)

    nets = train(seeds=(0, 3))
    assert [text for _, *text in watching.messages] == [[0.5, "reward 0.000"], [1.0, "reward 1.000"]] * 2
    assert [steps for *_, steps in calls] == [2 * size] * 2
    assert calls[0][1] != calls[1][1]
    assert any(np.any(a != b) for a, b in zip(weights(nets[0]), weights(nets[3]), strict=True))
    others = changed(preset, vehicle="large"), changed(preset, dt=0.01), changed(preset, actuator_tau=0.2)
    for other in others:
        train(other)
    train(steps=size)
    assert len(list(tmp_path.glob("datt_*_seed0.safetensors"))) == 5
    assert len(list(tmp_path.glob("datt_*_seed3.safetensors"))) == 1
    np.testing.assert_array_equal(calls[2][0].high.c, Setup.from_preset(others[0]).vehicle.command_max.c)
    assert calls[3][0].dt == 0.01
    before = len(calls)
    again = train(seeds=(0, 3))
    assert len(calls) == before
    for one, other in zip(weights(again[3]), weights(nets[3]), strict=True):
        np.testing.assert_array_equal(one, other)
    assert rivals.round_steps(1) == size
    assert rivals.round_steps(2 * size) == 2 * size
    assert rivals.round_steps(2 * size + 1) == 3 * size


@pytest.mark.usefixtures("small_datt")
def test_baselines_need_no_trained_policy(tmp_path, monkeypatch):
    """Each baseline flies once, including DATT, and no unused policy is trained."""
    monkeypatch.setattr(levels, "train_all", lambda *_: pytest.fail("a policy is trained"))
    section = Levels(
        "x", load("hover/retrim"), Scenario(plant="simple"), "x", ("indi", "datt"), levels={"none": "calm"}
    )
    document = Document(Run("test", tmp_path), "table", "Title", "Intro.", [0], Silent())
    fly_levels(document, [section, dataclasses.replace(section, methods=())], starts=1, seconds=1.0,
               datt_steps=4 * rivals.round_steps(1))  # fmt: skip
    rows = results(tmp_path, "table.json")["rows"]
    assert [(row["method"], row["n"]) for row in rows] == [("indi", 1), ("datt", 1)]
    assert [row[0] for row in document.sections[0].rows] == ["INDI", "DATT"]


def test_fast_table_accepts_trajectory_file(tmp_path, monkeypatch):
    """The race line of the examples is at the limits of the kingfisher."""
    line = Path(__file__).parents[2] / "examples" / "race.csv"
    preset = brief_preset("track/fast", track={"reference": "circle=8", "gravity_copies": 0})
    setup = Setup.from_preset(preset, str(line))
    assert setup.limits_exceeded() is None
    speeds = np.linalg.norm(at(setup.flight_task.reference, np.linspace(3.0, 10.0, 50)).v, axis=1)
    assert 8.0 < max(speeds) < 12.0
    monkeypatch.setattr(levels, "train_all", make_untrained)
    section = dataclasses.replace(fast._section(preset, str(line), "simple", ("base",)), stem="race")
    document = Document(Run("test", tmp_path), "table", "Title", "Intro.", [0], Silent())
    fly_levels(document, [section], starts=1, seconds=1.0)
    result = results(tmp_path, "table.json")["rows"]
    assert [(row["disturbance"], row["vehicle"]) for row in result] == [
        (level, "kingfisher") for level in ("none", "wind=4", "large")
    ]
    assert document.sections[0].columns[2] == "wind of 4 m/s"


def test_interrupted_table_stops_flights(tmp_path):
    run = Run("test", tmp_path)
    run.stop.set()
    assert train_all(tiny_preset(), [0, 1], run, Silent()).policies == {}
    nothing = fly_all(Study(tiny_preset(), {0: "policy"}, ()), [Scenario()], run, Silent(), starts=1, seconds=1.0)
    assert (nothing.flights, nothing.interrupted) == ([], True)
    document = Document(run, "table", "Title", "Intro.", [0], Silent())
    fly_levels(document, [Levels("", tiny_preset(), Scenario(), "x")] * 2, starts=1, seconds=1.0)
    assert document.sections == []
    assert "Interrupted: incomplete." in (tmp_path / "table.md").read_text()
    assert results(tmp_path, "table.json")["interrupted"]


def test_training_of_table_ends_soon_after_stop(tmp_path):
    run = Run("test", tmp_path)
    watching = Watching(lambda share: share and run.stop.set())
    preset = brief_preset(pretrain={"num_updates": 30})
    assert train_all(preset, [0, 1], run, watching).policies == {}
    nothing, first = watching.shares
    assert nothing == 0.0 < first < 1.0


def test_every_section_is_written_when_added(tmp_path):
    document = Document(Run("test", tmp_path), "table", "Title", "Intro.", [0, 4], Silent(), {"more": 1})
    document.add(TableSection(("a", "b"), (("1", "2"),), "First", "About it."), [{"x": 1}])
    assert "## First\n\nAbout it.\n\n| a | b |\n|---|---|\n| 1 | 2 |\n" in (tmp_path / "table.md").read_text()
    document.add(TableSection((), (), "Second", "Left out."), [{"x": 2}])
    result = results(tmp_path, "table.json")
    assert (result["rows"], result["seeds"], result["more"]) == ([{"x": 1}, {"x": 2}], [0, 4], 1)
    assert (tmp_path / "table.md").read_text().count("| a | b |") == 1
    assert document.run.pages == [tmp_path / "table.md"]


def test_page_begins_with_results_and_ends_with_provenance(tmp_path):
    document = Document(Run("test", tmp_path), "table", "Title", "Intro.", [0, 4], Silent())
    document.add(TableSection(("a",), (("1",),), "First"))
    page = (tmp_path / "table.md").read_text()
    results_only, _, provenance = page.partition("## Provenance\n\n")
    assert results_only == "# Title\n\nIntro.\n\n## First\n\n| a |\n|---|\n| 1 |\n\n"
    for fact in ("training seeds 0, 4", "Command: `", "Compiling"):
        assert fact in provenance
        assert fact not in results_only


def test_errors_around_reversals_and_updates(tmp_path):
    """Reversals occur every 15 s; updates start every 5 s and take effect a second later."""
    moments, updates = _moments(Adapt(), 60.0)
    assert updates == [1, 2, 3]
    np.testing.assert_allclose(moments, [[15, 16, 21, 26, 30], [30, 31, 36, 41, 45], [45, 46, 51, 56, 60]])
    t = DT * np.arange(3001)
    ramp = dataclasses.replace(flight(t, flight=log(t=t)))
    # fifty ticks, the last one at that moment
    np.testing.assert_allclose(_errors(ramp, moments), moments - 0.49, atol=1e-9)
    errors = {method: [] for method in METHODS} | {"full": [_errors(ramp, moments)] * 2}
    section = _section(errors, moments, updates, "", tmp_path / "x.png")
    assert len(section.rows) == 3 * len(METHODS)
    assert section.rows[0] == ("reversed at 15 s, base policy", *["-"] * 5)
    (adapted_policy,) = [row for row in section.rows if row[0] == "reversed at 15 s, **adapted**"]
    assert adapted_policy[1:3] == ("14.510 ± 0.000", "15.510 ± 0.000")
    assert len(section.columns) == len(adapted_policy)
    often, updates = _moments(Adapt(update_every=0.5, update_latency=0.1), 60.0)
    assert updates == [1, 2, 4, 8, 16, 30]
    np.testing.assert_allclose(often[0], [15, 15.1, 15.6, 16.1, 17.1, 19.1, 23.1, 30])
    np.testing.assert_allclose(_errors(ramp, often, 0.5), often - 0.24, atol=1e-9)


@pytest.mark.parametrize("name", ["hover", "track", "phase", "vision", "fast", "transfer", "raptor"])
def test_table_uses_all_options(name, tmp_path, monkeypatch):
    """Plant, methods, seeds, starts and length reach the flights."""
    table = importlib.import_module(f"{TABLES}.{name}")
    plan = []
    monkeypatch.setattr(table, "fly_levels", lambda document, sections, **how: plan.append((document, sections, how)))
    calls = {"methods": ("indi",), "seeds": (3, 4), "starts": 2, "seconds": 7.0}
    setup = getattr(table, name)
    options = inspect.signature(setup).parameters
    calls |= {key: value for key, value in (("plant", "simple"), ("datt_steps", 5)) if key in options}
    setup(Run("test", tmp_path), Silent(), **calls)
    assert plan
    for document, sections, how in plan:
        assert (document.name, tuple(document.seeds)) == (name, (3, 4))
        assert how == {key: calls[key] for key in ("starts", "seconds", "datt_steps") if key in calls}
        assert sections
        assert len({section.stem for section in sections}) == len(sections)  # no plot is overwritten
        for section in sections:
            assert {scenario.plant for scenario in section.scenarios} == {calls.get("plant", "bem")}
            assert tuple(section.methods) in (("indi",), ())
        assert any(section.methods for section in sections)


def test_raptor_flies_with_policies_trained_for_its_vehicles(tmp_path, monkeypatch):
    table, plan = importlib.import_module(f"{TABLES}.raptor"), []
    monkeypatch.setattr(table, "fly_levels", lambda document, sections, **how: plan.extend(sections))
    table.raptor(Run("test", tmp_path), Silent(), vehicles=("kingfisher", "large"))
    assert [(s.preset.vehicle, s.preset.task, s.scenario.reference) for s in plan] == [
        (vehicle, task, reference)
        for vehicle in ("kingfisher", "large") for task, reference in (("hover", None), ("track", "figure8"))
    ]  # fmt: skip
    for section in plan:
        assert tuple(section.methods) == table.METHODS
        assert section.levels == table.DISTURBANCES
        assert section.drawn_methods == ("raptor", "full")
        assert section.title.endswith(section.preset.vehicle)


def test_scaling_is_limited_by_flights_then_network_then_scheduler():
    """For a million flights, time decreases with the number of machines down to that of their shared parts."""

    def longest(run_s, size):
        rows = [{"flights": 1000, "run_s": run_s, "flight_bytes": size, "compile_s": 60.0}]
        section = scaling._on_machines(rows)
        return [(int(m), time, what) for m, time, what in section.rows]

    flying = longest(run_s=1e6, size=1)
    assert {what for _, _, what in flying} == {"flying"}
    assert flying[0][1] == f"{(1e9 + 60) / 86_400:.1f} days"
    assert flying[-1][1] == f"{(1e6 + 60) / 86_400:.1f} days"  # a thousand machines
    network = longest(run_s=1.0, size=scaling.LINK)
    assert {what for _, _, what in network} == {"the client's network"}
    assert {time for _, time, _ in network} == {f"{(1e6 + 60) / 86_400:.1f} days"}
    scheduler = longest(run_s=1e-9, size=0)
    assert {what for _, _, what in scheduler} == {"the scheduler"}
    assert {time for _, time, _ in scheduler} == {f"{60 + 1e6 / CPU_LIMIT * scaling.JOB_S:.0f} s"}
    first, *others = longest(run_s=1.1, size=scaling.LINK / 1000)
    assert first[2] == "flying"
    assert {what for *_, what in others} == {"the client's network"}


def test_steps_of_datt_have_bounds():
    for steps in (1, 10**10):
        rivals.check_steps(steps)
    for steps in (0, 10**10 + 1):
        with pytest.raises(ConfigError, match=f"--datt-steps {steps} must be between 1 and 10,000,000,000"):
            rivals.check_steps(steps)
