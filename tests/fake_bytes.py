"""Log files with made-up messages: ULogs byte by byte, and bags of ROS."""

import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fake_log import G, turned_frames

SIZES = {"float": "f", "uint64_t": "Q", "uint8_t": "B", "bool": "?"}


def ulog(topics, stamps) -> bytes:
    """Return a ULog.

    Args:
        topics: Fields of each topic as ``{"x": ("float", column), "q": ("float[4]", columns)}``.
        stamps: Times of the samples [us], for each topic or for all.
    """

    def message(kind, data):
        return struct.pack("<HB", len(data), ord(kind)) + data

    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    for name, fields in topics.items():
        paths = ";".join(f"{kind} {field}" for field, (kind, _) in fields.items())
        out.append(message("F", f"{name}:uint64_t timestamp;{paths};".encode()))
    out += [message("A", struct.pack("<BH", 0, i) + name.encode()) for i, name in enumerate(topics)]
    for i, (name, fields) in enumerate(topics.items()):
        own = stamps[name] if isinstance(stamps, dict) else stamps
        for k, stamp in enumerate(own):
            data = struct.pack("<HQ", i, int(stamp))
            for kind, values in fields.values():
                numbers = np.ravel(values[k]).tolist()
                letter = SIZES[kind.partition("[")[0]]
                data += struct.pack(f"<{len(numbers)}{letter}", *(x if letter == "f" else int(x) for x in numbers))
            out.append(message("D", data))
    return b"".join(out)


def px4_topics(flight):
    """Return the topics of PX4 1.10 and later, and stamps [us]: NED, forward-right-down, hover at half thrust."""
    ned = turned_frames(flight)
    q = np.roll(Rotation.from_matrix(ned.R).as_quat(), 1, axis=1)
    up = np.zeros_like(flight.c)
    thrust = np.stack([up, up, -0.5 * flight.c / G[2]], axis=1)
    place = {axis: ("float", ned.p[:, i]) for i, axis in enumerate("xyz")}
    speed = {f"v{axis}": ("float", ned.v[:, i]) for i, axis in enumerate("xyz")}
    message = {axis: ("float", ned.omega[:, i]) for i, axis in enumerate(("roll", "pitch", "yaw"))}
    return {
        "vehicle_local_position": {**place, **speed},
        "vehicle_attitude": {"q": ("float[4]", q)},
        "vehicle_rates_setpoint": {**message, "thrust_body": ("float[3]", thrust)},
        "vehicle_angular_velocity": {"xyz": ("float[3]", ned.omega)},
    }, np.round(1e6 * (flight.t + 3.0)).astype(int)


MAVROS = {
    "mavros_msgs/msg/AttitudeTarget": "std_msgs/Header header\nuint8 type_mask\ngeometry_msgs/Vector3 body_rate\n"
    "float32 thrust\n",
}
PX4_ODOMETRY = {
    "px4_msgs/msg/VehicleOdometry": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[3] position\nfloat32[4] q\n"
    "float32[3] velocity\nuint8 reset_counter\n",
    "px4_msgs/msg/VehicleRatesSetpoint": "uint64 timestamp\nfloat32 roll\nfloat32 pitch\nfloat32 yaw\n"
    "float32[3] thrust_body\n",
}
PX4_OLD_ODOMETRY = {
    "px4_msgs/msg/VehicleOdometry": "uint64 timestamp\nuint64 timestamp_sample\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "float32[4] q\nfloat32 vx\nfloat32 vy\nfloat32 vz\n",
    "px4_msgs/msg/VehicleRatesSetpoint": PX4_ODOMETRY["px4_msgs/msg/VehicleRatesSetpoint"],
}


def bag2(path: Path, definitions, messages, typestore=None) -> Path:
    """Write a bag of ROS 2 as MCAP.

    Args:
        path: Folder of the bag.
        definitions: Text of each message type that ROS does not define.
        messages: Topic, type, time of reception [ns] and fields of each message.
        typestore: Types of ROS, by default those of Humble.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = typestore or get_typestore(Stores.ROS2_HUMBLE)
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {}
        for topic, kind, arrival, fields in messages:
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, kind, typestore=store)
            setup = fields if not isinstance(fields, dict) else store.types[kind](**fields)
            bag.write(topics[topic], int(arrival), store.serialize_cdr(setup, kind))
    return path


def px4_messages(flight, *, old=False, clock=None, jitter=0.0, folder="/fmu/{}/"):
    """Return messages of PX4 over DDS with stamps of its clock, received late by up to ``jitter`` [s]."""
    ned = turned_frames(flight)
    q = np.roll(Rotation.from_matrix(ned.R).as_quat(), 1, axis=1).astype(np.float32)
    rng, last = np.random.default_rng(0), 0
    for k, t in enumerate(flight.t):
        us = round(1e6 * (t + 5.0))
        last = max(int(1.7e18 + 1e9 * (t + abs(rng.normal(0.0, jitter)))), last + 1000)
        p, v, w = (x[k].astype(np.float32) for x in (ned.p, ned.v, ned.omega))
        state = {"position": p, "velocity": v, "reset_counter": 0}
        if old:
            state = {name: float(x) for name, x in zip(("x", "y", "z", "vx", "vy", "vz"), (*p, *v), strict=True)}
        odometry = {"timestamp": us + 300, "timestamp_sample": us, "q": q[k], **state}
        lift = np.array([0.0, 0.0, -0.5 * flight.c[k] / G[2]], dtype=np.float32)
        rates = dict(zip(("roll", "pitch", "yaw"), map(float, w), strict=True))
        message = {"timestamp": us if clock is None else clock(t), **rates, "thrust_body": lift}
        yield folder.format("out") + "vehicle_odometry", "px4_msgs/msg/VehicleOdometry", last, odometry
        yield folder.format("in") + "vehicle_rates_setpoint", "px4_msgs/msg/VehicleRatesSetpoint", last + 100, message
