"""The layers of hover/retrim, end to end: effective gravity compensates, and learning does not disturb it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import CheapModel
from retrim.config import Setup, changed, load
from retrim.config.faults import measurement_fault
from retrim.io.policies import load_learner_state, save_learner_state
from retrim.physics import Push
from retrim.plants import SensorModel, SimPlant
from retrim.runtime import fly

pytestmark = pytest.mark.usefixtures("as_a_user")


@pytest.fixture(scope="module")
def trained_policy(as_a_user):
    brief = {"hidden_sizes": (32, 32), "num_envs": 8, "num_updates": 200, "horizon": 100, "learning_rate": 0.01}
    setup = Setup.from_preset(changed(load("hover/retrim"), pretrain=brief, adapt={"num_envs": 4}))
    return setup, setup.pretrained(0)


@pytest.fixture(scope="module")
def flights(trained_policy):
    """Return 6 s of flight from one start with each layer, with a step of 2 m/s^2 per axis at 3 s."""
    step = Push(lambda t, x: jnp.where(t < 3.0, 0.0, 2.0) * jnp.ones(3))
    setup, policy = trained_policy

    def flight(method, sensors=None, fault=None):
        pilot = setup.pilot(policy, method, random.key(1))
        plant = SimPlant(CheapModel(0.02), step, sensors=sensors, fault=fault, seed=3)
        log = fly(plant, pilot, setup.flight_starts(1, 4)[0], ticks=300)
        return log, np.linalg.norm(log.p - np.array(setup.preset.goal), axis=1), pilot

    rough = SensorModel.of(position=1e-3, velocity=1e-2, attitude=3e-3, latency=10, dropout=0.05)
    return {name: flight(name) for name in ("base", "base-do", "full")} | {
        "rough": flight("full", rough),
        "spikes": flight("full", fault=measurement_fault("velocity-spikes")),
    }


@pytest.mark.parametrize("layers", ["base-do", "full", "rough"])
def test_step_is_rejected_within_two_seconds(flights, layers):
    log, error, _ = flights[layers]
    base = flights["base"][1]
    assert base[log.t > 5.2].min() > 0.2
    assert error[(log.t > 2.0) & (log.t < 3.0)].max() < 0.03
    assert error[log.t > 5.0].max() < 0.05
    assert error[log.t > 5.2].mean() < 0.1 * base[log.t > 5.2].mean()


def test_wrong_velocities_are_excluded_and_reported(flights):
    """One velocity in 25 is wrong by 2 m/s."""
    log, error, pilot = flights["spikes"]
    # including the step at 3 s and the wrong velocities, which the policy receives
    assert error[log.t > 2.0].max() < 0.2
    assert error[log.t > 5.2].mean() < 0.3 * flights["base"][1][log.t > 5.2].mean()
    notes = [event.note for event in pilot.events if event.kind == "residual"]
    assert "velocity is not the derivative of position" in notes[-1]
    np.testing.assert_allclose(pilot.state.residual.mean[:3], 2.0, atol=0.4)


def test_learning_does_not_degrade_lower_layer(flights):
    log, in_frame, _ = flights["base-do"]
    _, learning, pilot = flights["full"]
    kinds = [event.kind for event in pilot.events]
    assert kinds.count("residual") > 20
    assert kinds.count("policy") + kinds.count("rejected") > 8
    for since in (2.0, 5.0):
        late = (log.t > since) & (log.t < since + 1.0)
        assert learning[late].mean() < in_frame[late].mean() + 0.005


def test_residual_equals_push(flights):
    """After the step, its constant is the push, and the calm before has no effect any more."""
    _, _, pilot = flights["full"]
    np.testing.assert_allclose(pilot.state.residual.mean[:3], 2.0, atol=0.3)


def test_learner_state_is_saved(flights, trained_policy, tmp_path):
    setup, _ = trained_policy
    _, _, pilot = flights["full"]
    save_learner_state(tmp_path / "learner_state.safetensors", pilot.state, setup.preset)
    state, preset = load_learner_state(tmp_path / "learner_state.safetensors")
    assert preset == setup.preset
    jax.tree.map(np.testing.assert_array_equal, state, pilot.state)
