"""From a policy and a scenario to a live flight: an invalid flight is refused before its processes start."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.errors import ConfigError
from retrim.live.session import LiveRequest, live_spec
from retrim.tasks import Hover

pytestmark = pytest.mark.usefixtures("optax_promotion")


class InfiniteReference(Hover):
    """A user's task, whose reference is infinite after two seconds."""

    def target(self, t):
        return jnp.where(t < 2.0, 1.0, jnp.inf) * super().target(t)


def request_for(task, folder, seconds):
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset())
        fields = {each.name: getattr(setup.flight_task, each.name) for each in dataclasses.fields(setup.flight_task)}
        setup = dataclasses.replace(setup, flight_task=task(**fields))
        return LiveRequest(setup, setup.new_policy(random.key(0)), Scenario(), "full", seconds, 0, 3.0, folder)


def test_fence_contains_reference_and_infinite_reference_is_refused(tmp_path):
    limits = live_spec(request_for(InfiniteReference, tmp_path, 2.0)).limits
    home = np.asarray(request_for(Hover, tmp_path, 2.0).setup.flight_task.home())
    np.testing.assert_allclose(limits.high, home + 3.0)
    assert limits.find_violation(np.concatenate([home + np.array([3.1, 0.0, 0.0]), np.eye(3).ravel(), np.zeros(3)]))
    with pytest.raises(ConfigError, match=r"its reference is not finite at 2 s; no fence can hold it"):
        live_spec(request_for(InfiniteReference, tmp_path, 4.0))
