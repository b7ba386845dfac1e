"""Learners that identify the vehicle: the window yields the command path, and the learner uses the delayed commands."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from retrim.adapt.vehicles import IdentifiedVehicle, OwnVehicle
from retrim.estimation.command_path import PathEstimator, ringing_of
from retrim.learn import Window, residual_targets
from retrim.physics import ActuatorResponse, Command, CommandPath, PointMass, State
from retrim.physics.path_family import PathFamily
from retrim.tasks.task import Start

pytestmark = pytest.mark.usefixtures("as_a_user")

DT, N = 0.02, 150
DELAY, LAG, THRUST_LAG, GAIN = 0.05, 0.12, 0.04, 0.8


@pytest.fixture(scope="module")
def window(as_a_user):
    """Return a flight of the point mass with a known command path, under commands that excite it."""
    path = CommandPath.of(DELAY, ActuatorResponse.of(THRUST_LAG, LAG, inverse_damping=1.0, thrust_gain=GAIN))
    model = PointMass(DT)

    def tick(carry, k):
        x, s = carry
        jump = random.normal(random.fold_in(random.key(1), k // 5), (4,))
        u = Command(9.81 / GAIN + 1.5 * jump[0], 0.5 * jump[1:])
        mean, s = path(s, u, DT)
        return (model.step(x, mean, jnp.zeros(3)), s), (x, u)

    @jax.jit
    def fly():
        start = State.at(jnp.array([0.0, 0.0, 1.0]))
        return lax.scan(tick, (start, path.init(Command.hover(), DT)), jnp.arange(N))[1]

    x, u = fly()
    return Window(jnp.arange(N) * DT, x, u, jnp.ones(N, dtype=bool))


@pytest.fixture(scope="module")
def vehicle(as_a_user):
    return IdentifiedVehicle(PathEstimator.of(DT), PathFamily.of())


def test_identification_recovers_command_path(window, vehicle):
    result = eqx.filter_jit(vehicle.identify)(window)
    assert float(result.path.delay) == pytest.approx(DELAY, abs=0.008)
    assert float(result.path.response.thrust_gain) == pytest.approx(GAIN, rel=0.02)
    true = vehicle.family.coordinates(*(jnp.array(v) for v in (DELAY, LAG, float(ringing_of(1.0)), THRUST_LAG)))
    low, high = result.belief.ends
    assert np.all(low[:2] < true[:2] + 0.05)
    assert np.all(high[:2] > true[:2] - 0.05)


def test_identified_path_removes_residual(window, vehicle):
    """With the identified path the residual is small, and without it the residual is large."""

    @eqx.filter_jit
    def residual(vehicles):
        rows = residual_targets(vehicles.apply_path(window), PointMass(DT))
        weight = rows.valid[:, None]
        return jnp.sqrt(jnp.sum(weight * rows.a_res**2) / jnp.sum(weight)), jnp.sum(rows.valid)

    (error, count), (without, _) = residual(vehicle), residual(OwnVehicle())
    assert count > N // 2
    assert float(without) > 1.0
    assert float(error) < 0.15 * float(without)


def test_starts_receive_vehicles_from_belief(window, vehicle):
    x = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (4, 8, *leaf.shape)), State.at(jnp.zeros(3)))
    result = eqx.filter_jit(vehicle.identify)(window)
    starts = eqx.filter_jit(vehicle.assign_vehicles)(
        jax.vmap(jax.vmap(Start))(jnp.zeros((4, 8)), x), result, random.key(0)
    )
    belief = result.belief
    low, high = (vehicle.family.path(end).delay for end in belief.ends)
    delays = starts.member.path.delay
    assert delays.shape == (4, 8)
    assert np.all((delays >= low - 1e-6) & (delays <= high + 1e-6))
    assert len(np.unique(delays)) > 8
    np.testing.assert_allclose(starts.member.belief.centre[2, 3], belief.centre, rtol=1e-5)


def test_empty_window_leaves_belief_wide(window, vehicle):
    empty = dataclasses.replace(window, valid=jnp.zeros(N, dtype=bool))
    belief = eqx.filter_jit(vehicle.identify)(empty).belief
    assert np.all(belief.half_width > 0.5)
    assert not np.any(eqx.filter_jit(vehicle.apply_path)(empty).valid)
