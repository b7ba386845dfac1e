"""Dataflash logs of ArduPilot, intact and damaged: the flight in retrim's frames, or one line."""

import contextlib
import re
import struct

import numpy as np
import pytest

from fake_body_flight import BodyFlight, Truth, fly_body
from fake_dataflash import HEAD, body_messages, dataflash, describe, flight_messages, formats, message, sorted_messages
from fake_log import G, fly_once
from retrim.errors import LogError, RetrimError
from retrim.io.logs import BodyLog, FlightLog, read_flight_log, read_log, read_map
from retrim.replay import rows_of

FLIGHT = fly_once(6.0, dt=0.01)
MESSAGES = flight_messages(FLIGHT)
LOG = dataflash(MESSAGES)


def write(tmp_path, data, name="flight.bin"):
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


def assert_is_flight(log, flight=FLIGHT):
    """Assert equality of position, velocity, attitude, rates and thrust, in east-north-up and forward-left-up."""
    assert isinstance(log, FlightLog)
    at = [np.argmin(np.abs(flight.t - t)) for t in log.t]
    np.testing.assert_allclose(log.p, flight.p[at], atol=2e-3)
    np.testing.assert_allclose(log.v, flight.v[at], atol=2e-3)
    np.testing.assert_allclose(log.R, flight.R[at], atol=2e-3)
    np.testing.assert_allclose(log.rates, flight.omega[at], atol=1e-3)
    np.testing.assert_allclose(log.command, flight.omega[at], atol=1e-3)
    assert log.full_thrust == pytest.approx(G[2] / 0.35, rel=1e-2)
    assert np.abs(np.asarray(rows_of(log).a_res)[log.valid]).max() < 0.2


def test_flight_with_positions(tmp_path):
    """The states are those of the first estimator instance, and the thrust map is that of the parameter."""
    path = write(tmp_path, LOG)
    log = read_flight_log(path)
    assert_is_flight(log)
    assert min(log.agreement.values()) > 0.95
    hover = float(next(note for note in log.notes if "hover at" in note).split()[-1])
    assert hover == pytest.approx(0.35, rel=0.1)


def test_numbers_equal_pymavlink(tmp_path):
    reader = pytest.importorskip("pymavlink.DFReader")
    path = write(tmp_path, LOG, "flight.BIN")
    log, rows = reader.DFReader_binary(str(path)), []
    while (each := log.recv_match(type=["XKF1", "RATE", "IMU"])) is not None:
        if each.get_type() != "RATE" and getattr(each, "C" if each.get_type() == "XKF1" else "I") == 1:
            continue
        rows.append((each.get_type(), each))
    log.close()
    from retrim.io.logs.dataflash_file import read_dataflash

    fields = {"XKF1": ["Roll", "Yaw", "VN", "PD"], "RATE": ["RDes", "AOut"], "IMU": ["GyrX", "AccZ"]}
    series, _ = read_dataflash(path, {k: [f"{k}.{x}" for x in names] for k, names in fields.items()}, None)
    for kind, names in fields.items():
        theirs = np.array([[getattr(each, x) for x in names] for what, each in rows if what == kind])
        np.testing.assert_allclose(series[kind].values, theirs, rtol=1e-6, atol=1e-9)


def test_motors_and_second_instance(tmp_path):
    """The log has four pulse widths instead of a thrust; the second accelerometer has an offset of 50 m/s^2."""
    text = (read_text("ardupilot")).replace(
        'fields = ["RATE.AOut|CTUN.ThO"]\nunit = "share"',
        'fields = ["RCOU.C1", "RCOU.C2", "RCOU.C3", "RCOU.C4"]\nunit = "share"\nzero = 1000.0\nfull = 2000.0',
    )
    (tmp_path / "map.toml").write_text(text)
    log = read_flight_log(write(tmp_path, LOG), read_map(tmp_path / "map.toml"))
    assert log.full_thrust == pytest.approx(G[2] / (0.8 * 0.35), rel=1e-2)
    (tmp_path / "map.toml").write_text(read_text("ardupilot-rates").replace("IMU.Acc", "IMU#1.Acc"))
    with pytest.raises(LogError, match=r"accelerometer measures .* g upwards in flight instead of 1"):
        read_log(tmp_path / "flight.bin", read_map(tmp_path / "map.toml"))


