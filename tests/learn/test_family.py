"""One policy for a family of references, and for an unseen reference."""

import pytest

from retrim.config import Setup, changed, load
from retrim.runkit.training import nominal_error


@pytest.mark.usefixtures("optax_promotion")
def test_unseen_reference_is_tracked():
    """Training uses circle and star; the error on the figure-8 is at most 1.5 times that on the circle."""
    size = {"hidden_sizes": (64, 64), "num_updates": 200, "num_envs": 16, "horizon": 100}
    preset = changed(load("track/preview"), track={"reference": "circle+star"}, pretrain=size)
    policy = Setup.from_preset(preset).pretrained()
    circle, unseen = (
        nominal_error(Setup.from_preset(changed(preset, track={"reference": name})), policy)
        for name in ("circle", "figure8")
    )
    assert circle < 0.3  # training succeeded: starts are within 1 m
    assert unseen < 1.5 * circle
