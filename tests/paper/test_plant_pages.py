"""Pages about the plant, other simulators, a reversing push and the buses, at reduced size."""

import importlib
import json
from contextlib import nullcontext

import numpy as np
import pytest

from commands import results, retrim
from fake_flights import Watching
from helpers import brief_preset
from retrim import PlantError, Scenario
from retrim.config import named_presets as presets
from retrim.runkit import Run
from retrim.runkit.reporter import Silent
from retrim.transport.shared_memory import SharedMemoryBus
from retrim_paper import latency
from retrim_paper.published import compare_published

pytestmark = pytest.mark.usefixtures("as_a_user")

# The package exports functions with the names of these modules.
buses, model, plants, reversing = (
    importlib.import_module(f"retrim_paper.tables.{name}") for name in ("buses", "model", "plants", "reversing")
)


def curves(panel):
    return {curve.label: curve for curve in panel.curves}


def at(curve, x):
    return np.interp(x, curve.x, curve.y)


def test_rotor_figures_are_near_published_values():
    for row in compare_published():
        assert row["ours"] == pytest.approx(row["published"], rel=0.03 if row["source"] == "Agilicious" else 0.12), row


def test_thrust_and_inflow_match_published_points():
    result = curves(model.thrust_panel())
    ours, theirs, points = (result[n] for n in ("blade elements", "published thrust map", "Agilicious' own model"))
    assert np.all(np.diff(ours.x) > 0)
    assert np.all(np.diff(ours.y) > 0)
    np.testing.assert_allclose(at(theirs, points.x), points.y, rtol=0.05)
    np.testing.assert_allclose(at(ours, points.x), points.y, rtol=0.03)
    np.testing.assert_array_equal(ours.x, theirs.x)
    np.testing.assert_allclose(ours.y / ours.x**2, ours.y[-1] / ours.x[-1] ** 2, rtol=1e-3)  # in still air
    np.testing.assert_allclose(theirs.y / theirs.x**2, 1.562522e-6)
    inflow = curves(model.inflow_panel())
    ruled, plain = inflow["with the vortex-ring rule"], inflow["momentum theory alone"]
    exact = inflow["fine quadrature, bracketing search"]
    np.testing.assert_allclose(at(ruled, exact.x), exact.y, rtol=0.01)
    np.testing.assert_array_equal(ruled.y[ruled.x < 0], plain.y[plain.x < 0])  # the published rule applies to descent
    assert np.any(ruled.y[ruled.x > 0] > plain.y[plain.x > 0] + 0.1)


def test_drag_grows_with_speed_and_is_mostly_rotor_drag():
    result = curves(model.drag_panel())
    for name in ("small", "kingfisher"):
        whole, rotors = result[f"{name}: rotors and body"], result[f"{name}: rotors"]
        assert whole.y[0] == pytest.approx(0.0, abs=1e-3)
        assert np.all(np.diff(whole.y) > 0)
        assert np.all(whole.y[1:] >= rotors.y[1:] - 1e-6)
        assert at(rotors, 3.0) > 0.5 * at(whole, 3.0)
        body, fast = (at(whole, v) - at(rotors, v) for v in (5.0, 10.0))
        assert fast == pytest.approx(4.0 * body, rel=0.01)  # proportional to the square of the speed
        np.testing.assert_allclose((whole.x[0], whole.x[-1]), (0.0, 10.0))
    assert at(result["kingfisher: rotors"], 3.0) == pytest.approx(
        at(result["kingfisher, published: 0.24 1/s"], 3.0), rel=0.15
    )


def test_step_responses_and_battery_sag():
    rates = curves(model.rate_panel())
    assert set(rates) == {f"{name}, {axis}" for name in model.QUADROTORS for axis in ("roll", "yaw")}
    for name in model.QUADROTORS:
        roll, yaw = rates[f"{name}, roll"], rates[f"{name}, yaw"]
        assert (roll.x[0], roll.x[-1]) == (1.0, 300.0)  # [ms]
        assert abs(roll.y[0]) < 0.05
        assert roll.y[-1] == pytest.approx(1.0, abs=0.15)
        assert at(yaw, 50.0) < at(roll, 50.0)  # drag turns a body less than thrust does
    thrust = curves(model.step_panel())
    np.testing.assert_array_equal(thrust["commanded"].x, [0.0, 300.0])
    np.testing.assert_array_equal(thrust["commanded"].y, [5.0, 5.0])
    for name in model.QUADROTORS:
        assert (thrust[name].x[0], thrust[name].x[-1]) == (2.0, 300.0)  # [ms]
        assert thrust[name].y[0] < 1.0
        assert thrust[name].y[-1] == pytest.approx(at(thrust["commanded"], 300.0), rel=0.1)
    (sag,) = model.sag_panel().curves
    assert sag.y[0] == pytest.approx(0.0, abs=0.4)
    assert np.all(np.diff(sag.y[sag.x <= 100.0]) < 0)
    np.testing.assert_allclose(sag.y[sag.x >= 100.0], sag.y[-1], atol=1e-4)
    assert (sag.x[0], sag.x[-1]) == (0.0, 120.0)
    assert sag.y[-1] - sag.y[0] == pytest.approx(-0.2 * 9.81, rel=0.1)  # a fifth less thrust


def test_model_page_has_each_figure_and_deviation(tmp_path, monkeypatch):
    panel = model.sag_panel()
    for name in ("thrust", "drag", "inflow", "rate", "step", "sag"):
        monkeypatch.setattr(model, f"{name}_panel", lambda: panel)
    rows = [{"what": "a", "ours": 1.1, "published": 1.0, "source": "s"}]
    monkeypatch.setattr(model, "compare_published", lambda: rows)
    model.model(Run("test", tmp_path), Silent())
    text = (tmp_path / "model.md").read_text()
    assert "| a | 1.1 | 1 | +10.0 % | s |" in text
    assert "![model](model.png)" in text
    assert results(tmp_path, "model.json")["rows"] == rows


