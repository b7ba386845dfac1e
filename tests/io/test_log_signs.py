"""A map can state any sign and any axes; a wrong one is refused with the statement that corrects it."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fake_log import MAP, columns, fly_once, write_csv, write_map
from retrim.errors import ConfigError, LogError
from retrim.io.logs import read_flight_log, read_map
from retrim.io.logs.axes import to_body, to_world
from retrim.replay import rows_of

PUSH = (0.4, -0.3, 0.1)
FLIGHT = fly_once(11.0, wind=PUSH, size=1.5)
ANGLES = dict(zip(("yaw", "pitch", "roll"), Rotation.from_matrix(FLIGHT.R).as_euler("ZYX").T, strict=True))
GYRO = 0.5 * (FLIGHT.omega + np.concatenate([FLIGHT.omega[:1], FLIGHT.omega[:-1]]))
TABLE = columns(FLIGHT) | ANGLES | {f"g{axis}": GYRO[:, i] for i, axis in enumerate("xyz")}


def read(tmp_path, table, **changes):
    path = write_csv(tmp_path / "log.csv", table)
    return read_flight_log(path, read_map(write_map(tmp_path / "map.toml", MAP, **changes)))


def assert_is_flight(log):
    np.testing.assert_allclose(log.R, FLIGHT.R, atol=1e-6)
    np.testing.assert_allclose(log.v, FLIGHT.v, atol=1e-6)
    np.testing.assert_allclose(log.p, FLIGHT.p, atol=1e-6)
    np.testing.assert_allclose(log.command, FLIGHT.omega, atol=1e-6)
    error = np.asarray(rows_of(log).a_res)[log.valid]
    np.testing.assert_allclose(error, np.broadcast_to(PUSH, error.shape), atol=5e-3)


AXES = {
    "attitude": {"attitude__form": '"roll pitch yaw"', "attitude__fields": '["roll", "pitch", "yaw"]'},
    "measured_rates": {"measured_rates__fields": '["gx", "gy", "gz"]'},
}
FIELDS = {
    "attitude": ["roll", "pitch", "yaw"],
    "attitude_q": ["qx", "qy", "qz", "qw"],
    "rates": ["wx", "wy", "wz"],
    "measured_rates": ["gx", "gy", "gz"],
    "velocity": ["vx", "vy", "vz"],
    "position": ["px", "py", "pz"],
}
WRONG = [
    ("attitude", ("roll",)),
    ("attitude", ("pitch",)),
    ("attitude", ("yaw",)),
    ("attitude", ("pitch", "yaw")),
    ("rates", ("wx",)),
    ("rates", ("wy",)),
    ("rates", ("wz",)),
    ("rates", ("wy", "wz")),
    ("measured_rates", ("gy",)),
    ("measured_rates", ("gx", "gy", "gz")),
    ("velocity", ("vx",)),
    ("velocity", ("vy",)),
    ("velocity", ("vz",)),
    ("position", ("px",)),
    ("position", ("py",)),
    ("position", ("pz",)),
    ("position", ("py", "pz")),
    ("attitude_q", ("qx",)),
    ("attitude_q", ("qy",)),
    ("attitude_q", ("qz",)),
    ("attitude_q", ("qy", "qz")),
]


@pytest.mark.parametrize(("table", "names"), WRONG, ids=lambda x: x if isinstance(x, str) else "-".join(x))
def test_wrong_sign_is_reported_and_correctable(table, names, tmp_path):
    """Examples are the pitch of a Crazyflie, which is positive nose up, and the heading of a compass."""
    changes = AXES.get(table, {})
    fields = FIELDS[table]
    table = table.partition("_q")[0]
    wrong = TABLE | {name: -TABLE[name] for name in names}
    correction = "[" + ", ".join(f'"-{name}"' if name in names else f'"{name}"' for name in fields) + "]"
    with pytest.raises(LogError) as error:
        read(tmp_path, wrong, **changes)
    assert f"{table}.fields = {correction} they would" in str(error.value)
    assert_is_flight(read(tmp_path, wrong, **changes | {f"{table}__fields": correction}))


@pytest.mark.parametrize(
    ("table", "order"),
    [("velocity", ("vy", "vx", "vz")), ("position", ("py", "-px", "pz")), ("rates", ("wy", "wx", "wz")),
     ("measured_rates", ("gy", "gx", "-gz")), ("attitude", ("yaw", "pitch", "roll")),
     ("attitude", ("pitch", "roll", "yaw"))],
)  # fmt: skip
def test_wrong_order_is_reported_and_correctable(table, order, tmp_path):
    changes = AXES.get(table, {})
    fields = FIELDS[table]
    wrong = dict(TABLE)
    for name, place in zip(fields, order, strict=True):
        wrong[place.removeprefix("-")] = -TABLE[name] if place.startswith("-") else TABLE[name]
    correction = "[" + ", ".join(f'"{name}"' for name in order) + "]"
    with pytest.raises(LogError) as error:
        read(tmp_path, wrong, **changes)
    assert f"{table}.fields = {correction} they would" in str(error.value)
    assert_is_flight(read(tmp_path, wrong, **changes | {f"{table}__fields": correction}))


@pytest.mark.parametrize(("world", "body"), [("NWU", "FLU"), ("SEU", "FLU"), ("ENU", "LBU"), ("ENU", "RFU")])
def test_attitude_rotated_about_z_is_reported(world, body, tmp_path):
    own = np.swapaxes(to_world(world)[None], 1, 2) @ FLIGHT.R @ to_body(body)
    table = columns(dataclasses.replace(FLIGHT, R=own))
    text = f'attitude.world = "{world}"' if world != "ENU" else f'attitude.body = "{body}"'
    with pytest.raises(LogError, match=f"with {text} they would"):
        read(tmp_path, table)
    assert_is_flight(read(tmp_path, table, attitude__world=f'"{world}"', attitude__body=f'"{body}"'))


@pytest.mark.parametrize("degrees", [-150.0, -40.0, 30.0, 100.0])
def test_heading_offset_is_reported(degrees, tmp_path):
    """A compass heading and the axes of motion capture may differ by an offset."""
    rotations = Rotation.from_euler("z", -degrees, degrees=True) * Rotation.from_matrix(FLIGHT.R)
    table = columns(dataclasses.replace(FLIGHT, R=rotations.as_matrix()))
    with pytest.raises(LogError, match=rf"with attitude.heading = {degrees:.0f} they would"):
        read(tmp_path, table)
    assert_is_flight(read(tmp_path, table, attitude__heading=f"{degrees:.0f}"))


@pytest.mark.parametrize("names", [("pitch",), ("roll",)])
def test_wrong_sign_is_reported_without_rates(names, tmp_path):
    """The acceleration alone reveals the sign."""
    wrong = TABLE | {name: -TABLE[name] for name in names}
    text = MAP.partition("[rates]")[0]
    path = write_csv(tmp_path / "log.csv", wrong)
    with pytest.raises(LogError, match=rf'"-{names[0]}".*they would'):
        read_flight_log(path, read_map(write_map(tmp_path / "map.toml", text, **AXES["attitude"])))


@pytest.mark.parametrize(
    ("world", "body"),
    [("NED", "FRD"), ("NWU", "FLU"), ("EUS", "FLU"), ("ENU", "RFU"), ("WSU", "BRU"), ("NUE", "FRD"), ("NEU", "FRU"),
     ("EUN", "RUF")],
)  # fmt: skip
def test_axes_of_any_kind(world, body, tmp_path):
    """Axes may be right-handed or left-handed, as in game engines, or have y upwards, as in motion capture."""
    W, B = to_world(world), to_body(body)
    spin = np.linalg.det(B) * B
    turned_log = dataclasses.replace(
        FLIGHT, p=FLIGHT.p @ W, v=FLIGHT.v @ W, R=np.swapaxes(W[None], 1, 2) @ FLIGHT.R @ B, omega=FLIGHT.omega @ spin
    )
    assert_is_flight(read(tmp_path, columns(turned_log), frames__world=f'"{world}"', frames__body=f'"{body}"'))


def test_attitude_may_have_separate_axes(tmp_path):
    ned = np.swapaxes(to_world("NED")[None], 1, 2) @ FLIGHT.R @ to_body("FRD")
    table = columns(dataclasses.replace(FLIGHT, R=ned))
    with pytest.raises(LogError, match=r'attitude.world = "NED" and attitude.body = "FRD" they would'):
        read(tmp_path, table)
    assert_is_flight(read(tmp_path, table, attitude__world='"NED"', attitude__body='"FRD"'))


def test_rotation_vectors_and_parts_of_lists(tmp_path):
    vectors = Rotation.from_matrix(FLIGHT.R).as_rotvec(degrees=True)
    table = TABLE | {f"r{i}": vectors[:, i] for i in range(3)}
    log = read(tmp_path, table, attitude__fields='["r0", "r1", "r2"]', attitude__form='"rotation vector"',
               attitude__unit='"deg"')  # fmt: skip
    assert_is_flight(log)


def test_alternative_and_capitalised_names(tmp_path):
    log = read(tmp_path, TABLE, velocity__fields='["speed_x|vx", "VY", "vz|wz"]', time__field='"T"')
    assert_is_flight(log)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"frames__world": '"ENN"'}, "not three axes"),
        ({"frames__world": '"FLU"'}, "not three axes"),
        ({"frames__body": '"ENU"'}, "not three axes"),
        ({"frames__world": '"NEU"'}, "must both be right-handed, or both left"),
        ({"attitude__body": '"FRU"'}, "must both be right-handed, or both left"),
        ({"landed__fields": '["state==on"]'}, "'on' is not a number; a flag is a field, or field==number"),
        ({"thrust__full": "65535.0"}, 'full goes with unit = "share"'),
    ],
)
def test_invalid_axes_are_refused(changes, text, tmp_path):
    with pytest.raises(ConfigError, match=text):
        read_map(write_map(tmp_path / "map.toml", **changes))


def test_unexplained_attitude_gives_warning(tmp_path):
    """The tilt drifts, and no statement of the map corrects this."""
    off = 0.9 * np.sin(np.stack([2.3 * FLIGHT.t, 1.7 * FLIGHT.t + 1.0, 0.0 * FLIGHT.t], axis=1))
    noise = Rotation.from_matrix(FLIGHT.R) * Rotation.from_rotvec(off)
    table = columns(dataclasses.replace(FLIGHT, R=noise.as_matrix()))
    text = MAP.partition("[rates]")[0]
    log = read_flight_log(write_csv(tmp_path / "log.csv", table), read_map(write_map(tmp_path / "map.toml", text)))
    assert 0.0 < log.agreement["lift"] < 0.5
    assert any("attitude explains" in warning for warning in log.warnings)
    assert log.notes[: len(log.warnings)] == log.warnings


@pytest.mark.parametrize("kind", ["noise", "voltage", "constant", "sawtooth"])
def test_column_that_is_not_thrust_gives_warning(kind, tmp_path):
    rng, t = np.random.default_rng(0), FLIGHT.t
    column = {"noise": 0.5 + 0.1 * rng.random(len(t)), "voltage": 16.2 - 0.02 * t - 0.05 * (FLIGHT.c - FLIGHT.c.mean()),
              "constant": np.full(len(t), 0.5), "sawtooth": 0.4 + 0.2 * np.mod(t / 1.7, 1.0)}[kind]  # fmt: skip
    log = read(tmp_path, TABLE | {"c": column}, thrust__unit='"share"')
    assert log.agreement["climb"] < 0.1
    assert any(warning.startswith("thrust explains ") for warning in log.warnings)
    assert ("thrust is 0.5 throughout" in log.notes) == (kind == "constant")


def test_rates_masked_as_unused_are_ignored(tmp_path):
    """The type mask of such a message states that its rates are ignored."""
    log = read(tmp_path, TABLE | {name: 0.0 * TABLE[name] for name in ("wx", "wy", "wz")})
    assert log.command is None
    assert "rates are 0 throughout, and are not used" in log.notes
    log = read(tmp_path, TABLE | {name: np.nan * TABLE[name] for name in ("wx", "wy", "wz")})
    assert log.command is None
    assert "rates are not finite throughout, and are not used" in log.notes
