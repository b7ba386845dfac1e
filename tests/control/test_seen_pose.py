"""Controllers that need the state, flown from keypoints: they hold and reject a step, and see nothing but points."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from helpers import GOAL, hover_task
from retrim.control.geometric import Gains, Geometric
from retrim.control.indi import Incremental
from retrim.control.seen_pose import SeenPose
from retrim.estimation.prediction import Prediction
from retrim.physics import Command, PointMass, State, small
from retrim.physics.actuators import Lagged
from retrim.tasks import Keypoints, OccludedKeypoints

DT, TAU = 0.02, jnp.array(0.033)
HEADING = 0.0


def made(kind, *, noise=1.0, dropout=0.05):
    """As tables fly them, with loops of the speed that the camera's delay-free frames allow."""
    gains = Gains(jnp.array(12.0), jnp.array(6.0), jnp.array(12.0), jnp.array(12.0 if kind == "geometric-i" else 0.0))
    task, ahead = hover_task(heading=HEADING), Prediction(TAU, DT, 1)
    inner = {
        "geometric-i": lambda: Geometric(task, gains, ahead, jnp.array(6.0)),
        "indi": lambda: Incremental(task, gains, ahead, jnp.array(0.08)),
    }[kind]()
    full = Keypoints.of(jnp.array(GOAL), small().omega_max, whitened=False, noise=noise)
    return SeenPose(OccludedKeypoints(full, jnp.array(dropout), lag=TAU, delay_ticks=1), inner)


@pytest.mark.parametrize("kind", ["geometric-i", "indi"])
def test_it_hovers_and_rejects_a_step_by_what_the_camera_sees(kind):
    controller, model = made(kind), Lagged(PointMass(DT), TAU)
    x0 = State(jnp.array([0.3, -0.2, 1.2]), jnp.eye(3), jnp.zeros(3))

    def tick(carry, k):
        s, memory, waiting = carry
        t = DT * k.astype(float)
        u, memory = controller(memory, t, model.state(s))
        push = jnp.where(t >= 6.0, jnp.array([1.0, -0.5, 0.5]), 0.0)
        return (model.step(s, waiting, push), memory, u), model.state(s)

    start = (model.init(x0), controller.init(x0), Command.hover(x0.p.dtype))
    path = jax.jit(lambda: lax.scan(tick, start, jnp.arange(600))[1])()
    off = np.linalg.norm(np.asarray(path.p) - np.array(GOAL), axis=1)
    assert off[200:300].mean() < 0.02  # calm
    assert 0.01 < off[300:400].max() < 0.3  # the step is felt
    assert off[-100:].mean() < 0.02  # and rejected


def test_it_sees_nothing_but_points():
    """With no point seen, its commands follow from the filter and the clock, wherever the vehicle is."""
    call = eqx.filter_jit(made("indi", dropout=1.0))
    here = State(jnp.array(GOAL), jnp.eye(3), jnp.zeros(3))
    memory = made("indi", dropout=1.0).init(here)
    there = State(jnp.array([2.0, -1.0, 3.0]), jnp.eye(3), jnp.ones(3))
    (u, after), (other, _) = (call(memory, jnp.array(0.0), x) for x in (here, there))
    np.testing.assert_array_equal(u.vector(), other.vector())
    accepted = made("indi").accepted(after, Command.hover())
    np.testing.assert_array_equal(accepted.last.vector(), Command.hover().vector())
    seeing = eqx.filter_jit(made("indi", dropout=0.0))
    u, other = (seeing(memory, jnp.array(0.0), x)[0] for x in (here, there))
    assert np.any(np.asarray(u.vector()) != np.asarray(other.vector()))
