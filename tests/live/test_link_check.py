"""The check of a link without propellers: consistent derivatives, wrong signs, and small motion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retrim.live.link_check import compare, line, main, verdicts
from retrim.plants.bridges.vehicle_state import VehicleState


def states(v_sign=1.0, omega_signs=(1.0, 1.0, 1.0), size=1.0):
    """Return the states of a vehicle that a person carries in a circle and turns about all axes."""
    result = []
    for t in np.arange(0.0, 6.0, 0.02):
        p = size * np.array([np.cos(t), np.sin(t), 0.3 * np.sin(2.0 * t)])
        v = size * np.array([-np.sin(t), np.cos(t), 0.6 * np.cos(2.0 * t)])
        turn = lambda s: Rotation.from_euler("xyz", size * np.array([0.4 * np.sin(s), 0.3 * np.sin(2 * s), 0.5 * s]))  # noqa: E731
        R, h = turn(t).as_matrix(), 1e-4
        omega = Rotation.from_matrix(R.T @ turn(t + h).as_matrix()).as_rotvec() / h
        result.append((t, VehicleState(p, R, v_sign * v, np.array(omega_signs) * omega, 0.01)))
    return result


def test_consistent_states_agree():
    assert all(value > 0.99 for value in compare(states()).values())


@pytest.mark.parametrize("signs", [(1.0, -1.0, -1.0), (-1.0, 1.0, 1.0)])
def test_wrong_signs_of_body_rates_disagree(signs):
    velocity, rates = compare(states(omega_signs=signs)).values()
    assert velocity > 0.99
    assert rates < 0.8


def test_wrong_frame_of_velocity_disagrees():
    assert next(iter(compare(states(v_sign=-1.0)).values())) < -0.99


def test_vehicle_at_rest_gives_no_verdict():
    assert list(compare(states(size=0.0)).values()) == [None, None]
    assert not any(good for _, good in verdicts(compare(states(size=0.0))))
    assert not any(good for _, good in verdicts(compare([])))


def test_nose_down_is_positive():
    R = Rotation.from_euler("y", 30.0, degrees=True).as_matrix()
    text = line(VehicleState(np.zeros(3), R, np.zeros(3), np.zeros(3), 0.02))
    assert "tilt 30 deg (nose down +30, left side up +0), age 20 ms" in text


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["bem"], "is simulated"),
        (["msp:tcp:127.0.0.1:9,pose=/q", "--seconds", "1"], "cannot be connected to"),
        (["msp:nowhere"], "expected msp:"),
    ],
)
def test_unsuitable_links_are_refused_in_one_line(words, text):
    with pytest.raises(SystemExit, match=text):
        main(words)
