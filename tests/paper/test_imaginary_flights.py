"""Requested training and flights of pages, and the content of the pages; the tests set the error of every flight."""

import importlib
import json

import numpy as np
import pytest

from commands import results
from helpers import brief_preset
from retrim import ConfigError, PlantError, Scenario
from retrim.evaluation.executor import Flights
from retrim.runkit import Run
from retrim.runkit.document import Document
from retrim.runkit.reporter import Silent
from retrim_paper.ablation_options import CONTROL, OFF, ON

# The package exports functions with the names of these modules.
NAMES = ("ablation", "gauntlet", "levels", "plants", "reversing")
ablation, gauntlet, levels, plants, reversing = (
    importlib.import_module(f"retrim_paper.tables.{name}") for name in NAMES
)
SEEDS, STARTS, SECONDS = (0, 3), 2, 30.0


@pytest.mark.parametrize(("cores", "together"), [(2, (("step",), ("none",))), (16, (("step", "none"),))])
def test_gauntlet_flies_every_condition_and_shows_means_and_worst(
    tmp_path, imagine, pictures, monkeypatch, cores, together
):
    """Methods are in the given order; a crash makes the mean infinite and is counted.

    With many cores, flights run together.
    """
    ramp, make = np.linspace(0.0, 3.0, 1501), Scenario.make

    def installed(scenario, *words, **more):
        if scenario.disturbance == "large":
            raise PlantError("its package is not here")
        return make(scenario, *words, **more)

    def error(spec):
        if spec.method == "indi":
            return None if (spec.seed, spec.start) == (3, 1) else 0.2
        return ramp if spec.start else 0.1 * (1 + spec.seed)

    monkeypatch.setattr(Scenario, "make", installed)
    monkeypatch.setattr(gauntlet, "cores", lambda: cores)
    message = pictures(gauntlet, "heat_map", "panel_figure")
    monkeypatch.setattr(gauntlet.plots, "save", lambda figure, folder, stem: (folder / f"{stem}.png", folder / stem))
    done = imagine(gauntlet, error)
    names, methods = ("step", "large", "none"), ("indi", "base")
    gauntlet.gauntlet(
        Run("test", tmp_path), Silent(), only=names, methods=methods, seeds=SEEDS, seconds=SECONDS, starts=STARTS
    )
    assert [seeds for _, seeds in done.trainings] == [SEEDS]
    assert [(tuple(each.disturbance for each in s), *how) for _, s, *how in done.flights] == [
        (each, methods, STARTS, SECONDS) for each in together
    ]
    result = {(row["scenario"], row["method"], row["metric"]): row for row in results(tmp_path, "results.json")["rows"]}
    assert list(dict.fromkeys(key[0] for key in result)) == ["step", "none"]
    assert {row["n"] for row in result.values()} == {4}
    for name in ("step", "none"):
        assert {result[name, "base", metric]["crashes"] for metric in gauntlet.METRICS} == {0}
        for metric in gauntlet.METRICS:
            crashes = result[name, "indi", metric]
            assert (crashes["value"], crashes["worst"], crashes["crashes"]) == (None, None, 1)
        # the last 2 s of a ramp of 0.1 m/s end at 3 m; the first starts of two seeds have 0.1 and 0.4 m
        assert result[name, "base", "steady"]["value"] == pytest.approx((0.1 + 0.4 + 2 * 2.9) / 4, abs=2e-3)
        assert result[name, "base", "late"]["value"] == pytest.approx((0.1 + 0.4 + 2 * 1.75) / 4, abs=2e-3)
        assert result[name, "base", "peak"]["value"] == pytest.approx((0.1 + 0.4 + 2 * 3.0) / 4)
        assert result[name, "base", "peak"]["worst"] == pytest.approx(3.0)
    text = (tmp_path / "gauntlet.md").read_text()
    assert "| step | INDI | ∞ (∞) | ∞ (∞) | ∞ (∞) | ∞ (∞) | ∞ (∞) | 1 of 4 |" in text
    assert "| none | base policy | 1.575 (2.901) | 1.000 (1.750) | 1.625 (3.000) | ∞ (∞) | ∞ (∞) | 0 of 4 |" in text
    assert text.index("| step | INDI") < text.index("| step | base policy") < text.index("| none | INDI")
    assert "by seed: 1.0, 4.0 mm. Left out: large: its package is not here" in text
    assert text.startswith("# The gauntlet\n")
    ((titles, lines, columns, values), _), = message["heat_map"]  # fmt: skip
    assert titles == ["late [m]", "peak [m]", "recovery_2cm [s]"]
    assert (list(lines), tuple(columns), np.shape(values)) == (["step", "none"], methods, (3, 2, 2))
    np.testing.assert_array_equal(values[:, :, 0], np.inf)
    np.testing.assert_allclose(values[1, :, 1], result["none", "base", "peak"]["value"])
    # the best and the worst flight of the last method, next to the other method from the same start
    ((_, (best, worst)), _), = message["panel_figure"]  # fmt: skip
    assert (best.title, worst.title) == ("best: step, start 0", "worst: none, start 1")
    assert [curve.label for curve in best.curves] == ["indi", "base"]
    np.testing.assert_allclose(best.curves[1].y, 100.0)  # [mm]
    np.testing.assert_allclose(worst.curves[1].y[-1], 3000.0)


