"""Frames of autopilots: laws of rotations, and known values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from retrim.plants.bridges import frames

vectors = arrays(float, 3, elements=st.floats(-100.0, 100.0))
quaternions = arrays(float, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: q @ q > 0.01)


def about(axis, angle):
    """Return the quaternion of a rotation about a body axis."""
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.eye(3)[axis]])


@given(vectors)
def test_frame_conversion_is_involution(v):
    np.testing.assert_allclose(frames.turn_world(frames.turn_world(v)), v)
    np.testing.assert_allclose(frames.turn_body(frames.turn_body(v)), v)
    assert frames.turn_heading(frames.turn_heading(v[0])) == pytest.approx(v[0])


@given(vectors, vectors)
def test_frames_are_right_handed(a, b):
    for rotation in (frames.turn_world, frames.turn_body):
        np.testing.assert_allclose(rotation(np.cross(a, b)), np.cross(rotation(a), rotation(b)), atol=1e-9)


@given(quaternions)
def test_attitudes_survive_round_trip(q):
    R = frames.attitude_of(q)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)
    back = frames.quaternion_of(R)
    assert back[0] >= 0.0
    np.testing.assert_allclose(frames.attitude_of(back), R, atol=1e-9)


@given(quaternions, vectors)
def test_body_vector_is_equal_in_both_worlds(q, v):
    w, xyz = q[0], q[1:]
    in_ned = (2 * np.outer(xyz, xyz) + (w * w - xyz @ xyz) * np.eye(3)) @ v + 2 * w * np.cross(xyz, v)
    in_enu = frames.attitude_of(q) @ frames.turn_body(v)
    np.testing.assert_allclose(in_enu, frames.turn_world(in_ned / (q @ q)), atol=1e-6)


def test_level_attitude_to_the_north():
    R = frames.attitude_of(np.array([1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(R, [[0, -1, 0], [1, 0, 0], [0, 0, 1]])  # forward is north, left is west
    assert frames.heading_of(R) == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(("axis", "in_our_body"), [(0, [1, 0, 0]), (1, [0, -1, 0]), (2, [0, 0, -1])])
def test_rotations_have_expected_signs(axis, in_our_body):
    level, rotation = frames.attitude_of(about(0, 0.0)), frames.attitude_of(about(axis, 1e-4))
    rate = (level.T @ rotation - np.eye(3)) / 1e-4
    result = np.array([rate[2, 1], rate[0, 2], rate[1, 0]])
    np.testing.assert_allclose(result, in_our_body, atol=1e-3)
    np.testing.assert_allclose(result, frames.turn_body(np.eye(3)[axis]), atol=1e-3)
