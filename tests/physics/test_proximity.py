"""Forces near surfaces and below a second vehicle, compared with their sources and with conservation laws."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from retrim.config.disturbances import disturbance
from retrim.config.scenario import Scenario
from retrim.physics import Downwash, State, TableEdge, large
from retrim.physics.downwash import half_width, jet_speed
from retrim.physics.propeller import AIR_DENSITY
from retrim.physics.proximity import LANDING_GEAR, ceiling_gain, ground_gain
from retrim.physics.state import STANDARD_GRAVITY, Command

RADIUS = jnp.array(0.065)


@pytest.mark.parametrize(("heights", "ratio"), [(1.0, 16.0 / 15.0), (2.0, 64.0 / 63.0), (0.5, 4.0 / 3.0)])
def test_ground_effect_equals_cheeseman_and_bennett(heights, ratio):
    np.testing.assert_allclose(ground_gain(heights * RADIUS, RADIUS), ratio, rtol=1e-6)


def test_ceiling_effect_conserves_momentum_and_energy():
    for distance in (0.5, 1.0, 2.0):
        free, near = 1.0, float(ceiling_gain(distance * RADIUS, RADIUS)) ** 1.5  # at equal power, v_i = P / T
        # With x = v_wake / v_i, energy gives T ~ x^2 / 2, momentum gives T ~ x + 1 / (16 delta^2).
        x = 2.0 * near
        np.testing.assert_allclose(0.5 * x**2, x + 1.0 / (16.0 * distance**2), rtol=1e-5)
        assert near > free


def test_distant_surfaces_have_no_effect():
    np.testing.assert_allclose(ground_gain(jnp.array(10.0), RADIUS), 1.0, atol=1e-5)
    np.testing.assert_allclose(ceiling_gain(jnp.array(10.0), RADIUS), 1.0, atol=1e-5)


def test_only_rotors_above_table_are_affected():
    table, arm = TableEdge.of(0.9, 1.0, large()), large().arm[0]
    gain = np.asarray(table(jnp.array(0.0), State.at(jnp.array([1.0, 0.0, 0.96]))).gain)
    over = np.asarray(table.rotors.places)[:, 0] > 0.0
    assert over.sum() == 2
    assert arm > large().propeller.radius  # so that all disks are on one side of the edge
    np.testing.assert_allclose(gain[over], ground_gain(jnp.array(0.06), large().propeller.radius), rtol=1e-5)
    np.testing.assert_allclose(gain[~over], 1.0, atol=1e-3)


def test_gain_is_continuous_across_edge():
    table = TableEdge.of(0.9, 1.0, large())
    xs = np.linspace(0.7, 1.3, 601)
    gain = np.array([table(jnp.array(0.0), State.at(jnp.array([x, 0.0, 0.96]))).gain for x in xs[::10]])
    assert np.abs(np.diff(gain, axis=0)).max() < 0.02


def test_clearance_is_measured_from_lowest_point():
    table = TableEdge.of(0.9, 1.0)
    np.testing.assert_allclose(table.clearance(State.at(jnp.array([1.5, 0.0, 1.0]))), 0.1 - LANDING_GEAR, atol=1e-6)
    np.testing.assert_allclose(table.clearance(State.at(jnp.array([0.5, 0.0, 1.0]))), 1.0 - LANDING_GEAR, atol=1e-6)


@pytest.mark.parametrize("below", [0.0, 0.5, 2.0])
def test_momentum_flux_of_jet_equals_weight(below):
    weight, r = large().mass * STANDARD_GRAVITY, np.linspace(0.0, 3.0, 30_001)
    speed = np.asarray(jet_speed(jnp.array(below), jnp.asarray(r**2), weight, large().propeller.radius))
    momentum = AIR_DENSITY * np.trapezoid(2.0 * np.pi * r * speed**2, r)
    np.testing.assert_allclose(momentum, weight, rtol=1e-3)
    half = float(half_width(jnp.array(below), large().propeller.radius))
    np.testing.assert_allclose(np.interp(half, r, speed), 0.5 * speed[0], rtol=1e-3)


def test_jet_has_far_wake_velocity_at_rotors():
    vehicle = large()
    induced = np.sqrt(vehicle.mass * STANDARD_GRAVITY / (2.0 * AIR_DENSITY * 4.0 * vehicle.propeller.area))
    at_rotors = jet_speed(jnp.array(0.0), jnp.array(0.0), vehicle.mass * STANDARD_GRAVITY, vehicle.propeller.radius)
    np.testing.assert_allclose(at_rotors, 2.0 * induced, rtol=1e-5)


def test_no_downwash_above_second_vehicle():
    jet = Downwash.of(jnp.array([0.0, 0.0, 2.0]))
    for height, blows in ((2.1, False), (1.9, True)):
        wind = jet(jnp.array(0.0), State.at(jnp.array([0.0, 0.0, height]))).wind
        assert bool(wind[2] < 0.0) is blows


def test_scenario_adapts_disturbance_to_vehicle():
    for name in ("table-edge", "ceiling", "downwash", "small+table-edge"):
        big, little = (Scenario(name, vehicle=vehicle).make_disturbance() for vehicle in ("large", "small"))
        assert not eqx.tree_equal(big, little)
    assert float(disturbance("ceiling=0.1").height) == pytest.approx(1.1)


def test_hover_commands_climb_near_surface_and_sink_under_second_vehicle():
    cases = (("table-edge", (1.5, 0.0, 1.0), 1), ("ceiling", (0.0, 0.0, 1.0), 1), ("downwash", (2.0, 0.0, 1.0), -1))
    for name, place, sign in cases:
        heights = []
        for case in (name, "none"):
            with Scenario(case, vehicle="large", thrust_error=0.0).make() as plant:
                plant.reset(State.at(jnp.array(place)))
                for _ in range(10):
                    measurement, _ = plant.step(Command.hover(jnp.zeros(0).dtype))
            heights.append(float(measurement.p[2]))
        assert sign * (heights[0] - heights[1]) > 1e-3, name
