"""Rotor-level models provide command limits, body rates and rotor speeds to a plant."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import CheapModel, random_state, replace_fields
from retrim.physics import BemQuadrotor, Command, LinearDragQuadrotor, RotorState, State, large, small

MODELS = {"linear drag": LinearDragQuadrotor, "bem": BemQuadrotor}


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("vehicle", [small, large])
def test_command_limits_are_those_of_vehicle(make, vehicle):
    low, high = make.of(vehicle(), 0.02).command_limits
    np.testing.assert_array_equal(low.vector(), vehicle().command_min.vector())
    np.testing.assert_array_equal(high.vector(), vehicle().command_max.vector())
    assert (low.vector() < Command.hover().vector()).all()
    assert (high.vector() > Command.hover().vector()).all()


def test_linear_model_clips_commands():
    """A command beyond the limits has the effect of the limit."""
    model = LinearDragQuadrotor.of(small(), 0.02)
    _, high = model.command_limits
    wild = Command(10.0 * high.c, 10.0 * high.omega)
    step = eqx.filter_jit(lambda u: model.step(model.init(State.at(jnp.zeros(3))), u, jnp.zeros(3)))
    jax.tree.map(np.testing.assert_array_equal, step(wild), step(high))


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_rotor_state_follows_command(make, key):
    """Before the first tick, body rates are zero and the rotors equal.

    A roll command gives a roll rate and unequal rotors.
    """
    model = make.of(small(), 0.02, thrust_error=0.0)
    x = random_state(key)
    s = model.init(x)
    result = model.rotor_state(s)
    assert isinstance(result, RotorState)
    jax.tree.map(np.testing.assert_array_equal, result.x, x)
    np.testing.assert_array_equal(result.omega, 0.0)
    np.testing.assert_allclose(result.motors, small().hover_speed, rtol=0.05)
    roll = Command(jnp.array(9.81), jnp.array([3.0, 0.0, 0.0]))
    after = eqx.filter_jit(model.step)(model.init(State.at(jnp.zeros(3))), roll, jnp.zeros(3))
    turning = model.rotor_state(after)
    jax.tree.map(np.testing.assert_array_equal, turning.x, model.state(after))
    assert float(turning.omega[0]) > 0.2
    right, left = turning.motors[jnp.array([0, 2])], turning.motors[jnp.array([1, 3])]
    assert float(left.min()) > float(right.max())


def test_model_without_rates_and_rotors(key):
    """The model translates without rotation: at hover thrust, level and undisturbed, it moves along a straight line."""
    x = replace_fields(random_state(key), R=jnp.eye(3))
    assert CheapModel().command_limits is None
    assert CheapModel().rotor_state(x) is None
    after = CheapModel().step(x, Command.hover(), jnp.zeros(3))
    np.testing.assert_allclose(after.p, x.p + 0.02 * x.v, rtol=1e-12)
