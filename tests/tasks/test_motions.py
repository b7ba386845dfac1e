"""Random motions have their stated width, and the motions of a preset are those of its encoder."""

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import GOAL
from retrim import Setup, changed, load
from retrim.config.presets import Vision
from retrim.physics import so3
from retrim.tasks.motions import MOTIONS, NEAR, WILD


@pytest.mark.parametrize("motions", [NEAR, WILD])
def test_motions_have_stated_width(motions, key):
    @jax.jit
    @jax.vmap
    def draw(key):
        x, omega = motions.draw(key, jnp.array(GOAL))
        return x, omega, so3.log(x.R)

    x, omega, turn_rates = draw(random.split(key, 4000))
    off = np.asarray(x.p) - np.array(GOAL)
    assert np.abs(off).max() <= motions.box
    np.testing.assert_allclose(off.std(axis=0), motions.box / 3**0.5, rtol=0.05)
    np.testing.assert_allclose(np.asarray(x.v).std(axis=0), motions.speed, rtol=0.05)
    np.testing.assert_allclose(np.asarray(omega).std(axis=0), motions.rates, rtol=0.05)
    # About a horizontal axis the vehicle tilts; about the vertical axis it also turns.
    np.testing.assert_allclose(np.asarray(turn_rates)[:, :2].std(axis=0), motions.tilt, rtol=0.1)
    np.testing.assert_allclose(np.asarray(turn_rates)[:, 2].std(), np.hypot(motions.tilt, motions.turn), rtol=0.1)


@pytest.mark.usefixtures("optax_promotion")
def test_encoder_uses_motions_of_preset():
    assert set(get_args(Vision.__annotations__["encoder_motions"])) == set(MOTIONS)

    def with_motions(motions):
        small = {"num_updates": 1, "num_envs": 1, "horizon": 2, "hidden_sizes": [8, 8]}
        vision = {"encoder_steps": 3, "encoder_motions": motions, "whiten_pixels": False}
        return Setup.from_preset(changed(load("vision/paper"), pretrain=small, vision=vision))

    near, wild = with_motions("near"), with_motions("wild")
    once, again = (np.asarray(wild.pretrained(0).layers[0].weight) for _ in range(2))
    assert np.any(np.asarray(near.pretrained(0).layers[0].weight) != once)
    np.testing.assert_array_equal(once, again)
