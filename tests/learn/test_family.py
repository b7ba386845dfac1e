"""One policy for a family of references, and for one that it never saw."""

import pytest

from retrim.config import factory as build
from retrim.config import presets
from retrim.experiments.training import nominal_error


@pytest.mark.usefixtures("optax_promotion")
def test_a_reference_that_was_never_seen_is_tracked_as_well():
    """Trained on circle and star; the figure-8 within 1.5 times the error of the circle."""
    size = {"hidden": (64, 64), "epochs": 200, "envs": 16, "horizon": 100}
    preset = presets.changed(presets.load("track"), reference="circle+star", pretrain=size)
    policy = build.pretrained(preset)
    circle, unseen = (nominal_error(presets.changed(preset, reference=name), policy) for name in ("circle", "figure8"))
    assert circle < 0.3  # it did learn: starts lie 1 m around
    assert unseen < 1.5 * circle