def read_text(name):
    from importlib.resources import files

    return (files("retrim.io.logs") / "maps" / f"{name}.toml").read_text()


def test_rate_loop_only(tmp_path):
    """Without estimator states the log contains rates only; axes are converted from forward-right-down."""
    whole = fly_body(3.0, Truth(curve=0.0))
    flight = BodyFlight(*(getattr(whole, name)[::5] for name in ("t", "command", "rates", "motors", "force")))
    log = read_log(write(tmp_path, dataflash(body_messages(flight), without=("XKF1",))))
    assert isinstance(log, BodyLog)
    n = len(log.t)
    np.testing.assert_allclose(log.command, flight.command[:n], atol=1e-4)
    np.testing.assert_allclose(log.rates, 0.5 * (flight.rates[:n] + flight.rates[1 : n + 1]), atol=1e-4)
    np.testing.assert_allclose(log.specific_force, 0.5 * (flight.force[:n] + flight.force[1 : n + 1]), atol=1e-4)
    assert log.agreement["turning"] > 0.9


def test_flights_are_split_by_arming(tmp_path):
    other = fly_once(4.0, dt=0.01, seed=3)
    path = write(tmp_path, dataflash(MESSAGES, flight_messages(other, start=60.0)))
    with pytest.raises(
        LogError, match=r"2 flights are in this file: 1 of 6.0 s, 2 of 4.0 s; choose one, as --flight 1"
    ):
        read_log(path)
    assert_is_flight(read_flight_log(path, flight=1))
    assert_is_flight(read_flight_log(path, flight=2), other)