def test_fault_gauntlet_compares_adaptation_with_base(tmp_path, imagine, pictures, monkeypatch):
    """Adapted flights crash in one condition where the base policy survives, and are equally good in the other."""
    pictures(gauntlet, "heat_map", "panel_figure")
    monkeypatch.setattr(gauntlet.plots, "save", lambda figure, folder, stem: (folder / f"{stem}.png", folder / stem))
    done = imagine(gauntlet, lambda spec: None if (spec.scenario.fault, spec.method) == ("late", "full") else 0.1)
    run, methods = Run("test", tmp_path), ("base", "base-do", "full")
    gauntlet.gauntlet(
        run, Silent(), only=("late", "gaps"), methods=methods, starts=STARTS, seconds=SECONDS, faults=True
    )
    assert [tuple(each.fault for each in s) for _, s, *_ in done.flights] in (
        [("late",), ("gaps",)],
        [("late", "gaps")],
    )
    promise = json.loads((tmp_path / "results.json").read_text())["promise"]
    assert [(row["scenario"], row["crashed_although_base_survived"], row["holds"]) for row in promise] == [
        ("late", STARTS, False), ("gaps", 0, True),
    ]  # fmt: skip
    text = (tmp_path / "faults.md").read_text()
    assert text.startswith("# Faults of measurements and vehicle\n")
    assert "![faults](faults.png)" in text
    with pytest.raises(ConfigError, match="--faults needs a preset for hover and ideal sensors"):
        gauntlet.gauntlet(run, Silent(), sensors="rough", faults=True)


def test_gauntlet_without_installed_plants_is_refused_before_training(tmp_path, imagine, monkeypatch):
    def lacking(*_, **__):
        raise PlantError("its package is not here")

    monkeypatch.setattr(Scenario, "make", lacking)
    done = imagine(gauntlet, lambda spec: 0.0)
    with pytest.raises(PlantError, match="its package is not here"):
        gauntlet.gauntlet(Run("test", tmp_path), Silent(), only=("none", "step"), methods=("base",), starts=1)
    assert not done.trainings


