"""Velocities from poses: exact for parabolas and for turns at a constant rate, and without delay."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retrim.plants.bridges.pose_velocities import PoseVelocities


def velocities(times, place, attitude=lambda t: np.eye(3)):
    """Return the velocities and body rates after each pose."""
    series = PoseVelocities()
    result = [series.update(t, place(t), attitude(t)) for t in times]
    return np.array([v for v, _ in result]), np.array([omega for _, omega in result])


@pytest.mark.parametrize("rate", [20.0, 50.0, 100.0, 333.0])
def test_parabola_and_constant_turn_are_exact(rate):
    times = 1e5 + np.arange(40) / rate
    p0, v0, a0 = np.array([1.0, -2.0, 0.5]), np.array([3.0, 0.2, -1.0]), np.array([-4.0, 9.0, 20.0])
    R0, turn = Rotation.from_rotvec([0.4, -0.2, 1.0]), np.array([3.0, -6.0, 2.0])
    s = times - times[0]
    v, omega = velocities(
        times,
        lambda t: p0 + v0 * (t - times[0]) + 0.5 * a0 * (t - times[0]) ** 2,
        lambda t: (R0 * Rotation.from_rotvec(turn * (t - times[0]))).as_matrix(),
    )
    np.testing.assert_allclose(v[12:], v0 + s[12:, None] * a0, atol=1e-5)
    np.testing.assert_allclose(omega[12:], np.broadcast_to(turn, omega[12:].shape), atol=1e-5)


@pytest.mark.parametrize("rate", [30.0, 50.0, 100.0, 200.0])
def test_oscillation_of_three_hertz_is_not_late(rate):
    times, w = np.arange(600) / rate, 2.0 * np.pi * 3.0
    v, _ = velocities(times, lambda t: np.array([np.sin(w * t) / w, 0.0, 0.0]))
    response = 2.0 * np.mean((v[:, 0] * np.exp(-1j * w * times))[100:500])
    assert abs(response) == pytest.approx(1.0, abs=0.15)
    assert abs(np.angle(response)) / w < 0.005


def test_noise_of_positions_is_amplified_as_stated():
    noise = 1e-3 * np.random.default_rng(0).normal(size=(2000, 3))
    v, _ = velocities(0.01 * np.arange(2000), lambda t: noise[round(100.0 * t)])
    assert v[10:].std() == pytest.approx(0.08, rel=0.1)


def test_repeated_pose_gap_and_restart():
    series, R = PoseVelocities(), np.eye(3)
    for t in np.arange(0.0, 0.2, 0.01):
        v, _ = series.update(t, np.array([t, 0.0, 0.0]), R)
    np.testing.assert_allclose(v, [1.0, 0.0, 0.0], atol=1e-9)
    again, _ = series.update(0.19, np.array([5.0, 0.0, 0.0]), R)  # the same time
    np.testing.assert_array_equal(again, v)
    series.restart()
    kept, _ = series.update(7.0, np.array([9.0, 0.0, 0.0]), R)
    np.testing.assert_array_equal(kept, v)
    after_gap, _ = series.update(8.0, np.array([1.0, 0.0, 0.0]), R)
    np.testing.assert_array_equal(after_gap, np.zeros(3))
