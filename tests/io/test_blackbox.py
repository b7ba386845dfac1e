"""Blackbox logs of several firmware versions, intact and damaged: each is read exactly, or refused with one line."""

import contextlib
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import fake_blackbox
from fake_blackbox import DISARM, END, blackbox, decoded_csv, layout_of, numbers
from fake_body_flight import BodyFlight, fly_body
from retrim.errors import LogError, RetrimError
from retrim.io.logs import BodyLog, read_flight_log, read_log, read_map
from retrim.io.logs.blackbox_codes import decoding_plan
from retrim.io.logs.blackbox_frames import FrameDecoder
from retrim.io.logs.blackbox_header import read_header

EVERY = 4  # rows of a flight between two frames: a log of 250 Hz


def brief(seconds, seed=0):
    return part_of(fly_body(seconds, seed=seed), slice(0, None, EVERY))


def part_of(flight, rows):
    return BodyFlight(*(getattr(flight, name)[rows] for name in ("t", "command", "rates", "motors", "force")))


FLIGHT, SHORTER = brief(2.2), brief(1.4, seed=1)
LOG = blackbox(FLIGHT)
VERSIONS = [(4, 3), (4, 4), (4, 5), (4, 6)]


def read(tmp_path, data, name="flight.bbl", **calls):
    path = tmp_path / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    log = read_log(path, **calls)
    assert isinstance(log, BodyLog)
    return log


def assert_is_flight(log, flight=FLIGHT):
    """Assert equality tick by tick: rates within a degree per second, and motors within the resolution of DSHOT."""
    n = len(log.t)
    assert log.dt == pytest.approx(0.001 * EVERY)
    np.testing.assert_allclose(log.command[:n], flight.command[:n], atol=0.009)
    np.testing.assert_allclose(log.motors, flight.motors[:n], atol=3e-4)
    for result, true, rounding in ((log.rates, flight.rates, 0.009), (log.specific_force, flight.force, 0.02)):
        np.testing.assert_allclose(result, 0.5 * (true[:n] + true[1 : n + 1]), atol=rounding)


@pytest.mark.parametrize("version", VERSIONS)
def test_every_number_of_every_encoding_is_read(version):
    """Decoded frames with differences equal the numbers of the writer exactly."""
    data = blackbox(FLIGHT, version)
    header = read_header(Path("log"), data, 0)
    frames = FrameDecoder(data, header, len(data)).decode(header.names)
    assert frames.complete
    assert frames.damaged == 0
    expected = numbers(FLIGHT, version)
    for each in layout_of(version):
        np.testing.assert_array_equal(frames.columns[each[0]], expected[each[0]], err_msg=each[0])


@pytest.mark.parametrize("code", sorted(fake_blackbox.CODES))
def test_decoding_inverts_encoding(code):
    rng, (write, most) = np.random.default_rng(code), fake_blackbox.CODES[code]
    ((decode, count),) = decoding_plan((code,) * most)
    for size in (0, 1, 2, 3, 5, 7, 8, 12, 15):
        for _ in range(40):
            values = [int(x) for x in rng.integers(-(1 << size), 1 << size, most)]
            if code in (1, 3):
                values = [abs(values[0]) & 0x1FFF]
            if code == 9:
                values = [0]
            if code == 8:
                values = [int(np.clip(x, -(1 << 15), (1 << 15) - 1)) for x in values]
            data = write(values) if most > 1 else write(values[0])
            result, at = decode(data + b"I", 0, count)
            assert (list(result), at) == (values, len(data))


@pytest.mark.parametrize("version", VERSIONS)
def test_firmware_from_4_3_to_4_6(version, tmp_path):
    log = read(tmp_path, blackbox(FLIGHT, version))
    assert_is_flight(log)
    assert log.notes == (f"the log is that of Betaflight {version[0]}.{version[1]}.0 (0a1b2c3d) STM32F7X2",)
    assert log.warnings == ()
    assert log.agreement["turning"] > 0.9


def test_high_resolution_and_accelerometer_filter(tmp_path):
    log = read(tmp_path, blackbox(FLIGHT, fine=True, acc_lpf_hz=2500))
    assert_is_flight(log)
    assert log.filter_lag == pytest.approx(2.0 / (2.0 * np.pi * 25.0 * 1.554))
    assert any("filter of 25 Hz is accounted for" in note for note in log.notes)


def test_decoded_csv_equals_log(tmp_path):
    """Blackbox Explorer writes settings, and blackbox_decode does not."""
    settings = [("Product", "Blackbox"), ("Firmware revision", "Betaflight 4.5.0"), ("acc_1G", 2048),
                ("motorOutput", "158,2047"), ("blackbox_high_resolution", 0)]  # fmt: skip
    assert_is_flight(read(tmp_path, decoded_csv(FLIGHT, settings=settings), "explorer.csv"))
    log = read(tmp_path, decoded_csv(FLIGHT), "decoded.csv")
    assert_is_flight(log)
    assert any("no settings; the units of motors and accelerometer follow" in note for note in log.notes)