def test_gauntlet_reports_recovery_from_each_change(tmp_path, imagine, pictures, monkeypatch):
    """The step is at 8 s; an error within 2 cm one second later means a recovery time of one second."""
    t = 0.02 * np.arange(1501)
    pictures(gauntlet, "heat_map", "panel_figure")
    monkeypatch.setattr(gauntlet.plots, "save", lambda *_: (tmp_path / "x.png", tmp_path / "x.svg"))
    imagine(gauntlet, lambda spec: np.where((t >= 7.99) & (t < 8.99), 0.03, np.where(t < 0.49, 0.1, 0.0)))
    gauntlet.gauntlet(Run("test", tmp_path), Silent(), only=("none", "step"), methods=("base",), starts=1)
    result = {(row["scenario"], row["metric"]): row["value"] for row in results(tmp_path, "results.json")["rows"]}
    assert result["step", "recovery_2cm"] == pytest.approx(1.0)
    assert result["step", "recovery_5cm"] == 0.0
    assert result["none", "recovery_2cm"] == pytest.approx(9.0)  # without a change, recovery is counted from the start
    assert result["none", "recovery_5cm"] == pytest.approx(0.5)


def test_each_plant_has_section_with_column_per_method(tmp_path, imagine, monkeypatch):
    setup = (
        ("a", Scenario(plant="simple"), ("none", "large")), ("b", Scenario(vehicle="large"), ("wind",)),
        ("c", Scenario(plant="mujoco"), ("none",)),
    )  # fmt: skip
    monkeypatch.setattr(plants, "groups", lambda: setup)
    shares = {method: 0.1 * (1 + k) for k, method in enumerate(plants.METHODS)}

    def error(spec):
        if spec.scenario.disturbance == "large" and spec.method == "full":
            return None
        return shares[spec.method] + spec.start

    done = imagine(plants, error)
    plants.plants(Run("test", tmp_path), Silent(), plant=("simple", "bem"), seeds=SEEDS, seconds=SECONDS, starts=STARTS)
    assert [seeds for _, seeds in done.trainings] == [SEEDS]
    assert [(tuple(s.disturbance for s in scenarios), *how) for _, scenarios, *how in done.flights] == [
        (("none", "large"), plants.METHODS, STARTS, SECONDS), (("wind",), plants.METHODS, STARTS, SECONDS)
    ]  # fmt: skip
    text = (tmp_path / "plants.md").read_text()
    whole = " | ".join(f"{0.5 + share:.3f} ± 0.577" for share in shares.values())
    assert f"| none | {whole} | 1.000 | 0 of 20 |" in text
    assert f"| wind | {whole} | 1.000 | 0 of 20 |" in text
    assert f"| large | {whole.rpartition(' | ')[0]} | crashed, 4 of 4 | - | 4 of 20 |" in text
    assert text.index("## a") < text.index("## b")
    assert "## c" not in text
    result = results(tmp_path, "plants.json")["rows"]
    assert [(row["group"], row["vehicle"]) for row in result[:: len(plants.METHODS)]] == [
        ("a", "small"), ("a", "small"), ("b", "small")
    ]  # fmt: skip


@pytest.mark.parametrize("task", ["hover", "track"])
def test_ablation_trains_distinct_policies_and_has_line_per_lever(task, tmp_path, imagine):
    """A column per reference and disturbance; presets that differ only in adaptation share a policy."""
    place = {name: k for k, name in enumerate(ablation.DISTURBANCES[task])}

    def error(spec):
        ours = 0.1 + 0.1 * place[spec.scenario.disturbance] + (0.5 if spec.scenario.reference == "figure8" else 0.0)
        return None if spec.method == "base-i" and spec.start == 1 else ours

    done = imagine(ablation, error)
    ablation.ablation(Run("test", tmp_path), Silent(), task=task, seeds=SEEDS, seconds=SECONDS, starts=STARTS)
    references = ablation.REFERENCES[task]
    every = [*CONTROL, *OFF[task], *CONTROL, *ON[task]]
    assert [(study.preset.name, s[0].reference, *how) for study, s, *how in done.flights] == [
        (f"{task}/{'retrim' if k < len(CONTROL) + len(OFF[task]) else 'paper'}", reference, (lever.method,), STARTS,
         SECONDS)
        for k, lever in enumerate(every) for reference in references
    ]  # fmt: skip
    assert {seeds for _, seeds in done.trainings} == {SEEDS}
    keys = [ablation.dump(ablation.replace(preset, adapt=ablation.Adapt())) for preset, _ in done.trainings]
    assert len(set(keys)) == len(keys)
    text = (tmp_path / f"ablation_{task}.md").read_text()
    columns = [f"{r}, {name}" if r else name for r in references for name in place]
    assert f"| lever | {' | '.join(columns)} |" in text
    figures = [f"{0.1 + 0.1 * k + (0.5 if r == 'figure8' else 0.0):.4f}" for r in references for k in place.values()]
    display = " | ".join(f"{figure} ± 0.0000" for figure in figures)
    assert text.count(f"| {display} |") == len(every) - 2
    half = " | ".join(f"{figure} ± 0.0000, 2 of 4 crashed" for figure in figures)
    assert text.count(f"| {half} |") == 2
    assert text.count("\n| ") == len(every) + 2
    result = results(tmp_path, f"ablation_{task}.json")["rows"]
    assert [(row["lever"], row["reference"], row["disturbance"]) for row in result] == [
        (lever.label.strip("*"), reference, name) for lever in every for reference in references for name in place
    ]
    for preset, scenarios in ((study.preset, s) for study, s, *_ in done.flights):
        if preset.track is not None and not preset.track.looks_ahead:
            assert preset.track.reference == scenarios[0].reference


