"""Logs of Betaflight's firmware: signs, settings and rates. `make test-betaflight` runs the tests.

The board listens at fixed ports on every address, so the tests run in a separate network namespace.
"""

import time
from pathlib import Path

import numpy as np
import pytest

from firmware_log import LOGS, PLAIN, compute_response, fly_random_rates
from retrim import Scenario
from retrim.io.logs import read_log
from retrim.io.logs.blackbox_frames import FrameDecoder
from retrim.io.logs.blackbox_header import read_header
from retrim.plants.bridges import betaflight_firmware, betaflight_world
from retrim.replay.body_identification import identify_body

pytestmark = [pytest.mark.slow, pytest.mark.betaflight]
TENTH = 0.1
LOST = 0.5  # [s] limit of lost simulation time; beyond, the machine is busy


def fly(folder, monkeypatch, more, seconds=25.0):
    """Fly with these settings; return the log's path, the model, and the simulated measurements."""
    plant, sensors = Scenario(plant="betaflight").make("small"), []
    configure, packet = betaflight_firmware.settings, betaflight_world.state_packet

    def spy(omega, force, R):
        sensors.append((time.monotonic(), *omega, *force))
        return packet(omega, force, R)

    monkeypatch.setattr(betaflight_firmware, "settings", lambda steps: [*configure(steps), *LOGS, *more])
    monkeypatch.setattr(betaflight_world, "state_packet", spy)
    try:
        fly_random_rates(plant, seconds)
        if plant.lost_time > LOST:
            pytest.skip(f"the machine is busy: the simulation lost {plant.lost_time:.2f} s")
        plant._world.tell(0.0, np.zeros(3), armed=False)
        time.sleep(2.0)  # the board writes the end of its log
        (log,) = Path(plant._firmware._folder.name).glob("LOG*")
        path = folder / "flight.bfl"
        path.write_bytes(log.read_bytes())
    finally:
        plant.stop()
    return path, plant._model, np.array(sensors)


@pytest.mark.parametrize(("p", "d"), [(30, 20), (45, 30)])
def test_identified_values_deviate_from_settings_by_at_most_10_percent(p, d, tmp_path, monkeypatch):
    gains = [f"set {name}_{axis} = {x}" for axis in ("roll", "pitch") for name, x in (("p", p), ("d", d))]
    path, model, sensors = fly(tmp_path, monkeypatch, [*PLAIN, *gains])
    lag, damping, hover = compute_response(path, model)
    log = read_log(path)
    result = identify_body(log)
    found = result.vehicle
    print(
        f"P {p}, D {d}: lag {1000 * found.rate_lag.value:.1f} ms, from settings {1000 * lag:.1f} ms; damping "
        f"{found.rate_damping.value if found.rate_damping else float('inf'):.2f}, {damping:.2f}; gain "
        f"{found.rate_gain.value:.3f}; hover {result.hover.value:.3f}, {hover:.3f}; "
        f"delay {1000 * found.delay.value:.1f} ms"
    )
    assert found.rate_lag.value == pytest.approx(lag, rel=TENTH)
    assert found.rate_gain.value == pytest.approx(1.0, rel=TENTH)
    assert result.hover.value == pytest.approx(hover, rel=TENTH)
    for axis in range(3):  # the signs of all axes are those of the simulated world
        assert best_correlation(log, log.rates[:, axis], sensors, 1 + axis) > 0.95
    assert best_correlation(log, log.specific_force[:, 2], sensors, 6) > 0.9


def best_correlation(log, values, sensors, column):
    """Return the largest correlation of a logged quantity and a simulated sensor over shifts of the clocks."""
    t = sensors[:, 0] - sensors[0, 0]
    result = [np.interp(log.t + shift, t, sensors[:, column])[log.valid] for shift in np.arange(-1.0, 12.0, 0.01)]
    return max(np.corrcoef(each, values[log.valid])[0, 1] for each in result if np.std(each) > 0.0)


def test_high_resolution_log_has_stick_rates(tmp_path, monkeypatch):
    """The unit is a tenth of a degree per second; full stick is the rate in the settings."""
    path, model, _ = fly(tmp_path, monkeypatch, ["set blackbox_high_resolution = ON"], seconds=12.0)
    data = path.read_bytes()
    header = read_header(path, data, 0)
    columns = FrameDecoder(data, header, len(data)).decode(["rcCommand[0]", "setpoint[0]"]).columns
    gain = np.sum(columns["setpoint[0]"] * columns["rcCommand[0]"]) / np.sum(columns["rcCommand[0]"] ** 2)
    assert 500.0 * gain == pytest.approx(10.0 * header.numbers("rates", (0.0, 0.0, 0.0))[0], rel=0.01)
    log = read_log(path)
    found = identify_body(log).vehicle
    assert np.abs(log.command).max() < 1.1 * np.abs(model.vehicle.omega_max).max()
    assert found.rate_gain.value == pytest.approx(1.0, rel=TENTH)
