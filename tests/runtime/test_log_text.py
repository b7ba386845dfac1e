"""Text and notebook figures of logs, states and presets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fake_flights import flight, log
from retrim import PRESETS, Command, Event, Scenario, Setup, State
from retrim.evaluation.executor import MOST_ROWS, Flights
from retrim.physics import so3
from retrim.runkit import FlightSpec

EVENTS = [Event(float(t), "policy", "cost 1 against 2") for t in range(1, 9)]


def short_text(thing, lines=10):
    """Return the text of an object; assert that it has few lines of limited length."""
    text = repr(thing)
    assert len(text.splitlines()) <= lines
    assert max(map(len, text.splitlines())) <= 200
    return text


def test_state_shows_rounded_numbers():
    x = State(jnp.array([1.0, -2.00004, 0.5]), so3.exp(jnp.array([0.0, 0.0, 0.5 * np.pi])), jnp.array([0.0, 0.1, -0.0]))
    text = "State(p=[1.000, -2.000, 0.500] m, v=[0.000, 0.100, 0.000] m/s, roll_pitch_yaw=[0.0, 0.0, 90.0] deg)"
    assert short_text(x, 1) == text
    assert short_text(Command.hover(), 1) == "Command(c=9.810 m/s^2, omega=[0.000, 0.000, 0.000] rad/s)"


@pytest.mark.parametrize("axis", range(3))
def test_angles_of_state_equal_rotation(axis):
    angles = 0.3 * np.eye(3)[axis]
    text = repr(State(jnp.zeros(3), so3.exp(jnp.asarray(angles)), jnp.zeros(3)))
    assert f"roll_pitch_yaw=[{', '.join(f'{each:.1f}' for each in np.degrees(angles))}] deg" in text


def test_batch_and_traced_state_show_shapes():
    texts = []
    x = State.at(jnp.zeros(3))
    jax.vmap(lambda each: texts.append(repr(each)))(jax.tree.map(lambda leaf: leaf[None], x))
    assert "[3]" in texts[0]
    assert "[4,3]" in repr(jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), x))
    assert "None" in repr(jax.tree.map(lambda leaf: None, x))


def test_state_with_nan_has_text():
    assert "nan" in repr(jax.tree.map(lambda leaf: leaf * jnp.nan, State.at(jnp.zeros(3))))


def test_log_states_duration_ticks_and_events():
    text = short_text(log(60.0, events=EVENTS, terminated=True))
    assert all(part in text for part in ("60.00 s", "3000 ticks of 20 ms", "0 missed", "terminated", "8 policy"))
    assert "events: none" in short_text(log(1.0))
    assert short_text(log(1.0).true, 1).startswith("States: 51 rows")


@pytest.mark.parametrize("name", PRESETS)
def test_presets_and_setups_state_main_numbers(name):
    preset = PRESETS[name]
    text = short_text(preset)
    assert preset.name in text
    assert f"{preset.pretrain.num_updates} steps" in text


def test_setup_contains_preset():
    setup = Setup.from_preset("hover/retrim")
    text = short_text(setup)
    assert all(line.strip() in text for line in repr(setup.preset).splitlines())
    assert "mass 0.19 kg" in text


def flights(n=1):
    """Return flights of two methods under n disturbances."""
    scenarios = [Scenario(f"wind={i + 1}") for i in range(n)]
    specs = [FlightSpec(scenario, method, 0) for scenario in scenarios for method in ("base", "full")]
    return Flights([flight(0.02 if spec.method == "full" else 0.5, spec=spec) for spec in specs], interrupted=False)


def test_flights_state_errors_of_each_method():
    text = short_text(flights())
    assert text.startswith("Flights: 2 flown, 0 crashed, 0 failed")
    assert "wind=1, base: error at the end [mm] 500" in text
    assert "wind=1, full: error at the end [mm] 20.0" in text
    assert "and 34 more rows" in short_text(flights(20))
    assert len(short_text(flights(20)).splitlines()) == MOST_ROWS + 2
    assert short_text(Flights([], interrupted=True)) == "Flights: 0 flown, 0 crashed, 0 failed, interrupted"


def test_flights_in_different_conditions_are_distinguished():
    specs = [FlightSpec(Scenario("large", plant), "base", 0) for plant in ("bem", "simple")]
    text = short_text(Flights([flight(0.1, spec=spec) for spec in specs], interrupted=False))
    assert "large, bem, base" in text
    assert "large, simple, base" in text


def test_flight_is_one_line():
    assert "error 0.1 m at the end" in short_text(flight(0.1), 1)
    assert "terminated" in short_text(flight(0.1, terminated=True), 1)


@pytest.mark.parametrize(("target", "label"), [(None, "position [m]"), ((0, 0, 1), "error [m]")])
def test_figure_of_log_shows_errors_updates_path_and_commands(target, label):
    figure = log(10.0, events=EVENTS).plot(target)
    labels = {axes.get_ylabel() for axes in figure.axes}
    assert labels == {label, "y [m]", "commanded thrust [m/s²]", "commanded rates [rad/s]"}
    marks = [line for line in figure.axes[0].lines if line.get_label() == "new policy" or len(line.get_xdata()) == 2]
    assert sorted(line.get_xdata()[0] for line in marks) == [event.t for event in EVENTS]
    if target is not None:
        error = figure.axes[0].lines[-1].get_ydata()
        np.testing.assert_allclose(error, 1.0)
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_target_may_change_with_time():
    flight = log(1.0)
    targets = np.linspace(0.0, 1.0, len(flight.t))[:, None] * np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(flight.plot(targets).axes[0].lines[-1].get_ydata(), targets[:, 0])
    with pytest.raises(ValueError, match="broadcast"):
        flight.plot(targets[:-1])


def test_figure_of_flights_has_one_colour_per_method():
    figure = flights().plot()
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    assert {"wind=1, base", "wind=1, full"} <= lines.keys()
    assert lines["wind=1, base"].get_color() != lines["wind=1, full"].get_color()
    np.testing.assert_allclose(lines["wind=1, base"].get_ydata(), 0.5)


def test_no_figure_is_registered_with_pyplot():
    from matplotlib import _pylab_helpers

    log(1.0).plot()
    assert not _pylab_helpers.Gcf.figs