def test_interrupted_ablation_is_continued(tmp_path, imagine, monkeypatch):
    """Finished levers are not repeated; different seeds, starts or lengths are flown."""
    every = len([*CONTROL, *OFF["hover"], *CONTROL, *ON["hover"]])
    done = imagine(ablation, lambda spec: 0.1)

    def fly(folder=tmp_path / "cut", until=None, **calls):
        run = Run("test", folder)

        def watch(*words, **more):
            flight = done.fly(*words, **more)
            if len(done.flights) == until:
                run.stop.set()
            return flight

        done.flights.clear()
        monkeypatch.setattr(ablation, "fly_all", watch)
        calls = {"seeds": SEEDS, "seconds": SECONDS, "starts": STARTS} | calls
        ablation.ablation(run, Silent(), **calls)
        return len(done.flights), results(folder, "ablation_hover.json")["rows"]

    flight, part = fly(until=4)
    assert flight == 4
    flight, again = fly()
    assert flight == every - 3  # the fourth was interrupted
    assert part == again[: len(part)]
    assert again == fly(tmp_path / "whole")[1]
    assert "An earlier run had made 3 of the parts" in (tmp_path / "cut" / "ablation_hover.md").read_text()
    assert fly() == (0, again)
    for other in ({"seeds": (5,)}, {"seconds": SECONDS + 1.0}, {"starts": STARTS + 1}):
        assert fly(**other)[0] == every


