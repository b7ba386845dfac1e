"""The predicted state when a command begins to act is the state of the nominal model at that time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import call, first_order, random_command, random_state
from retrim.estimation.prediction import Prediction
from retrim.physics import ActuatorResponse, Command, CommandPath, PointMass
from retrim.physics.actuator_response import ActuatorState
from retrim.physics.actuators import LaggedModel

DT, TAU = 0.02, 0.033


def prediction_of(lag, ticks):
    return Prediction.of(CommandPath.of(ticks * DT, first_order(lag)), DT)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_prediction_equals_lagged_model(delay, key):
    """Commands in transit act first, each for a tick; then the new one begins."""
    model, d = LaggedModel(PointMass(DT), first_order(TAU)), jnp.array([0.5, -1.0, 0.3])
    k_x, *keys = random.split(key, 9)
    s = model.init(random_state(k_x))
    prediction = prediction_of(TAU, delay)
    memory = prediction.init(model.state(s))
    queue = [Command.hover(s.inner.p.dtype)] * delay
    for k in keys:
        soon, acting = call(prediction, memory, model.state(s), d)
        after = s
        for u in queue:
            after = call(model.step, after, u, d)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), soon, model.state(after))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), acting, after.actuators.command)
        u = random_command(k)
        memory = call(prediction.issue, memory, u)
        queue.append(u)
        s = call(model.step, s, queue.pop(0), d)


def test_prediction_uses_accepted_commands(key):
    x, (k_a, k_b) = random_state(key), random.split(key)
    prediction = prediction_of(TAU, 1)
    commands, accepted_command = random_command(k_a), random_command(k_b)
    message = prediction.accept(call(prediction.issue, prediction.init(x), commands), accepted_command)
    model = call(prediction.issue, prediction.init(x), accepted_command)
    results = (call(prediction, memory, x, jnp.zeros(3)) for memory in (message, model))
    for a, b in zip(*results, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)


def test_old_measurement_is_predicted_to_present(key):
    """The predicted position of a vehicle in a steady turn, measured 20 ms late, is its true position."""
    x, u = random_state(key), random_command(key)
    prediction = prediction_of(0.0, 0)
    memory = prediction.issue(prediction.init(x), u)
    now = call(PointMass(DT).step, x, u, jnp.zeros(3))
    late, _ = call(prediction.with_age(DT), memory, x, jnp.zeros(3))
    np.testing.assert_allclose(late.R, now.R, atol=1e-9)
    np.testing.assert_allclose(late.p, now.p, atol=5e-3)  # the acceleration is assumed constant


def test_prediction_with_fractional_delay_and_underdamped_rate_loop(key):
    """The same model in steps of 1 ms is in the predicted state when the command begins to act."""
    delay, fine = 0.033, 0.001
    response = ActuatorResponse.of(0.05, jnp.array([0.08, 0.1, 0.2]), inverse_damping=1.6)
    prediction, d = Prediction.of(CommandPath.of(delay, response), DT), jnp.array([0.5, -1.0, 0.3])
    k_x, *keys = random.split(key, 7)
    x, model = random_state(k_x), PointMass(fine)
    memory, actuators = prediction.init(x), ActuatorState.at(Command.hover(x.p.dtype))
    commands = [random_command(k) for k in keys]
    arrivals = [round((n * DT + delay) / fine) for n in range(len(commands))]
    expected = {}
    for n, u in enumerate(commands):
        expected[arrivals[n]] = prediction(memory, x, d) if n == len(commands) - 1 else None
        memory = prediction.issue(memory, u)
        for k in range(round(n * DT / fine), round((n + 1) * DT / fine)):
            x, actuators = _fine_step(model, response, commands, arrivals, k, x, actuators, d)
    ((at, result),) = ((at, result) for at, result in expected.items() if result is not None)
    for k in range(len(commands) * round(DT / fine), at):
        x, actuators = _fine_step(model, response, commands, arrivals, k, x, actuators, d)
    np.testing.assert_allclose(result[0].p, x.p, atol=2e-4)
    np.testing.assert_allclose(result[0].v, x.v, atol=5e-3)
    np.testing.assert_allclose(result[1].vector(), actuators.command.vector(), atol=1e-6)


def _fine_step(model, response, commands, arrivals, k, x, actuators, d):
    arrival_list = [n for n, at in enumerate(arrivals) if at <= k]
    u = commands[arrival_list[-1]] if arrival_list else Command.hover(x.p.dtype)
    away, actuators = response(actuators, u, model.dt)
    mean = jax.tree.map(lambda target, each: target + each / model.dt, response.target(u), away)
    return model.step(x, mean, d), actuators
