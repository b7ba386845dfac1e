"""Hidden vehicles: the population, and the table of their flights."""

import dataclasses
import importlib

import jax
import numpy as np
import pytest

from commands import results
from helpers import brief_preset
from retrim import ConfigError, Setup
from retrim.config import named_presets as presets
from retrim.config.hidden_vehicles import draw_vehicles
from retrim.config.vehicles import make_vehicle
from retrim.evaluation.fleet import Fleet
from retrim.runkit import Run
from retrim.runkit.reporter import Silent
from retrim_paper.tables.hidden_entrants import ENTRANTS, Entrant, entrants_of

gauntlet = importlib.import_module("retrim_paper.tables.gauntlet")

pytestmark = pytest.mark.usefixtures("as_a_user")


@pytest.fixture(scope="module")
def population():
    return draw_vehicles(300, seed=5)


def test_vehicles_are_within_ranges(population):
    ranges = {
        "mass": (0.03, 3.0), "rate_lag": (0.015, 0.15), "delay": (0.0, 0.06), "damping": (0.4, 1.2),
        "thrust_gain": (0.6, 1.6), "thrust_to_weight": (1.39, 8.1),
    }  # fmt: skip
    for name, (low, high) in ranges.items():
        values = np.array([v.spec.mass if name == "mass" else getattr(v, name) for v in population])
        assert low <= values.min() < low + 0.1 * (high - low), name
        assert high - 0.25 * (high - low) < values.max() <= high, name


def test_vehicle_parameters_scale_with_size(population):
    """Mass grows with the cube of the arm, inertia with the fifth power, and lag and delay with the size."""
    arm, mass, inertia = (
        np.array(values)
        for values in zip(*((v.spec.arm[0], v.spec.mass, v.spec.inertia[0]) for v in population), strict=True)
    )
    for values, power in ((mass, 3.0), (inertia, 5.0)):
        np.testing.assert_allclose(np.polyfit(np.log(arm), np.log(values), 1)[0], power, rtol=1e-6)
    size = [v.size for v in population]
    assert np.corrcoef(size, np.log([v.rate_lag for v in population]))[0, 1] > 0.9
    assert np.corrcoef(size, [v.delay for v in population])[0, 1] > 0.8


def test_wrong_vehicle_file_is_wrong_by_up_to_two(population):
    def values(spec):
        ratio = spec.thrust_max / spec.mass
        return np.array(
            [spec.mass, *spec.inertia, *spec.rate_lag, *spec.rate_damping, spec.motor_tau, spec.command_delay, ratio]
        )

    pairs = [np.stack([values(v.wrong_spec), values(v.spec)]) for v in population if v.delay > 0.005]
    factors = np.log2([wrong / true for wrong, true in pairs])
    assert np.abs(factors).max() < 1.02  # rounded to three digits
    assert (factors.min(axis=0) < -0.9).all()
    assert (factors.max(axis=0) > 0.9).all()
    assert all(make_vehicle(v.wrong_spec).mass > 0.0 for v in population[:20])


def test_larger_population_extends_smaller_one(population):
    assert draw_vehicles(3, seed=5) == population[:3]
    assert draw_vehicles(3, seed=6) != population[:3]


def test_seed_of_population_has_32_bits():
    draw_vehicles(1, 2**32 - 1)
    for seed in (-1, 2**32):
        with pytest.raises(ConfigError, match=f"draw {seed}: must be 0 to 4294967295"):
            draw_vehicles(1, seed)


def test_plant_has_parameters_of_vehicle(population):
    """The plant is of second order, with the lag, damping, gain and delay of the vehicle, which the preset does not
    contain.
    """
    for vehicle in population[:3]:
        plant = vehicle.scenario("early-step").make("small")
        response = plant.simulation.model.response
        np.testing.assert_allclose(response.rate_lag, vehicle.rate_lag, rtol=1e-6)
        np.testing.assert_allclose(response.inverse_damping, 1.0 / vehicle.damping, rtol=1e-6)
        assert float(response.thrust_gain) == pytest.approx(vehicle.thrust_gain, rel=1e-6)
        assert float(make_vehicle(vehicle.spec).mass) == pytest.approx(vehicle.spec.mass)


def test_vehicles_with_different_numbers_share_program(population):
    preset = brief_preset()
    policy = Setup.from_preset(preset).new_policy(jax.random.key(0))
    scenarios = [vehicle.scenario("early-step") for vehicle in population[:4]]
    fleet = Fleet(preset, policy, scenarios, methods=("base",), starts=1, seconds=1.0)
    batches = fleet.make_batches(fleet.specs)
    assert all(len(batch.specs) > 1 for batch in batches)
    flight = fleet.run().flights
    alone = Fleet(preset, policy, scenarios[2:3], methods=("base",), starts=1, seconds=1.0).run().flights
    np.testing.assert_allclose(flight[2].log.p, alone[0].log.p, atol=1e-5)


def test_vehicles_with_different_stated_keys_need_different_programs(population):
    first = population[0].scenario("none")
    silent = dataclasses.replace(first, vehicle=dataclasses.replace(population[1].spec, rate_damping=None))
    assert first.without_numbers() == population[1].scenario("none").without_numbers()
    assert first.without_numbers() != silent.without_numbers()