def test_section_flies_policies_and_baselines_in_given_order(tmp_path, imagine, pictures, monkeypatch):
    preset = brief_preset()
    place = {"none": 0.0, "small": 0.2, "large": 0.5}
    share = {"datt": 0.01, "base": 0.02, "indi": 0.03}
    done = imagine(levels, lambda spec: place[spec.scenario.disturbance] + share[spec.method] * (1 + spec.start))
    text, calls = pictures(levels, "picture"), []

    def baseline(preset, seeds, run, reporter, *, steps):
        calls.append((preset, seeds, steps))
        return {seed: f"net {seed}" for seed in seeds}

    monkeypatch.setitem(levels.RIVALS, "datt", baseline)
    section = levels.Levels(
        "title", preset, Scenario(plant="simple"), "stem", ("datt", "base", "indi"), {"base": ("1", "2", "3")},
        {"none": "calm", "small": "breathed on", "large": "pushed"}, ("datt", "indi"),
    )  # fmt: skip
    document = Document(Run("test", tmp_path), "table", "Title", "Intro.", SEEDS, Silent())
    levels.fly_levels(document, [section], starts=STARTS, seconds=SECONDS, datt_steps=77)
    assert done.trainings == [(preset, SEEDS)]
    assert calls == [(preset, SEEDS, 77)]
    own, rivals = done.flights
    assert own[2:] == (("base", "indi"), STARTS, SECONDS)
    assert rivals[2:] == (("datt",), STARTS, SECONDS)
    assert list(rivals[0].policies.values()) == ["net 0", "net 3"]
    assert own[1] == rivals[1] == tuple(Scenario(name, "simple") for name in place)
    table, _ = document.sections
    assert table.columns == ("error [m]", "calm", "breathed on", "pushed")
    assert [row[0] for row in table.rows] == ["DATT", "base policy", "INDI"]
    assert [row[1] for row in table.rows] == ["0.015 ± 0.006", "0.030 ± 0.012 (1)", "0.045 ± 0.017"]
    assert [row[3] for row in table.rows] == ["0.515 ± 0.006", "0.530 ± 0.012 (3)", "0.545 ± 0.017"]
    assert "by seed: 1.0, 4.0 mm. The gate admitted 0 policies and refused 0. 0 of 36 flights crashed." in table.about
    ((display, _, scenario, folder), more), = text["picture"]  # fmt: skip
    assert {(f.spec.seed, f.spec.method) for f in display} == {(0, "datt"), (0, "indi")}
    assert (scenario, folder, more) == (Scenario("large", "simple"), tmp_path, {"stem": "stem"})
    assert table.picture == tmp_path / "picture.png"
    result = results(tmp_path, "table.json")["rows"]
    assert {(row["preset"], row["section"]) for row in result} == {(preset.name, "title")}


def test_errors_around_reversals_use_complete_flights(tmp_path, imagine, pictures):
    message = pictures(reversing, "picture")
    done = imagine(reversing, lambda spec: None if (spec.method, spec.start) == ("indi", 0) else 0.1 + spec.seed)
    reversing.reversing(Run("test", tmp_path), Silent(), plant="simple", seeds=SEEDS, seconds=45.0, starts=STARTS)
    assert [seeds for _, seeds in done.trainings] == [SEEDS]
    ((_, scenarios, *how),) = done.flights
    assert (scenarios, *how) == ((Scenario("reversing", "simple"),), tuple(reversing.METHODS), STARTS, 45.0)
    result = results(tmp_path, "reversing.json")
    assert {m: np.shape(e)[:2] for m, e in result["errors_m"].items()} == {
        m: (2 if m == "indi" else 4, 2) for m in reversing.METHODS
    }
    assert np.shape(result["moments_s"])[0] == 2  # at 15 and 30 s
    for errors in result["errors_m"].values():
        np.testing.assert_allclose(sorted({round(e, 6) for e in np.ravel(errors)}), [0.1, 3.1])
    text = (tmp_path / "reversing.md").read_text()
    assert "| reversed at 15 s, INDI | 1.600 ± 2.121 |" in text
    assert "| reversed at 30 s, base policy | 1.600 ± 1.732 |" in text
    assert "2 of 24 flights crashed." in text
    assert "base policy 1.600; " in text
    assert "INDI -" in text  # two of four flights crashed: the median is infinite
    ((display, *_), _), = message["picture"]  # fmt: skip
    assert {f.spec.method for f in display} == {"base", "full"}


def test_results_are_kept_without_flights_to_plot(tmp_path, imagine, monkeypatch):
    """After an early interruption, flights of other methods have finished, and no plot is possible."""
    done = imagine(reversing, lambda spec: 0.1)
    fly = reversing.fly_all
    fly_indi = lambda *a, **k: Flights([f for f in fly(*a, **k).flights if f.spec.method == "indi"], True)  # noqa: E731
    monkeypatch.setattr(reversing, "fly_all", fly_indi)
    reversing.reversing(Run("test", tmp_path), Silent(), plant="simple", seeds=SEEDS, seconds=45.0, starts=STARTS)
    assert done.flights
    assert [row["method"] for row in results(tmp_path, "reversing.json")["rows"]] == ["indi"]
