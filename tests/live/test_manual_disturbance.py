"""Knobs: an operator disturbs a simulated vehicle; the plant refuses effects that it does not have."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from retrim.config.scenario import Scenario
from retrim.errors import MessageError, PlantError
from retrim.live.operator.manual_disturbance import KICK_S, ManualDisturbance, PlantWithKnobs
from retrim.onboard.messages import pack_note
from retrim.physics import Command, State
from retrim.plants.plant import Measurement, Plant, as_numpy


def add_knobs(plant="simple", **scenario):
    scenario = Scenario(plant=plant, **scenario)
    setup = scenario.make("small")
    setup.reset(None)
    return PlantWithKnobs(setup, scenario.make_disturbance("small"))


def speeds(plant, ticks):
    """Return the velocity after each tick of hover commands."""
    return np.array([np.asarray(plant.step(Command.hover(jnp.zeros(0).dtype))[0].v) for _ in range(ticks)])


def test_knobs_survive_round_trip():
    knobs = ManualDisturbance((1.0, -2.0, 0.5), (3.0, 0.0, -1.0), 0.05, 0.8, (8.0, 0.0, 0.0), 3)
    assert ManualDisturbance.unpack(knobs.pack()) == knobs


@pytest.mark.parametrize(
    "fields",
    [
        {"push": [9.0, 0.0, 0.0]}, {"push": [float("nan"), 0.0, 0.0]}, {"push": [0.0, 0.0]}, {"push": "up"},
        {"wind": None}, {"load": -0.1}, {"load": 1e9}, {"rotor": 0.1}, {"rotor": "weak"}, {"kicks": -1},
        {"kicks": float("inf")}, {"kick": [99.0, 0.0, 0.0]},
    ],
)  # fmt: skip
def test_invalid_knobs_are_refused(fields):
    good = json.loads(json.dumps(vars(ManualDisturbance())))
    assert ManualDisturbance.unpack(pack_note("knobs", **good)) == ManualDisturbance()
    with pytest.raises(MessageError, match="knobs"):
        ManualDisturbance.unpack(pack_note("knobs", **(good | fields)))


def test_push_accelerates_vehicle_until_knob_is_reset():
    plant, plain = add_knobs(), add_knobs()
    plant.turn(ManualDisturbance(push=(1.0, 0.0, 0.0)))
    with_push = speeds(plant, 10) - speeds(plain, 10)
    np.testing.assert_allclose(with_push[-1], [0.2, 0.0, 0.0], atol=0.01)
    plant.turn(ManualDisturbance())
    after = speeds(plant, 10)[:, 0]
    np.testing.assert_allclose(after, after[0], atol=0.02)


def test_knobs_add_to_disturbance():
    both, alone = add_knobs(disturbance="push=1"), add_knobs(disturbance="push=1")
    both.turn(ManualDisturbance(push=(-1.0, 0.0, 0.0)))
    difference = speeds(both, 10)[-1] - speeds(alone, 10)[-1]
    np.testing.assert_allclose(difference, [-0.2, 0.0, 0.0], atol=0.01)


def test_kick_is_short_and_acts_once():
    plant, plain = add_knobs(), add_knobs()
    kick = ManualDisturbance(kick=(8.0, 0.0, 0.0), kicks=1)
    plant.turn(kick)
    gain = (speeds(plant, 30) - speeds(plain, 30))[:, 0]
    assert abs(int(np.argmax(gain)) - (round(KICK_S / 0.02) - 1)) <= 1  # afterwards, drag reduces the speed
    np.testing.assert_allclose(gain.max(), 8.0 * KICK_S, rtol=0.1)
    before = speeds(plant, 1)[0, 0]
    plant.turn(kick)  # the same message again, as after a change of another knob
    assert abs(speeds(plant, 5)[-1, 0] - before) < 0.2


@pytest.mark.parametrize(
    "knobs", [ManualDisturbance(load=0.05), ManualDisturbance(rotor=0.7), ManualDisturbance(wind=(4.0, 0.0, 0.0))]
)
def test_every_knob_moves_vehicle(knobs):
    plant, plain = add_knobs(), add_knobs()
    plant.turn(knobs)
    assert np.abs(speeds(plant, 15) - speeds(plain, 15)).max() > 0.02


def test_plant_without_effect_flies_on_and_refuses_it():
    plant, plain = add_knobs("rotorpy"), add_knobs("rotorpy")
    plant.turn(ManualDisturbance(load=0.1, push=(1.0, 0.0, 0.0)))
    np.testing.assert_array_equal(speeds(plant, 5), speeds(plain, 5))
    assert "cannot carry a load" in plant.refusal
    plant.turn(ManualDisturbance(push=(1.0, 0.0, 0.0)))
    assert plant.refusal == ""
    assert speeds(plant, 5)[-1, 0] - speeds(plain, 5)[-1, 0] > 0.05


def test_plant_without_knobs_refuses_them_and_raises_own_errors():
    class Bare(Plant):
        dt = 0.02

        def reset(self, x0):
            return Measurement(0.0, State.at(jnp.zeros(3)))

        def step(self, u):
            if as_numpy(u)[0] > 20:
                raise PlantError("too much")
            return self.reset(None), u

        def stop(self):
            pass

    plant = PlantWithKnobs(Bare(), Scenario().make_disturbance())
    plant.turn(ManualDisturbance(push=(1.0, 0.0, 0.0)))
    assert plant.refusal == "this plant has no knobs"
    assert plant.step(Command.hover(jnp.zeros(0).dtype))[0].t == 0.0
    with pytest.raises(PlantError, match="too much"):
        plant.step(Command.of(jnp.array([30.0, 0.0, 0.0, 0.0])))
