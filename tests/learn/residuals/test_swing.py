"""The residual model for a vehicle with a load: the learned vehicle parameters do not contain the pull."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from loads import DT, flight
from retrim.learn.residuals import RegressionModel, SwingModel, Targets
from retrim.physics import Command, State
from retrim.testing import check_residual

REGRESSION = RegressionModel.of(DT, memory=2.0, thrust_prior=0.2)
WINDOW, EVERY = 150, 25
MODEL = SwingModel(REGRESSION, DT, EVERY * DT)

fit = eqx.filter_jit(lambda model, state, rows: model.fit(state, rows))


def windows(rows, every=EVERY):
    """Return the windows of a flight, as targets with a level attitude."""
    n = len(rows.v)
    for end in range(WINDOW, n + 1, every):
        part = jax.tree.map(lambda leaf, end=end: leaf[end - WINDOW : end], rows)
        u = jax.vmap(Command)(part.thrust[:, 2], jnp.zeros((WINDOW, 3)))
        x = jax.vmap(lambda p, v: State(p, jnp.eye(3), v))(part.p, part.before)
        yield Targets(x, u, part.missed, jnp.zeros((WINDOW, 3)), jnp.ones(WINDOW, dtype=bool))


def learn(model, rows):
    state = model.init(random.key(0))
    for window in windows(rows):
        state, _ = fit(model, state, window)
    return state


def drag_of(model, state):
    """Return the predicted acceleration per velocity along x, at hover."""
    x = State(jnp.zeros(3), jnp.eye(3), jnp.array([0.5, 0.0, 0.0]))
    hover = Command.hover()
    return -float((model.predict(state, x, hover) - model.predict(state, State.at(jnp.zeros(3)), hover))[0]) / 0.5


def test_conformance():
    check_residual(MODEL)


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_pull_is_separated_from_vehicle_parameters(share, key):
    rows = flight(share, key=key, noise=0.1, ticks=400)
    state = learn(MODEL, rows)
    pulls = np.asarray(state.pulls[-WINDOW:])
    expected = np.asarray(rows.pull[-WINDOW:])
    errors, changes = (np.asarray(a) for a in (pulls - expected, expected))
    # a constant part is equivalent to a push
    errors, changes = errors - errors.mean(axis=0), changes - changes.mean(axis=0)
    assert np.linalg.norm(errors, axis=1).mean() < 0.15 * np.linalg.norm(changes, axis=1).mean()
    load = MODEL.load(state)
    assert float(load.share) == pytest.approx(share, abs=0.02 + 0.1 * share)
    assert float(load.length) == pytest.approx(0.5, rel=0.1)


def test_swing_is_not_identified_as_drag(key):
    rows = flight(0.2, key=key, noise=0.1, ticks=400)
    errors = [abs(drag_of(model, learn(model, rows)) - 0.3) for model in (MODEL, REGRESSION)]
    assert errors[0] < 0.08 < 0.12 < errors[1]


def test_model_without_load_equals_regression(key):
    rows = flight(1e-6, key=key, noise=0.1, ticks=400)
    state, plain = learn(MODEL, rows), learn(REGRESSION, rows)
    assert drag_of(MODEL, state) == pytest.approx(drag_of(REGRESSION, plain), abs=0.05)
    assert float(MODEL.load(state).share) < 0.02


def test_body_rates_equal_regression(key):
    state = learn(MODEL, flight(0.3, key=key, ticks=200))
    jax.tree.map(np.testing.assert_array_equal, MODEL.turning(state), REGRESSION.turning(state.first))
    assert MODEL.turning(state) is not None
