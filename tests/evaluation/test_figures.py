"""Plots of flights, and their marks of the disturbance."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from fake_flights import flight
from helpers import tiny_preset
from retrim import Event, Scenario, Setup
from retrim.evaluation.figures import _colours, file_stem, picture, spans
from retrim.runkit import FlightSpec
from retrim.viz.panels import bars

pytestmark = pytest.mark.usefixtures("optax_promotion")


def test_plot_with_crashes_and_without_adapted_flights(tmp_path):
    result = [flight(0.1), flight(3.0, terminated=True, seconds=1.0)]
    setup = picture(result, Setup.from_preset(tiny_preset()), result[0].spec.scenario, tmp_path)
    assert [path.name for path in setup] == ["hover_large.png", "hover_large.svg"]
    assert all(path.stat().st_size > 5_000 for path in setup)


def test_plot_shows_only_flights_of_its_scenario(tmp_path):
    scenario = Scenario("wind=3+payload=0.1")
    swap = Event(3.0, "policy", "cost 1 against 2")
    adapted_policy = flight(0.02, spec=FlightSpec(scenario, "full", 0), events=[swap])
    assert adapted_policy.swaps == (3.0,)
    setup = Setup.from_preset(tiny_preset())
    assert picture([adapted_policy], setup, Scenario("none"), tmp_path) == []
    assert not list(tmp_path.iterdir())
    names = picture([adapted_policy], setup, scenario, tmp_path / "deep" / "er")
    assert names[0].name == "hover_wind_3_payload_0.1.png"
    again = picture([adapted_policy], setup, scenario, tmp_path, stem="mine")
    assert dataclasses.asdict(scenario)["disturbance"] in again[1].read_text()


def test_long_names_are_shortened_to_different_files(tmp_path):
    """A sum of many disturbances is longer than a file name can be; short names remain readable."""
    long = [f"hover_{'+'.join(['wind=3'] * 50)}+payload=0.{k}" for k in range(3)] + ["飛" * 80]
    stems = [file_stem(name) for name in long]
    assert len(set(stems)) == len(long)
    for stem in stems:
        (tmp_path / f"{stem}.png").touch()
    assert stems[0].startswith("hover_wind_3_wind_3")
    assert file_stem("hover_wind=3+payload=0.1") == "hover_wind_3_payload_0.1"


def test_plot_labels_methods(tmp_path):
    """A controller that learns nothing is not labelled as adapted."""
    scenario, setup = Scenario("large"), Setup.from_preset(tiny_preset())
    display = [flight(error, spec=FlightSpec(scenario, name, 0)) for name, error in (("base", 0.3), ("indi", 0.1))]
    text = picture(display, setup, scenario, tmp_path)[1].read_text()
    assert "base policy: 30.0 cm over the last 2 s" in text
    assert "INDI: 10.0 cm over the last 2 s" in text
    exact = [flight(2e-5, spec=FlightSpec(scenario, "indi", 0))]
    assert "INDI: below 0.1 cm over the last 2 s" in picture(exact, setup, scenario, tmp_path)[1].read_text()
    assert "adapted" not in text
    assert _colours(["base", "indi", "full", "lora"]) == {"base": 0, "indi": 2, "full": 1, "lora": 3}
    assert _colours(["indi"]) == {"indi": 1}


def test_manual_disturbances_are_marked_at_their_times(tmp_path):
    acts = [
        Event(2.0, "request", "method lora $x_$"),
        Event(4.0, "knobs", "push 1 0 0"),
        Event(5.0, "guard", "hold: gone"),
    ]
    display = flight(0.1, spec=FlightSpec(Scenario("large"), "full", 0), events=acts)
    text = picture([display], Setup.from_preset(tiny_preset()), display.spec.scenario, tmp_path)[1].read_text()
    assert all(words in text for words in ("method lora $x_$", "push 1 0 0", "operator action"))
    assert "hold: gone" not in text


def test_spans_of_disturbances():
    def find(name, seconds=30.0):
        return [(s.start, s.end, s.label) for s in spans(name, jnp.array([0.0, 0.0, 1.0]), seconds)]

    assert find("none") == []
    assert find("large") == [(0.0, 30.0, "pushed by +2 m/s² per axis")]
    first, second, third = find("reversing", 40.0)
    assert (first[2], second[2]) == ("pushed by +0.5 m/s² per axis", "pushed by -0.5 m/s² per axis")
    assert (second[0], third[0], third[1]) == (pytest.approx(15.0, abs=0.1), pytest.approx(30.0, abs=0.1), 40.0)
    assert find("pickup") == [(8.0, 20.0, "70 g of load")]
    assert find("wind+weak-rotor") == [(0.0, 30.0, "wind of 4.0 m/s; rotors at 90, 100, 100, 100 %")]
    assert find("gusts") == [(0.0, 30.0, "gusts")]
    strong = [span.strong for span in spans("reversing", jnp.array([0.0, 0.0, 1.0]), 40.0)]
    np.testing.assert_array_equal(strong, [False, True, False])


@pytest.mark.parametrize("methods", [["base", "full", "lora"], ["full", "lora"], ["indi", "base", "base-do", "full"]])
def test_bars_of_methods_have_distinct_colours(methods):
    figure = bars("Error", {"none": {name: [0.1] for name in methods}, "large": {name: [np.inf] for name in methods}})
    pictures = [handle.patches[0].get_facecolor() for handle in figure.axes[0].containers]
    assert len(set(pictures)) == len(methods)


@pytest.mark.parametrize("last", [np.nan, np.inf])
def test_crash_is_marked_at_last_finite_position(tmp_path, last):
    scenario, setup = Scenario("large"), Setup.from_preset(tiny_preset())
    error = np.append(np.full(500, 0.5), last)
    display = [flight(error, spec=FlightSpec(scenario, "base", 0), terminated=True)]
    assert "crashed" in picture(display, setup, scenario, tmp_path)[1].read_text()