def without(*names, **more):
    return lambda: blackbox(FLIGHT, without=names, **more)


def damaged(at, byte=0xFF):
    def make():
        data = bytearray(LOG)
        data[at] ^= byte
        return bytes(data)

    return make


def negated(*axes):
    signs = np.array([-1.0 if k in axes else 1.0 for k in range(3)])
    return lambda: blackbox(BodyFlight(FLIGHT.t, FLIGHT.command * signs, FLIGHT.rates, FLIGHT.motors, FLIGHT.force))


def slow():
    return blackbox(part_of(fly_body(20.0), slice(0, None, 60)))


REFUSED = {
    "empty": (lambda: b"", "it is empty"),
    "garbage": (lambda: bytes(range(256)) * 40, "no flight begins in it"),
    "an incomplete header": (lambda: LOG[:120], "does not describe its frames"),
    "only a header": (lambda: LOG[: LOG.index(b"resolution:0\n") + 13], "a header and no sample"),
    "a few milliseconds": (lambda: blackbox(brief(0.3)), "of flight are left, at least 1 s"),
    "lists that do not match": (lambda: LOG.replace(b"signed:0,0,", b"signed:0,0,0,", 1), "fields do not match"),
    "an unknown encoding": (lambda: LOG.replace(b"I encoding:1,1,0", b"I encoding:1,1,77", 1), "no I frame"),
    "huge lists": (
        lambda: LOG.replace(b"Field I name:", b"Field I name:" + b"a," * 40_000, 1),
        "incomplete|do not match|is damaged",
    ),
    "other firmware": (without(**{"Firmware revision": "INAV 7.1.0"}), "written by INAV 7.1.0, not by Betaflight"),
    "no gyroscope": (without("gyro"), "the log has no gyroADC; `set blackbox_disable_gyro = OFF` logs it"),
    "a constant gyroscope": (
        lambda: blackbox(BodyFlight(FLIGHT.t, FLIGHT.command, 0.0 * FLIGHT.rates, FLIGHT.motors, FLIGHT.force)),
        "the gyroscope measures nothing",
    ),
    "rates against": (
        negated(1),
        r'about y \(-\d+ % agreement\); with rates.fields = \["setpoint\[0\]", "-setpoint\[1\]", "setpoint\[2\]"\] it',
    ),
    "too rare": (slow, "rates come every 0.06 s; .*blackbox_sample_rate"),
    "upside down": (
        lambda: blackbox(BodyFlight(FLIGHT.t, FLIGHT.command, FLIGHT.rates, FLIGHT.motors, -FLIGHT.force)),
        r"measures -[01](\.\d+)? g upwards .*; the sign",
    ),
    "two flights": (
        lambda: blackbox(SHORTER) + LOG,
        r"2 flights are in this file: 1 of 1.3 s, 2 of 2.2 s; choose one, as --flight 1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_unreadable_log_is_refused_with_one_line(kind, tmp_path):
    make, text = REFUSED[kind]
    with pytest.raises(LogError, match=f"flight.bbl: .*{text}") as error:
        read(tmp_path, make())
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1500


@pytest.fixture(scope="module")
def log_without(tmp_path_factory):
    """Return a function that reads a log without a setting, once for each setting."""
    folder = tmp_path_factory.mktemp("without")
    return cache(lambda name: read(folder, blackbox(SHORTER, **{name: None})))


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e400", "1e300", "-1e300"])
@pytest.mark.parametrize("name", ["minthrottle", "vbatref", "I interval", "acc_1G", "looptime", "acc_lpf_hz"])
def test_setting_without_finite_size_has_its_default(name, number, log_without, tmp_path):
    data = blackbox(SHORTER, **{name: number, "motorOutput": f"{fake_blackbox.LOW},{fake_blackbox.HIGH}"})
    assert read_header(Path("log"), data, 0).numbers(name, (7.0,)) == (7.0,)
    log, default = read(tmp_path, data), log_without(name)
    np.testing.assert_array_equal(log.command, default.command)
    np.testing.assert_array_equal(log.specific_force, default.specific_force)


def test_motor_limits_without_finite_size_give_flight_or_one_line(tmp_path):
    for limits in ("inf,2047", "158,nan", "nan,nan", "-1e300,2047"):
        with contextlib.suppress(RetrimError):
            assert np.isfinite(read(tmp_path, blackbox(SHORTER, motorOutput=limits)).motors).all()


def test_rates_in_unknown_unit_are_refused(tmp_path):
    text = files("retrim.io.logs") / "maps" / "betaflight.toml"
    (tmp_path / "map.toml").write_text(text.read_text().replace('"setpoint[2]"]\nunit = "deg/s"', '"setpoint[2]"]'))
    with pytest.raises(LogError, match=r'does not turn as commanded .*; with rates.unit = "deg/s" it would'):
        read(tmp_path, LOG, log_map=read_map(tmp_path / "map.toml"))


def test_flights_are_chosen_by_number(tmp_path):
    both = blackbox(SHORTER) + LOG + blackbox(brief(0.4))
    assert_is_flight(read(tmp_path, both, flight=1), SHORTER)
    assert_is_flight(read(tmp_path, both, flight=2))
    with pytest.raises(LogError, match=r"--flight 4: the flights in this file are 1 of 1.3 s, 2 of 2.2 s, 3 of 0.4 s"):
        read(tmp_path, both, flight=4)
    with pytest.raises(LogError, match=r"--flight 1: only .bbl, .bfl, .bin files can contain several flights"):
        read_log(_csv(tmp_path), flight=1)
    one = read(tmp_path, LOG + blackbox(brief(0.4)))
    assert any("1 other flights in this file last less than 1 s" in note for note in one.notes)


def _csv(tmp_path):
    (tmp_path / "flight.csv").write_text("t\n1\n")
    return tmp_path / "flight.csv"


def test_truncated_log_is_read_to_its_end(tmp_path):
    log = read(tmp_path, LOG[: len(LOG) * 3 // 4])
    assert_is_flight(log)
    assert 1.4 < log.seconds < 1.9
    assert any("ends without its end mark" in note for note in log.notes)


def test_damaged_frame_loses_frames_until_next_intra_frame(tmp_path):
    data = bytearray(LOG)
    data[len(data) // 2 : len(data) // 2 + 800] = bytes(800)
    log = read(tmp_path, bytes(data))
    assert any("frames are damaged, and are left out" in note for note in log.notes)
    lost = np.sum(~log.valid) * log.dt
    assert 0.0 < lost < 2.5e-3 * EVERY * fake_blackbox.I_EVERY / fake_blackbox.P_EVERY
    np.testing.assert_allclose(log.command[log.valid], FLIGHT.command[: len(log.t)][log.valid], atol=0.009)


def test_missing_fields_are_reported_and_others_read(tmp_path):
    log = read(tmp_path, blackbox(FLIGHT, without=("acc", "setpoint")))
    assert log.command is None
    assert log.specific_force is None
    assert {"the log has no commanded rates", "the log has no accelerometer"} <= set(log.notes)
    log = read(tmp_path, blackbox(FLIGHT, without=("motor",)))
    assert log.motors.shape[1] == 1
    np.testing.assert_allclose(log.motors[:, 0], FLIGHT.motors.mean(axis=1)[: len(log.t)], atol=1e-3)


def test_blackbox_is_not_a_flight_with_positions(tmp_path):
    (tmp_path / "flight.bfl").write_bytes(LOG)
    with pytest.raises(LogError, match=r"no attitudes and velocities; retrim.io.logs.read_log reads it"):
        read_flight_log(tmp_path / "flight.bfl")


def test_damaged_bytes_give_flight_or_one_line(tmp_path):
    """Logs are truncated, or damaged in the header or in the frames; the only error is RetrimError, and numbers are
    finite.
    """
    rng, short = np.random.default_rng(0), blackbox(brief(1.5))
    end = short.index(b"resolution:0\n") + 13
    for k in range(18):
        data = bytearray(short[: int(rng.integers(1, len(short)))] if k % 3 == 0 else short)
        for place in rng.integers(0, len(data) if k % 2 else min(end, len(data)), 1 + k % 5):
            data[place] = int(rng.integers(256))
        with contextlib.suppress(RetrimError):
            log = read(tmp_path, bytes(data))
            assert np.isfinite(log.rates[log.valid]).all()
    with contextlib.suppress(RetrimError):
        read(tmp_path, short[:end] + rng.bytes(60_000))
    many = blackbox(brief(0.05)) * 300
    with pytest.raises(LogError, match="of flight are left, at least 1 s"):
        read(tmp_path, many)


@pytest.mark.parametrize("text", ["", "loopIteration\n", '"Product","x"\nloopIteration, time (us)\n1, 2\n'])
def test_incomplete_decoded_logs_are_refused(text, tmp_path):
    with pytest.raises(LogError) as error:
        read(tmp_path, text, "flight.csv")
    assert "\n" not in str(error.value)


def test_end_marker_equals_that_of_firmware():
    assert LOG.endswith(DISARM + END)