def test_restarted_clock_begins_new_flight(tmp_path):
    """The board starts twice in one file without arming; a single damaged time is not a start."""
    other = fly_once(4.0, dt=0.01, seed=3)
    parts = flight_messages(FLIGHT, events=False), flight_messages(other, start=1.0, events=False)
    path = write(tmp_path, dataflash(*parts))
    with pytest.raises(LogError, match=r"2 flights are in this file: 1 of 9.0 s, 2 of 4.0 s"):
        read_log(path)
    assert_is_flight(read_flight_log(path, flight=2), other)
    data = bytearray(dataflash(parts[0]))
    at = data.index(HEAD + b"\x43", len(data) // 2) + 3
    data[at : at + 8] = struct.pack("<Q", 10**12)
    log = read_flight_log(write(tmp_path, bytes(data)))
    assert log.seconds > 5.0


@pytest.mark.parametrize("events", [True, False])
@pytest.mark.parametrize("value", [0, 10**12, 2**63 - 1])
def test_damaged_times_are_not_flights(events, value, tmp_path):
    """Neighbouring messages in the middle of the log, and the last ones, have impossible times."""
    data = bytearray(dataflash(flight_messages(FLIGHT, events=events)))
    places = [each.start() for each in re.finditer(re.escape(HEAD + b"\x43"), data)]
    for at in (*places[200:202], places[300], places[-1]):
        data[at + 3 : at + 11] = struct.pack("<Q", value)
    path = write(tmp_path, bytes(data))
    with pytest.raises(LogError, match=r"the flights in this file are 1 of [69]\.0 s$"):
        read_log(path, flight=7)
    log, intact = read_flight_log(path), read_flight_log(write(tmp_path, LOG))
    assert log.seconds > 5.8
    assert np.isclose(log.command, intact.command).all(axis=1).mean() > 0.98


def test_signalling_nan_is_left_out(tmp_path):
    data = bytearray(LOG)
    at = data.index(HEAD + b"\x43", len(data) // 2) + 11
    data[at : at + 4] = b"\x01\x00\xa0\x7f"
    log = read_flight_log(write(tmp_path, bytes(data)))
    assert any("1 of 601 samples are not finite" in note for note in log.notes)


def damage(data):
    return data[: len(data) * 2 // 3 + 7]


def test_truncated_log_with_gaps_is_read(tmp_path):
    log = read_flight_log(write(tmp_path, damage(LOG)))
    assert_is_flight(log)
    assert 3.0 < log.seconds < 5.0
    data = bytearray(LOG)
    data[len(data) // 2 : len(data) // 2 + 300] = bytes(300)
    log = read_flight_log(write(tmp_path, bytes(data)))
    assert any("bytes of the file belong to no message" in note for note in log.notes)
    assert log.seconds > 5.0


@pytest.mark.parametrize("extra", [0, 20])
def test_cut_inside_a_message_is_reported_and_cut_between_messages_is_a_shorter_flight(extra, tmp_path):
    at = LOG.index(HEAD + b"\x43", len(LOG) // 2)
    log = read_flight_log(write(tmp_path, LOG[: at + extra]))
    assert 2.5 < log.seconds < 3.5
    notes = [note for note in log.notes if "of the file belong to no message" in note]
    assert notes == [f"{extra} bytes of the file belong to no message, and are left out"] * bool(extra)


def slow():
    return dataflash(flight_messages(fly_once(6.0, dt=0.1), every=1), without=("XKF1",))


REFUSED = {
    "empty": (lambda: b"", "it is empty"),
    "garbage": (lambda: bytes(range(256)) * 40, "no message describes the others"),
    "descriptions only": (formats, "no field 'XKF1'; the log has none"),
    "short": (lambda: dataflash(flight_messages(fly_once(0.5, dt=0.01))), "at least 1 s are needed"),
    "no rates": (
        lambda: dataflash(flight_messages(FLIGHT, without=("RATE", "XKF1")), without=("RATE", "XKF1")),
        "no field 'XKF1'; there are .*IMU.* without a map it is read as 'ardupilot' or 'ardupilot-rates'",
    ),
    "too rare": (slow, "rates come every 0.1 s; .*LOG_BITMASK with fast attitude"),
    "descriptions of other lengths": (
        lambda: formats().replace(b"Q", b"Z") + sorted_messages(MESSAGES), "no message describes the others"
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_unreadable_log_is_refused_with_one_line(kind, tmp_path):
    make, text = REFUSED[kind]
    with pytest.raises(LogError, match=f"flight.bin: .*{text}") as error:
        read_log(write(tmp_path, make()))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1500


def describe_twice(name, *layouts):
    """Return descriptions of one name, of the types 100 and on, and a message of the last type."""
    parts = [describe(name, 100 + k, codes, labels) for k, (codes, labels) in enumerate(layouts)]
    return b"".join(parts) + HEAD + struct.pack("<BQ", 99 + len(layouts), 9_000_000)


@pytest.mark.parametrize(
    ("extra", "skipped"),
    [
        (describe_twice("ABCD", ("QZ", "TimeUS,A"), ("Q", "TimeUS")), 11),
        (describe_twice("ABCD", ("Q", "TimeUS"), ("Q", "TimeUS")), 0),
        (describe_twice("ABCD", ("Z", "TimeUS")) + bytes(56), 67),
        (describe_twice("ABCD", ("a", "TimeUS")) + bytes(56), 67),
    ],
    ids=["other layout of a name", "same layout again", "text as time", "array as time"],
)
def test_description_that_cannot_be_used_is_left_out(extra, skipped, tmp_path):
    """The flight is read as without it, and the bytes of its messages are reported."""
    log = read_log(write(tmp_path, LOG + extra))
    assert_is_flight(log)
    notes = [note for note in log.notes if "belong to no message" in note]
    assert notes == [f"{skipped} bytes of the file belong to no message, and are left out"] * bool(skipped)


def test_damaged_bytes_give_flight_or_one_line(tmp_path):
    rng, short = np.random.default_rng(0), dataflash(flight_messages(fly_once(1.5, dt=0.01)))
    head = len(formats())
    for k in range(40):
        data = bytearray(short[: int(rng.integers(1, len(short)))] if k % 3 == 0 else short)
        for place in rng.integers(0, min(head, len(data)) if k % 2 else len(data), 1 + k % 6):
            data[place] = int(rng.integers(256))
        with contextlib.suppress(RetrimError):
            log = read_log(write(tmp_path, bytes(data)))
            assert np.isfinite(log.rates[log.valid]).all()
    with contextlib.suppress(RetrimError):
        read_log(write(tmp_path, short[:head] + rng.bytes(300_000)))
    with pytest.raises(LogError):
        read_log(write(tmp_path, formats() + message("EV", 5, 10) * 20_000))
