"""The scene and the chart of the page: contents of the picture, and scale of the errors."""

from unittest.mock import MagicMock

import numpy as np
import pytest

from live_processes import HOME
from retrim.live.operator.manual_disturbance import ManualDisturbance
from retrim.live.operator.panel import LEAST, START_S, Panel, top_of
from retrim.live.operator.scene import Scene

HALF = np.radians(75.0) / 2  # half of the height of viser's picture, as an angle
ROTOR = 0.55  # radius of a drawn rotor, in arms
CIRCLE = HOME + np.stack([np.cos(a := np.linspace(0.0, 6.0, 50)), np.sin(a), 0.0 * a], axis=1)


def scene_of(path, arm=0.08):
    server = MagicMock()
    return server, Scene(server, path, arm, 20.0)


def picture_positions(server, places):
    """Return horizontal and vertical positions in the picture, relative to its centre, in units of half its height."""
    camera, at = (np.array(getattr(server.initial_camera, name)) for name in ("position", "look_at"))
    forward = (at - camera) / np.linalg.norm(at - camera)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = np.atleast_2d(places) - camera
    depth = away @ forward
    assert (depth > 0).all()
    offsets = np.stack([away @ right, away @ np.cross(right, forward)], axis=1)
    return offsets / depth[:, None] / np.tan(HALF)


@pytest.mark.parametrize("arm", [0.06, 0.08, 0.25])
def test_picture_of_hover_contains_large_vehicle_and_ground(arm):
    server, _ = scene_of(HOME[None].repeat(2, 0), arm)
    width = 2 * (1 + ROTOR) * max(arm, 0.08)
    ends = HOME + 0.5 * width * np.array([[0.7, -0.8, 0.0], [-0.7, 0.8, 0.0]]) / np.hypot(0.7, 0.8)
    result = picture_positions(server, ends)
    assert 0.1 < np.ptp(result[:, 0]) / 2 < 0.5
    assert np.abs(picture_positions(server, HOME * [1.0, 1.0, 0.0])).max() < 1.0


def test_picture_contains_whole_reference():
    server, _ = scene_of(CIRCLE)
    assert np.abs(picture_positions(server, CIRCLE)).max() < 1.0


def test_world_has_sky_ground_and_axes():
    server, _ = scene_of(CIRCLE)
    (image,), _ = server.scene.set_background_image.call_args
    assert image.dtype == np.uint8
    assert (image[0] != image[-1]).any()
    names = {
        call.args[0]
        for setup in ("add_grid", "add_frame", "add_label")
        for call in getattr(server.scene, setup).call_args_list
    }
    assert {"/ground", "/axes", "/axes/x", "/axes/y", "/axes/z", "/target/name", "/vehicle"} <= names


def test_rotors_are_opaque_behind_transparent_grip():
    server, _ = scene_of(CIRCLE)
    rotors = [call for call in server.scene.add_cylinder.call_args_list if "rotor" in call.args[0]]
    assert len(rotors) == 4
    assert all("opacity" not in call.kwargs for call in rotors)


def test_flight_to_goal_does_not_set_scale():
    t = np.arange(0.0, 10.0, 0.05)
    error = np.where(t < 0.9 * START_S, 70.0, 2.0)
    assert top_of(t, error) == pytest.approx(2.2)
    assert top_of(t[:20], error[:20]) == pytest.approx(77.0)  # at the beginning, the scale includes all errors
    assert top_of(t, 0.0 * error) == LEAST
    assert top_of(t + 60.0, error) == pytest.approx(77.0)  # a later error of this size changes the scale


def test_panel_states_scenario_and_addition_of_knobs():
    pytest.importorskip("viser")
    server = MagicMock()
    Panel(server, MagicMock(), MagicMock(), ManualDisturbance(), {}, (), (), 0.19, 20.0, "pushed by 2")
    texts = [call.args[0] for call in server.gui.add_markdown.call_args_list]
    assert "pushed by 2" in texts
    folders = [call.args[0] for call in server.gui.add_folder.call_args_list]
    assert folders[0] == "Added to the scenario"
