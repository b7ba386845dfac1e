"""One policy for a family of references, and for one that it never saw."""

import pytest

from retrim.config import Setup, changed, load
from retrim.runkit.training import nominal_error


@pytest.mark.usefixtures("optax_promotion")
def test_a_reference_that_was_never_seen_is_tracked_as_well():
    """Trained on circle and star; the figure-8 within 1.5 times the error of the circle."""
    size = {"hidden_sizes": (64, 64), "num_updates": 200, "num_envs": 16, "horizon": 100}
    preset = changed(load("track/preview"), track={"reference": "circle+star"}, pretrain=size)
    policy = Setup.from_preset(preset).pretrained()
    circle, unseen = (
        nominal_error(Setup.from_preset(changed(preset, track={"reference": name})), policy)
        for name in ("circle", "figure8")
    )
    assert circle < 0.3  # it did learn: starts lie 1 m around
    assert unseen < 1.5 * circle
