"""Vehicle files: a plausible quadrotor flies on both plants; an impossible one is refused with the name of the key."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from retrim import ConfigError
from retrim.config import PRESETS, Scenario, Setup, changed, load, read_vehicle
from retrim.physics import Command, State
from retrim.physics.vehicle import kingfisher
from retrim.runtime import FunctionPilot, fly

SEVEN_INCH = {
    "mass": "1.2",
    "inertia": "[0.008, 0.009, 0.015]",
    "arm": "[0.105, 0.12]",
    "thrust_max": "52.0",
    "rates_max": "[8.0, 8.0, 4.0]",
    "motor_tau": "0.04",
    "propeller_diameter": "7.0",
}


@pytest.fixture
def vehicle_file(tmp_path):
    def write(file_name="seven_inch.toml", **changes):
        lines = {k: v for k, v in (SEVEN_INCH | changes).items() if v is not None}
        path = tmp_path / file_name
        path.write_text("".join(f"{key} = {value}\n" for key, value in lines.items()))
        return path

    return write


def test_seven_inch_quadrotor(vehicle_file):
    spec = read_vehicle(vehicle_file())
    assert spec.name == "seven_inch"
    vehicle = spec.build()
    assert float(vehicle.mass) == 1.2
    np.testing.assert_array_equal(vehicle.inertia, [0.008, 0.009, 0.015])
    np.testing.assert_array_equal(vehicle.arm, [0.105, 0.12])
    np.testing.assert_array_equal(vehicle.omega_max, [8.0, 8.0, 4.0])
    assert float(vehicle.command_max.c) == pytest.approx(52.0 / 1.2)
    assert float(vehicle.propeller.radius) == pytest.approx(3.5 * 0.0254, rel=0.02)
    assert float(vehicle.motor_min) < float(vehicle.hover_speed) < float(vehicle.motor_max)
    # A quarter of the largest thrust at 90 % of the largest speed:
    assert float(vehicle.thrust_coefficient * (0.9 * vehicle.motor_max) ** 2) == pytest.approx(13.0)
    assert read_vehicle(vehicle_file(file_name="other.toml")).name == "other"


@pytest.mark.parametrize("size", [0.5, 1.3])
def test_missing_values_follow_from_size(vehicle_file, size):
    """With all lengths scaled by n, areas scale with n^2, and rotors with n^4 and n^5."""
    spec = read_vehicle(vehicle_file(propeller_diameter="5.5", propeller="'5 inch'"))
    arm = tuple(size * length for length in spec.arm)
    other = dataclasses.replace(
        spec, arm=arm, propeller_diameter=5.5 * size, inertia=tuple(size**2 * moment for moment in spec.inertia)
    )
    one, bigger = spec.build(), other.build()
    for name, power in (("radius", 1), ("chord_root", 1), ("chord_tip", 1)):
        assert getattr(bigger.propeller, name) == pytest.approx(size**power * getattr(one.propeller, name))
    for name, power in (
        ("drag_area", 2), ("thrust_coefficient", 4), ("rotor_inertia", 5), ("torque_ratio", 1),
        ("motor_max", -2), ("motor_min", -2),
    ):  # fmt: skip
        np.testing.assert_allclose(getattr(bigger, name), size**power * getattr(one, name), rtol=1e-6, err_msg=name)
    for name in ("base", "linear", "root"):
        assert getattr(bigger.esc, name) == pytest.approx(size**-2 * getattr(one.esc, name))
    # as far as the arms of kingfisher
    like = dataclasses.replace(spec, arm=(0.075, 0.1), inertia=(0.004, 0.005, 0.008)).build()
    np.testing.assert_allclose(like.drag_area, kingfisher().drag_area)
    # Without a stated size, propellers have 0.9 of the largest size that the shorter arm allows:
    bare = read_vehicle(vehicle_file(propeller_diameter=None)).build()
    assert float(bare.propeller.radius) == pytest.approx(0.9 * 0.105, rel=0.02)


@pytest.mark.parametrize(("kind", "inches"), [("3 inch", 3.0), ("3 inch", 6.0), ("5 inch", 5.0)])
def test_propeller_has_stated_size(vehicle_file, kind, inches):
    vehicle = read_vehicle(vehicle_file(propeller=f"'{kind}'", propeller_diameter=str(inches))).build()
    assert float(vehicle.propeller.radius) == pytest.approx(0.5 * inches * 0.0254, rel=0.02)


@pytest.mark.parametrize("plant", ["bem", "simple"])
@pytest.mark.parametrize("propeller", [None, "7.0"])
def test_vehicle_hovers_on_hover_commands(vehicle_file, plant, propeller):
    """The vehicle stays within 5 cm for a second, without a thrust-map error."""
    path = vehicle_file(propeller_diameter=propeller)
    setup = Scenario(plant=plant, vehicle=str(path), thrust_error=0.0).make()
    x0 = State.at(jnp.array([0.3, -0.2, 1.5]))
    log = fly(setup, FunctionPilot(lambda measurement: Command.hover()), x0, ticks=50)
    assert np.linalg.norm(log.p - log.p[0], axis=1).max() < 0.05


def test_drag_equals_file(vehicle_file):
    spec = read_vehicle(vehicle_file(drag_area="[0.01, 0.02, 0.03]"))
    np.testing.assert_array_equal(spec.build().drag_area, [0.01, 0.02, 0.03])


def test_preset_contains_its_vehicle_file(vehicle_file, tmp_path):
    """The file is found relative to the overlay, and is needed only once."""
    path = vehicle_file()
    overlay = tmp_path / "overlay.toml"
    overlay.write_text("vehicle = 'seven_inch.toml'\n")
    preset = load("hover/fast", overlay)
    path.unlink()
    assert preset.vehicle.name == "seven_inch"
    setup = Setup.from_preset(preset)
    assert float(setup.vehicle.mass) == 1.2
    np.testing.assert_array_equal(setup.env.task.observation.omega_max, [8.0, 8.0, 4.0])
    assert float(Scenario().make(preset.vehicle).simulation.model.vehicle.mass) == 1.2


def test_scenario_contains_its_vehicle_file(vehicle_file):
    path = vehicle_file()
    scenario = Scenario(vehicle=str(path))
    path.unlink()
    assert scenario.vehicle_name("small") == "seven_inch"
    assert float(scenario.make("small").simulation.model.vehicle.mass) == 1.2


IMPOSSIBLE = [
    ({"mass": "-1.2"}, r"mass: Input should be greater than 0\.005"),
    ({"mass": "1200.0"}, r"mass: Input should be less than or equal to 50"),  # grams
    ({"mass": "'heavy'"}, r"mass: Input should be a valid number"),
    ({"mass": "true"}, r"mass: Input should be a valid number"),
    ({"mass": None}, r"mass: is missing"),
    ({"inertia": "[80.0, 90.0, 150.0]"}, r"inertia = .* is too large for 1\.2 kg .* is it in g cm\^2"),
    ({"inertia": "[0.002, 0.003, 0.015]"}, r"inertia = .* no body has one moment larger than the sum"),
    ({"inertia": "[0.008, 0.009]"}, r"inertia\.2: is missing|inertia\.2: Field required|inertia: "),
    ({"arm": "[0.1, -0.1]"}, r"arm\.1: Input should be greater than 0"),
    ({"thrust_max": "12.0"}, r"thrust_max = 12\.0 N must exceed 1\.2 times the weight of 11\.7"),
    ({"rates_max": "[8.0, 8.0, 1e-9]"}, r"rates_max\.2: Input should be greater than or equal to 0\.1"),
    ({"rates_max": "[8.0, nan, 4.0]"}, r"rates_max\.1: Input should be .*, not nan"),
    ({"motor_tau": "0.0"}, r"motor_tau: Input should be greater than 0"),
    ({"motor_tau": "40.0"}, r"motor_tau: Input should be less than or equal to 0\.5"),  # ms
    ({"propeller": "'9 inch'"}, r"propeller: Input should be '3 inch' or '5 inch'"),
    ({"propeller_diameter": "-7.0"}, r"propeller_diameter: Input should be greater than 0"),
    ({"propeller_diameter": "178.0"}, r"propeller_diameter = 178 does not fit .* is it in inches"),  # mm
    ({"propeller_diameter": "17.8"}, r"propeller_diameter = 17\.8 does not fit rotors that are 8\.27 inches"),  # cm
    ({"propeller_diameter": "0.178"}, r"propeller_diameter = 0\.178 does not fit"),  # m
    ({"drag_area": "[0.0, 0.1, 0.1]"}, r"drag_area\.0: Input should be greater than 0"),
    ({"propelller": "'5 inch'"}, r"propelller: unknown key; did you mean 'propeller'\?"),
    ({"arm": "[105, 120]"}, r"arm = \(105\.0, 120\.0\) must be at most 2 m; is it in mm\? write \[0\.105, 0\.12\]"),
    ({"arm": "[10.5, 12]"}, r"arm = \(10\.5, 12\.0\) must be at most 2 m; is it in cm\? write \[0\.105, 0\.12\]"),
    ({"arm": "[1.05, 1.2]"}, r"inertia = .* is too small for 1\.2 kg with rotors 1\.59 m from the centre.* arm in m\?"),
    ({"inertia": "[8e-6, 9e-6, 15e-6]"}, r"inertia = .* is too small .* which have about 0\.0061; is it in kg m\^2"),
    ({"inertia": "[8.0, 9.0, 15.0]"}, r"inertia = .* is too large"),  # g m^2
    (
        {"rates_max": "[700, 700, 300]"},
        r"rates_max\.0: Input should be .* 40 rad/s; is it in deg/s\? 700 deg/s are 12\.2",
    ),
    ({"thrust_max": "13.0"}, r"thrust_max = 13\.0 N must exceed 1\.2 .* one rotor\? four have 52 N"),
    (
        {"thrust_max": "15.0"},
        r"thrust_max = 15\.0 N is 1\.27 times the weight of 11\.77 N, .* 1\.6 times and more; .* 60 N",
    ),
    ({"thrust_max": "5300"}, r"thrust_max = 5300\.0 N is 450 times the weight .* is it in g\? 5300 g are 51\.99 N"),
    ({"thrust_max": "3.0", "mass": "1.0"}, r"thrust_max = 3\.0 N must exceed .* is it in kg\? 3 kg are 29\.43 N"),
    ({"thrust_max": "0.6", "mass": "35.0", "inertia": "[0.1, 0.1, 0.2]"}, r"thrust_max = 0\.6 N .* 35 g are 0\.035 kg"),
    (
        {"mass": "1200.0"},
        r"mass: .* 50 kg; is it in g\? 1\.2e\+03 g are 1\.2 kg|mass: .*; is it in g\? 1200 g are 1\.2 kg",
    ),
    ({"motor_tau": "40.0"}, r"motor_tau: .* 0\.5 s; is it in ms\? 40 ms are 0\.04 s"),
    (
        {"motor_tau": "0.5"},
        r"the roll rate cannot be controlled: a step of 1 rad/s overshoots by \d+% and reaches 63 %",
    ),
    ({"rate_lag": "[80.0, 80.0, 80.0]"}, r"rate_lag\.0: .* 2 s; is it in ms\? 80 ms are 0\.08 s"),
    ({"command_delay": "20"}, r"command_delay: .* 0\.2 s; is it in ms\? 20 ms are 0\.02 s"),
    ({"drag_area": "[350.0, 350.0, 700.0]"}, r"drag_area = .* is too large .* is it in cm\^2\?"),
    ({"name": "3"}, r"name: Input should be a valid string"),
]


@pytest.mark.parametrize(("changes", "message"), IMPOSSIBLE)
def test_impossible_vehicles_are_refused_by_key(vehicle_file, changes, message):
    path = vehicle_file(**changes)
    for use in (lambda: read_vehicle(path), lambda: Scenario(vehicle=str(path))):
        with pytest.raises(ConfigError, match=message) as error:
            use()
        assert "\n" not in str(error.value)
        assert str(path) in str(error.value)


def test_invalid_vehicle_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"nothing\.toml: no such file"):
        read_vehicle(tmp_path / "nothing.toml")
    (tmp_path / "text.toml").write_text("this is a letter")
    with pytest.raises(ConfigError, match=r"text\.toml: not TOML"):
        read_vehicle(tmp_path / "text.toml")


def test_impossible_vehicle_in_preset_is_refused():
    table = dict(
        zip(SEVEN_INCH, (1.2, (0.008, 0.009, 0.015), (0.1, 0.1), 10.0, (8.0, 8.0, 4.0), 0.04, 7.0), strict=True)
    )
    with pytest.raises(ConfigError, match=r"thrust_max = 10\.0 N must exceed"):
        changed(PRESETS["hover/fast"], vehicle=table | {"name": "weak"})
    strong = changed(PRESETS["hover/fast"], vehicle=table | {"name": "strong", "thrust_max": 50.0})
    assert dataclasses.asdict(strong.vehicle)["thrust_max"] == 50.0
