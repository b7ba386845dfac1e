"""Estimates of the thrust gain: reactions of the commands to a disturbance, earlier estimates, and saturated motors."""

import jax.numpy as jnp
import numpy as np
import pytest

from retrim.estimation.command_path import noise
from retrim.estimation.command_path.estimate import NINETY, closed_loop_estimate, normal_estimate
from retrim.estimation.command_path.history import CommandHistory

DT = 0.02


def gain_of(mean, deviation):
    return normal_estimate(jnp.array(mean), jnp.array(deviation), 0.3)


def test_more_certain_estimate_is_in_use():
    earlier, change = gain_of(0.8, 0.02), jnp.array(1e-4)
    assert float(gain_of(1.2, 0.01).or_earlier(earlier, change).mean) == pytest.approx(1.2)
    assert float(gain_of(1.2, 0.1).or_earlier(earlier, change).mean) == pytest.approx(0.8)


def test_earlier_estimate_becomes_less_certain():
    """The variance grows by that of the change, in one step or in many."""
    one = gain_of(1.2, 1.0).or_earlier(gain_of(0.8, 0.02), jnp.array(2e-4))
    many = gain_of(0.8, 0.02)
    for _ in range(20):
        many = gain_of(1.2, 1.0).or_earlier(many, jnp.array(1e-5))
    assert float(one.deviation) == pytest.approx(np.sqrt(6e-4))
    assert float(many.deviation) == pytest.approx(float(one.deviation))
    assert float(one.high - one.low) == pytest.approx(2.0 * NINETY * float(one.deviation))


def test_only_disturbances_widen_gain():
    gain = normal_estimate(jnp.array(1.0), jnp.array(0.02), 0.3)
    widths = [
        float(closed_loop_estimate(gain, jnp.array(share), jnp.array(count), jnp.array(0.3)).deviation)
        for share, count in ((0.0, 400.0), (0.5, 100.0), (0.5, 400.0), (0.5, 1e6))
    ]
    assert widths[0] == pytest.approx(0.02)
    assert widths[0] < widths[1] < widths[2]
    # Without the disturbance's bias, four times the data would halve the deviation.
    assert widths[3] / 100.0 == pytest.approx(widths[2] / 2.0, rel=0.03)


def test_share_of_disturbance_solves_riccati_equation():
    """The variance of the prediction of a random walk in white noise is p = (q + sqrt(q^2 + 4 q)) / 2."""
    for shares, kinds in ((noise.predictable_share(kinds), kinds) for kinds in (noise.DIRECT, noise.DIFFERENCE)):
        for share, (mu, q, phi) in zip(shares, kinds, strict=True):
            p = (q + np.sqrt(q**2 + 4.0 * q)) / 2.0
            if mu == phi == 0.0 and q > 0.0:
                assert share == pytest.approx(p / (1.0 + p), rel=1e-3)
            assert (share == 0.0) == (q == 0.0)
            assert share < 1.0


def test_saturation_grows_with_demand_and_with_small_thrust():
    history = CommandHistory.at_hover(DT)
    for _ in range(5):
        history = history.issue(jnp.array([0.0, 5.0, 0.0, 0.0]))

    def error(history, turning, lag):
        return float(history.saturation(jnp.array(turning), jnp.array(DT), jnp.array(lag), DT))

    assert error(history, [5.0, 0.0, 0.0], 0.03) == 0.0
    assert error(history, [0.0, 0.0, 0.0], 0.03) == pytest.approx(0.1 * (0.034 * 5.0 / 0.03) ** 2 / 9.81, rel=1e-3)
    assert error(history, [0.0, 0.0, 0.0], 0.1) < 0.1 * error(history, [0.0, 0.0, 0.0], 0.03)
    assert error(history, [np.nan, 0.0, 0.0], 0.03) == 0.0
    low = history.issue(jnp.array([-7.0, 5.0, 0.0, 0.0])).issue(jnp.array([-7.0, 5.0, 0.0, 0.0]))
    assert error(low, [0.0, 0.0, 0.0], 0.03) > 2.0 * error(history, [0.0, 0.0, 0.0], 0.03)
