"""A log of Betaflight's simulated board: the identified values agree with its settings."""

from pathlib import Path

import numpy as np
import pytest

from firmware_log import compute_response
from retrim import Scenario
from retrim.errors import LogError
from retrim.io.logs import read_log
from retrim.replay import body_identification
from retrim.replay.body_identification import identify_body

LOG = Path(__file__).parent.parent / "logs" / "betaflight_4_6.bfl"
TENTH = 0.1


@pytest.fixture(scope="module")
def log():
    return read_log(LOG)


def test_board_log_is_read_to_its_end(log):
    assert any("Betaflight 4.6.0" in note for note in log.notes)
    assert not any("damaged" in note or "end mark" in note for note in log.notes)
    assert log.warnings == ()
    assert log.agreement["turning"] > 0.95
    assert np.median(log.specific_force[log.valid, 2]) == pytest.approx(9.8, abs=0.5)


def test_values_are_within_a_tenth_of_settings(log, monkeypatch):
    monkeypatch.setattr(body_identification, "DRAWS", 8)
    lag, _, hover = compute_response(LOG, Scenario(plant="betaflight").make("small")._model)
    result = identify_body(log)
    assert result.vehicle.rate_lag.value == pytest.approx(lag, rel=TENTH)
    assert result.vehicle.rate_gain.value == pytest.approx(1.0, rel=TENTH)
    assert result.hover.value == pytest.approx(hover, rel=TENTH)
    assert result.vehicle.delay.value < 3e-3  # one pass of the loop and one step of the simulation


def test_two_logs_in_one_file(tmp_path):
    path = tmp_path / "both.bfl"
    path.write_bytes(2 * LOG.read_bytes())
    with pytest.raises(LogError, match=r"2 flights are in this file: 1 of 1\d\.\d s, 2 of 1\d\.\d s; choose one"):
        read_log(path)
