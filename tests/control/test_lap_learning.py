"""Learning over laps removes the repeating error, and other errors do not disturb it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from retrim.control.controller import AbstractController
from retrim.control.lap_learning import LARGEST, LARGEST_ERROR, LapLearning
from retrim.physics import Command, State
from retrim.tasks.abstract_reference import AbstractReference
from retrim.tasks.reference import Reference
from retrim.tasks.shapes import circle, figure8

LAG = 0.1  # [s]


class Follower(AbstractController[tuple[()]]):
    """A controller that commands the slightly delayed position of its reference as body rates."""

    reference: AbstractReference

    def init(self, x):
        return ()

    def __call__(self, memory, t, x):
        return Command(jnp.array(9.81), self.reference(t - LAG).p), memory


def errors(reference, seconds=60.0, bias=0.0, noise=0.0, off=0.0):
    """Move a vehicle to the commanded positions plus a bias; return the errors over time, and the last shift."""
    learning = LapLearning.of(Follower(reference), reference, 0.02)
    noises = noise * np.random.default_rng(0).normal(size=(round(seconds / 0.02), 3))

    @jax.jit
    def run():
        def tick(carry, xs):
            memory, p = carry
            t, own = xs
            error = p - reference(t).p
            u, memory = learning(memory, t, State.at(p + own))
            return (memory, u.omega + jnp.array([bias, 0.0, off])), error

        start = reference(jnp.array(0.0)).p
        times = 0.02 * jnp.arange(round(seconds / 0.02), dtype=float)
        (memory, _), result = lax.scan(tick, (learning.init(State.at(start)), start), (times, jnp.asarray(noises)))
        return memory.shift, result

    shift, result = run()
    return np.linalg.norm(result, axis=1), np.asarray(shift)


@pytest.mark.parametrize("make", [circle, figure8])
def test_lag_and_bias_vanish(make):
    result, _ = errors(make(), bias=0.05)
    assert result[400:450].mean() > 0.03
    assert result[-250:].mean() < 0.05 * result[400:450].mean()


def test_noise_is_not_learned():
    _, shift = errors(circle(), noise=0.02)
    _, without = errors(circle())
    assert np.abs(shift - without).max() < 5e-3


def test_large_error_is_not_learned():
    _, shift = errors(circle(), seconds=20.0, off=2.0 * LARGEST_ERROR)
    assert (shift == 0.0).all()


def test_shift_is_bounded():
    _, shift = errors(circle(), off=0.8 * LARGEST_ERROR)
    assert np.abs(shift).max() <= LARGEST
    assert np.abs(shift[2]).max() == pytest.approx(LARGEST)


def test_path_without_laps_is_not_shifted():
    once = Reference.of(lambda t: [np.sin(0.5 * t), 0.0, 1.0], seconds=10.0)
    result, shift = errors(once, seconds=8.0, bias=0.05)
    assert (shift == 0.0).all()
    assert result[-50:].mean() > 0.04
