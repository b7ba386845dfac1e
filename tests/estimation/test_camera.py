"""The camera: the double-sphere model, its inverse, its borders, and its viewing direction."""

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import replace_fields
from retrim.estimation import Camera
from retrim.estimation.camera import in_camera
from retrim.physics import State, so3


@pytest.fixture(scope="module")
def camera():
    return Camera.published()


project = eqx.filter_jit(lambda camera, P: jax.vmap(camera.project)(P))
slope = eqx.filter_jit(lambda camera, P: jax.vmap(jax.jacobian(lambda q: camera.project(q).pixel))(P))


@eqx.filter_jit
@partial(jax.vmap, in_axes=(None, 0))
def bearing(camera, pixel):
    """Return the unit direction in camera coordinates that appears at a pixel, by the published inverse."""
    m = ((pixel + 1.0) * camera.size / 2.0 - camera.centre) / camera.focal
    r2 = jnp.sum(m**2)
    inside = 1.0 - (2.0 * camera.alpha - 1.0) * r2
    mz = (1.0 - camera.alpha**2 * r2) / (camera.alpha * jnp.sqrt(inside) + 1.0 - camera.alpha)
    stretch = (mz * camera.xi + jnp.sqrt(mz**2 + (1.0 - camera.xi**2) * r2)) / (mz**2 + r2)
    return stretch * jnp.append(m, mz) - jnp.array([0.0, 0.0, 1.0]) * camera.xi


def test_projection_near_axis_is_pinhole(camera):
    """The axis maps to the principal point.

    Near it, the camera is a pinhole of focal length f / (1 + xi), as d1 = d2 = z.
    """
    result = project(camera, jnp.array([[0.0, 0.0, 2.0], [0.002, 0.0, 2.0], [0.0, -0.002, 2.0]]))
    centre = 2.0 * np.array([632.1317557 / 1280.0, 388.2472267 / 720.0]) - 1.0
    np.testing.assert_allclose(result.pixel[0], centre, atol=1e-9)
    xi, f = -0.0074411489, (599.87676297, 449.29110372)
    slope = 1.0 / (0.6138265280850498 * (1.0 + xi) + (1.0 - 0.6138265280850498) * (1.0 + xi))
    np.testing.assert_allclose(result.pixel[1] - centre, [2.0 * f[0] * 1e-3 * slope / 1280.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(result.pixel[2] - centre, [0.0, -2.0 * f[1] * 1e-3 * slope / 720.0], atol=1e-8)


def test_looks_down_with_x_to_the_right():
    """Camera x is body -y and camera y is body -x: forward is up in the image, and left is left."""
    x = State.at(jnp.array([0.0, 0.0, 3.0]))
    points = in_camera(x, jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(points, [[0.0, -1.0, 3.0], [-1.0, 0.0, 3.0], [0.0, 0.0, 3.0]], atol=1e-12)
    points = in_camera(replace_fields(x, R=so3.rotz(jnp.array(0.5 * math.pi))), jnp.array([[0.0, 1.0, 0.0]]))
    np.testing.assert_allclose(points, [[0.0, -1.0, 3.0]], atol=1e-12)


def test_bearing_is_the_inverse_of_project(camera):
    pixels = random.uniform(random.key(1), (200, 2), minval=-1.0, maxval=1.0)
    rays = bearing(camera, pixels)
    np.testing.assert_allclose(jnp.linalg.norm(rays, axis=1), 1.0, atol=1e-9)
    far = 0.3 + 5.0 * random.uniform(random.key(2), (200, 1))
    result = project(camera, rays * far)
    np.testing.assert_allclose(result.pixel, pixels, atol=1e-8)
    assert result.visible.all()


def test_field_of_view_is_about_120_degrees(camera):
    ends = np.asarray(bearing(camera, jnp.array([[-1.0, 0.0], [1.0, 0.0]])))
    assert math.degrees(math.acos(ends[0] @ ends[1])) == pytest.approx(120.0, abs=5.0)


ODD = [
    [0.0, 0.0, -1.0], [1e-3, 0.0, -2.0], [3.0, 0.0, 0.0], [0.0, -4.0, 1e-9], [5.0, 5.0, 0.01], [1.0, 1.0, -1.0],
    [0.0, 0.0, 0.0], [0.0, 0.0, 1e-12], [1e6, 0.0, 1.0],
]  # fmt: skip


def test_points_behind_are_finite_and_invisible(camera):
    points = jnp.array(ODD)
    result = project(camera, points)
    slopes = slope(camera, points)
    assert np.isfinite(result.pixel).all()
    assert np.isfinite(slopes).all()
    assert not result.visible[:6].any()
    assert not result.visible[8]


def test_border_limits_visibility(camera):
    """A point just inside is visible, and one just outside is not; values and gradients are finite on the border."""
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            rays = bearing(camera, jnp.asarray(np.outer([0.999, 1.0, 1.001], side * np.eye(2)[axis])))
            result = project(camera, rays)
            assert bool(result.visible[0])
            assert not bool(result.visible[2])
            assert np.isfinite(slope(camera, rays)[1]).all()


def test_projection_is_independent_of_distance(camera, key):
    rays = random.normal(key, (20, 3)).at[:, 2].set(1.0)
    np.testing.assert_allclose(project(camera, 7.0 * rays).pixel, project(camera, rays).pixel, atol=1e-9)
