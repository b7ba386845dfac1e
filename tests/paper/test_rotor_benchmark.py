"""The public benchmark: its plant has the published constants, and its trajectories have the published speeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from retrim.config.references import make_reference
from retrim.config.scenario import Scenario
from retrim.config.vehicles import make_vehicle
from retrim.physics import Command, ExternalEffects, State, so3
from retrim.physics.substep import SIGNS
from retrim.testing import check_plant
from retrim_paper.rotor_benchmark.benchmark import PUBLISHED_ERRORS
from retrim_paper.rotor_benchmark.plant import (
    ARM,
    INERTIA,
    LEAST_AUTHORITY,
    LOSS,
    LOSS_SCALE,
    ROTOR_MAX,
    SimplifiedQuadrotor,
    mix,
    vehicle_file,
)
from retrim_paper.rotor_benchmark.references import NAMES, RADIUS

VEHICLE = make_vehicle(vehicle_file())
MODEL = SimplifiedQuadrotor((VEHICLE.command_min, VEHICLE.command_max), random.key(0), 0.02)
CALM = ExternalEffects.calm(jnp.zeros(0).dtype)


def mean_acceleration(c, v=(0.0, 0.0, 0.0), R=None, ms=400, seed=0):
    """Return the mean acceleration over one millisecond from one state, over many draws of the noise [m/s^2]."""
    x = State(jnp.array([0.0, 0.0, 1.0]), jnp.eye(3) if R is None else R, jnp.array(v))
    start, u = MODEL.init(x), Command(jnp.array(c), jnp.zeros(3))

    def one(key, _):
        after = MODEL.substep(type(start)(start.body, key), u, CALM)
        return after.key, (after.body.x.v - x.v) / 1e-3

    return np.asarray(jax.jit(lambda key: lax.scan(one, key, length=ms)[1])(random.key(seed))).mean(axis=0)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_rotors_lose_published_share_of_input(share):
    thrust = 80.0 * (share - LOSS * (share / LOSS_SCALE) ** 2)
    noise = 80.0 * 0.02 * np.sqrt(share / 4.0 / 400.0)  # standard deviation of the mean
    np.testing.assert_allclose(mean_acceleration(80.0 * share)[2], thrust - 9.80665, atol=4.0 * noise)


def test_drag_is_linear_and_quadratic_in_body_axes():
    v = np.array([3.0, -2.0, 4.0])
    R = so3.exp(jnp.array([0.3, -0.2, 0.5]))
    moving, resting = (mean_acceleration(9.81, v=speed, R=R, seed=1) for speed in (v, np.zeros(3)))
    through = np.asarray(R).T @ v
    drag = np.asarray(R) @ (np.array([0.3, 0.3, 0.0]) * through + 0.08 * through * np.abs(through))
    np.testing.assert_allclose(moving - resting, -drag, atol=1e-6)


def test_body_rates_follow_commands():
    x, u = State.at(jnp.array([0.0, 0.0, 1.0])), Command(jnp.array(9.81), jnp.array([3.0, -2.0, 0.5]))
    end = jax.jit(lambda s: lax.fori_loop(0, 1000, lambda _, s: MODEL.substep(s, u, CALM), s))(MODEL.init(x))
    np.testing.assert_allclose(end.body.omega, u.omega, atol=0.3)  # rotor noise remains


@pytest.mark.parametrize("mean", [0.5, 2.45, 8.0, 19.0])
@pytest.mark.parametrize("change", [(0.3, -0.2, 0.1), (30.0, 5.0, 2.0), (0.0, 0.0, 9.0)])
def test_large_torque_keeps_collective_thrust(mean, change):
    thrusts = np.asarray(mix(jnp.array(mean), jnp.array(change)))
    np.testing.assert_allclose(thrusts.mean(), mean, rtol=1e-5)
    assert thrusts.max() <= ROTOR_MAX + 1e-4
    assert thrusts.min() >= min(0.0, mean - LEAST_AUTHORITY) - 1e-4
    wanted = np.asarray(SIGNS).T @ np.array(change) + mean
    if wanted.min() >= 0.0 and wanted.max() <= ROTOR_MAX:
        np.testing.assert_allclose(thrusts, wanted, rtol=1e-5)


def test_torque_at_hover_is_limited_by_weight_times_arm():
    x = State.at(jnp.array([0.0, 0.0, 1.0]))
    u = Command(jnp.array(9.80665), jnp.array([30.0, 0.0, 0.0]))
    after = MODEL.substep(MODEL.init(x), u, CALM)
    assert 45.0 < float(after.body.omega[0]) / 1e-3 < 9.80665 * ARM / INERTIA[0] + 6.0  # plus rotor noise


def test_plant_is_available_by_name():
    check_plant(Scenario(plant="neural-mpc").make, settle_s=1.5)


@pytest.mark.parametrize("name", NAMES)
def test_trajectories_have_published_mean_speed(name):
    shape, _, speed = name.partition("-5m-")
    reference = make_reference(name)
    begin, end = np.asarray(reference.lap)
    at = jax.vmap(reference)(jnp.linspace(begin, end, 2000))
    mean = np.linalg.norm(np.asarray(at.v), axis=1).mean()
    np.testing.assert_allclose(mean, float(speed), rtol=2e-3)
    extent = np.ptp(np.asarray(at.p), axis=0)
    np.testing.assert_allclose(extent, [2.0 * RADIUS, (2.0 if shape == "circle" else 1.0) * RADIUS, 0.0], atol=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_trajectories_are_within_limits_of_vehicle(name):
    assert make_reference(name).infeasibility(VEHICLE) is None


def test_every_cell_has_published_errors():
    assert tuple(PUBLISHED_ERRORS) == NAMES
    assert PUBLISHED_ERRORS["lemniscate-5m-12"] == (46, 28)
    assert all(cell.perfect < cell.learned for cell in PUBLISHED_ERRORS.values())