@pytest.mark.parametrize(
    ("preset", "courses", "columns"),
    [
        ("hover/fast", ["Hover, a push of 2 m/s² per axis at 4 s"], ("error_m", "to_10cm_s", "to_2cm_s", "peak_m")),
        ("track/retrim", ["Figure-8 of 10 s", "Figure-8 of 5.5 s"], ("rmse_m", "peak_m")),
    ],
)
def test_table_has_row_for_each_flight(tmp_path, imagine, pictures, monkeypatch, preset, courses, columns):
    hidden = importlib.import_module("retrim_paper.tables.hidden")
    pictures(hidden, "vehicle_map")
    monkeypatch.setattr(hidden.plots, "save", lambda figure, folder, stem: (folder / f"{stem}.png", folder / stem))
    imagine(hidden, lambda spec: None if spec.method == "indi" else 0.01)
    sizes = {"count": 3, "starts": 2, "seeds": (0, 1), "methods": ("base", "indi")}
    gauntlet.gauntlet(Run("test", tmp_path), Silent(), preset=preset, vehicles="hidden", **sizes)
    rows = results(tmp_path, "results.json")["rows"]
    assert [len([row for row in rows if row["course"] == course]) for course in courses] == [2 * 3 * 2 * 2] * len(
        courses
    )
    for row in rows:
        assert row["lost"] == (row["method"] == "indi")
        assert all((row[name] is None) == row["lost"] for name in columns)
    text = (tmp_path / "hidden.md").read_text()
    assert "| `" + preset + "` | INDI | not known | 12 of 12 | ∞ / ∞ / ∞ |" in text


def test_unflyable_options_are_refused_before_training(tmp_path):
    run = Run("test", tmp_path)
    for words, message in (
        ({"count": 0}, "count must be 1 to 10000 vehicles, got 0"),
        ({"faults": True}, "--vehicles hidden has one condition"),
        ({"preset": "vision/ideal"}, "hidden vehicles are flown for hover, track"),
        ({"preset": "hover/retrim", "methods": ("base-id",)}, "is for one vehicle"),
        ({"file": "wrong"}, "--file wrong needs --methods"),
    ):
        with pytest.raises(ConfigError, match=message):
            gauntlet.gauntlet(run, Silent(), vehicles="hidden", **words)


@pytest.mark.parametrize("file", ["wrong", "true", "trained"])
def test_vehicle_file_reaches_method_and_training(tmp_path, imagine, pictures, monkeypatch, population, file):
    hidden = importlib.import_module("retrim_paper.tables.hidden")
    pictures(hidden, "vehicle_map")
    monkeypatch.setattr(hidden.plots, "save", lambda figure, folder, stem: (folder / f"{stem}.png", folder / stem))
    done = imagine(hidden, lambda spec: 0.01)
    sizes = {"count": 2, "draw": 5, "starts": 1, "methods": ("base",), "file": file}
    gauntlet.gauntlet(Run("test", tmp_path), Silent(), preset="hover/fast", vehicles="hidden", **sizes)
    expected = [each.wrong_spec if file == "wrong" else each.spec for each in population[:2]]
    assert [study.preset.vehicle for study, *_ in done.flights] == expected
    trained = [preset.vehicle for preset, _ in done.trainings if preset.vehicle != "small"]
    assert trained == (expected if file == "trained" else [])
    assert {row["vehicle_file"] for row in results(tmp_path, "results.json")["rows"]} == {file}


@pytest.mark.parametrize("file", ["none", "trained"])
def test_entrant_that_computes_long_flies_each_vehicle_once(tmp_path, imagine, pictures, monkeypatch, file):
    hidden = importlib.import_module("retrim_paper.tables.hidden")
    pictures(hidden, "vehicle_map")
    monkeypatch.setattr(hidden.plots, "save", lambda figure, folder, stem: (folder / f"{stem}.png", folder / stem))
    imagine(hidden, lambda spec: 0.01)
    entrants = (Entrant("hover/fast", "base"), Entrant("hover/fast", "indi", file, once=True))
    sizes = {"count": 3, "draw": 5, "starts": 2, "seeds": (4, 7), "sensors": "ideal"}
    hidden.fly_hidden(Run("test", tmp_path), Silent(), task="hover", entrants=entrants, **sizes)
    rows = results(tmp_path, "results.json")["rows"]
    assert sum(row["method"] == "base" for row in rows) == 3 * 2 * 2
    assert [(row["vehicle"], row["seed"], row["start"]) for row in rows if row["method"] == "indi"] == [
        (number, 4, 0) for number in range(3)
    ]


def test_published_page_has_every_kind_of_method():
    for task in ("hover", "track"):
        result = entrants_of(task, "any", ())
        assert result == ENTRANTS[task]
        assert {entrant.method for entrant in result} >= {"base", "base-do", "geometric-i", "indi", "base-id"}
        assert all(entrant.preset in presets.PRESETS for entrant in result)
        assert {entrant.file for entrant in result} >= {"none", "wrong", "true"}
        assert len({entrant.label for entrant in result}) == len(result)
