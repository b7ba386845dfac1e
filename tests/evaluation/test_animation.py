"""Animations of flights: the camera, and the length of the file."""

import io

import numpy as np
import pytest
from PIL import Image

from fake_flights import flight
from helpers import tiny_preset
from retrim import Setup
from retrim.errors import ConfigError
from retrim.evaluation.figures import animate
from retrim.runkit import Run
from retrim.runkit.reporter import Silent
from retrim.viz.animation import DISTANCE, HOLD_S, project
from retrim_paper.demo import demonstrate

pytestmark = pytest.mark.usefixtures("optax_promotion")


def test_camera_preserves_lines_and_enlarges_near_objects():
    ends = np.array([[1.0, -0.5, 0.3], [-0.8, 0.2, -0.6]])
    a, b, c = project(np.stack([ends[0], 0.3 * ends[0] + 0.7 * ends[1], ends[1]]))
    assert np.linalg.det([b - a, c - a]) == pytest.approx(0.0, abs=1e-12)
    assert project(np.zeros(3)) == pytest.approx([0.0, 0.0])
    sizes = [np.linalg.norm(project(p + 0.01 * np.eye(3)) - project(p)) for p in (ends[0], ends[0] * 0.0, -ends[0])]
    assert sizes[0] > sizes[1] > sizes[2]
    assert np.isnan(project(2.0 * DISTANCE * np.array([1.0, 1.0, 1.0]))).all()


def test_animation_lasts_as_long_as_longest_flight():
    flights = [flight(0.1, seconds=1.0), flight(3.0, terminated=True, seconds=0.5)]
    setup = Setup.from_preset(tiny_preset())
    data = animate(flights[:1], setup, flights[0].spec.scenario, "title", {})
    image, duration = Image.open(io.BytesIO(data)), 0.0
    for k in range(image.n_frames):
        image.seek(k)
        duration += image.info["duration"] / 1000.0
    assert duration == pytest.approx(1.0 + HOLD_S, abs=0.1)


def test_animation_needs_its_flights(tmp_path):
    with pytest.raises(ConfigError, match="leave out --no-slow or --gif"):
        demonstrate(
            "hover/retrim",
            "simple",
            Run("demo", tmp_path),
            Silent(),
            seconds=5.0,
            starts=1,
            seed=0,
            slow=False,
            gif=True,
        )