def test_plants_page_by_its_command(tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "hover/retrim", brief_preset())
    groups = [("a", "simple", ("none", "wind")), ("b", "mujoco", ("none",)), ("c", "rotorpy", ("none",))]
    setup = tuple((title, Scenario(plant=plant), disturbances) for title, plant, disturbances in groups)
    monkeypatch.setattr(plants, "groups", lambda: setup)
    monkeypatch.setattr(plants, "METHODS", ("base", "full"))
    fly_all = plants.fly_all

    def fly(study, scenarios, *argument, **how):
        if scenarios[0].plant == "mujoco":
            raise PlantError("mujoco is not here")
        return fly_all(study, scenarios, *argument, **how)

    monkeypatch.setattr(plants, "fly_all", fly)
    words = "--plant", "simple", "mujoco", "--seconds", "1", "--starts", "2"
    retrim("reproduce", "plants", *words, "--out", "p", cwd=tmp_path)
    text = (tmp_path / "p" / "plants.md").read_text()
    assert "Left out: mujoco is not here" in text
    assert text.count("\n| none |") == text.count("\n| wind |") == 1
    rows = json.loads((tmp_path / "p" / "plants.json").read_text())["rows"]
    assert [(row["group"], row["disturbance"], row["method"], row["n"]) for row in rows] == [
        ("a", name, method, 2) for name in ("none", "wind") for method in ("base", "full")
    ]
    assert "## c" not in text
    assert "no plant 'kite'" in retrim("reproduce", "plants", "--plant", "kite", cwd=tmp_path, code=1)


def test_every_plant_group_builds_a_scenario():
    for title, scenario, disturbances in plants.groups():
        assert title.startswith(scenario.plant)
        assert disturbances
    assert len({title for title, *_ in plants.groups()}) == len(plants.groups())


def test_plant_group_matches_its_title():
    result = {title: scenario for title, scenario, _ in plants.groups()}
    text = {
        "on the large one": {"vehicle": "large"}, "on the kingfisher": {"vehicle": "kingfisher"},
        "map exact": {"thrust_error": 0.0}, "3.5 % below": {"thrust_error": -0.035},
        "10.5 % above": {"thrust_error": 0.105}, "mocap sensors": {"sensors": "mocap"},
        "rough sensors": {"sensors": "rough"},
    }  # fmt: skip
    for title, scenario in result.items():
        (differs,) = [more for words, more in text.items() if words in title] or [{}]
        assert scenario == Scenario(plant=scenario.plant, **differs), title
    assert all(any(words in title for title in result) for words in text)


def test_reversing_page_by_its_command(tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "hover/retrim", brief_preset())
    monkeypatch.setattr(reversing, "PERIOD", 1.0)
    monkeypatch.setattr(reversing, "METHODS", {"base": "base policy", "full": "**adapted**"})
    words = "--plant", "simple", "--starts", "2"
    retrim("reproduce", "reversing", *words, "--seconds", "3", "--out", "r", cwd=tmp_path)
    result = json.loads((tmp_path / "r" / "reversing.json").read_text())
    assert [(row["method"], row["plant"], row["n"]) for row in result["rows"]] == [
        ("base", "simple", 2), ("full", "simple", 2)
    ]  # fmt: skip
    turns, read = np.shape(result["moments_s"])
    assert (turns, result["moments_s"][0][0], result["moments_s"][0][-1]) == (2, 1.0, 2.0)
    assert all(np.shape(errors)[1:] == (turns, read) for errors in result["errors_m"].values() if errors)
    assert list((tmp_path / "r").glob("*.png"))
    text = retrim("reproduce", "reversing", *words, "--seconds", "1", cwd=tmp_path, code=1)
    assert "a push that reverses needs at least 2 s" in text


def test_messages_between_two_processes_are_timed(monkeypatch):
    monkeypatch.setattr(latency, "COUNT", 3)
    monkeypatch.setattr(latency, "FIRST", 2)
    bus = SharedMemoryBus.create(latency.TOPICS)
    try:
        took = latency.measure_latencies(bus, latency.other_process(str(bus.folder)), 500)
    finally:
        bus.remove()
    assert len(took) == 3  # the first two do not count
    assert all(0.0 < seconds < 0.5 for seconds in took)


def test_bus_latencies_by_their_command(tmp_path, monkeypatch):
    calls = []

    def measure(bus, words, size):
        calls.append((type(bus).__name__, words[-1], size))
        return [] if size > 1e6 else [1e-3, 3e-3]

    monkeypatch.setattr(buses, "measure_latencies", measure)
    monkeypatch.setattr(buses, "rosmaster", nullcontext)
    monkeypatch.setattr(buses, "two_machines", nullcontext)
    watching = Watching()
    buses.buses(Run("test", tmp_path), watching)
    assert [each for each in watching.messages if each[0] == "shared memory"] == [
        ("shared memory", i / len(latency.SIZES), name) for i, name in enumerate(latency.SIZES)
    ]
    rows = results(tmp_path, "buses.json")["rows"]
    assert [row["bytes"] for row in rows if row["bus"] == "shared memory"] == [500, 74_000]
    assert {(row["p50_ms"], row["max_ms"], row["n"]) for row in rows} == {(2.0, 3.0, 2)}
    assert [size for name, _, size in calls if name == "SharedMemoryBus"] == list(latency.SIZES.values())
    assert "| shared memory | a measurement, 0.5 kB | 2.00 |" in (tmp_path / "buses.md").read_text()
    for name, where, _ in calls:
        assert ("/" in where) == (name == "SharedMemoryBus")
