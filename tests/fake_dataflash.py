"""Write dataflash logs: messages that describe other messages, and the messages themselves."""

import struct

import numpy as np
from scipy.spatial.transform import Rotation

from fake_log import FRD_OF_FLU, G, turned_frames

HEAD = b"\xa3\x95"
TYPES = {"B": "B", "b": "b", "h": "h", "H": "H", "i": "i", "I": "I", "q": "q", "Q": "Q", "f": "f", "d": "d", "c": "h",
         "C": "H", "e": "i", "E": "I", "L": "i", "M": "B", "n": "4s", "N": "16s", "Z": "64s",
         "a": "64s"}  # fmt: skip
KINDS = {
    "PARM": (64, "QNf", "TimeUS,Name,Value"),
    "EV": (65, "QB", "TimeUS,Id"),
    "XKF1": (66, "QBccCfffffff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD"),
    "RATE": (67, "Qffffffffffff", "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut"),
    "IMU": (68, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "RCOU": (69, "QHHHH", "TimeUS,C1,C2,C3,C4"),
}
DEG = 180.0 / np.pi


def describe(name, code, codes, labels):
    """Return the message that describes a different one."""
    length = 3 + struct.calcsize("<" + "".join(TYPES[c] for c in codes))
    return HEAD + struct.pack("<BBB4s16s64s", 128, code, length, name.encode(), codes.encode(), labels.encode())


def message(name, *values):
    """Return one message."""
    code, codes, _ = KINDS[name]
    return HEAD + struct.pack("<B" + "".join(TYPES[c] for c in codes), code, *values)


def formats(without=()):
    """Return all descriptions, starting with that of descriptions."""
    first = HEAD + struct.pack("<BBB4s16s64s", 128, 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    return first + b"".join(describe(name, *kind) for name, kind in KINDS.items() if name not in without)


def sorted_messages(rows):
    """Return messages in order of time."""
    return b"".join(data for _, data in sorted(rows, key=lambda row: row[0]))


def flight_messages(flight, start=3.0, *, without=(), events=True, every=2):
    """Return ArduCopter messages of a flight with attitudes: NED, forward-right-down, two estimators and two IMUs."""
    ned, stamp = turned_frames(flight), [round(1e6 * (t + start)) for t in flight.t]
    angles = Rotation.from_matrix(ned.R).as_euler("ZYX", degrees=True)
    force = np.einsum("nji,nj->ni", flight.R, flight.a + G) @ FRD_OF_FLU.T
    share, rates, rows = 0.35 * flight.c / G[2], ned.omega * DEG, []
    if events:
        rows += [(stamp[0] - 1, message("EV", stamp[0] - 1, 10)), (stamp[-1] + 1, message("EV", stamp[-1] + 1, 11))]
    for k, t in enumerate(stamp):
        yaw, pitch, roll = (int(np.round(100.0 * x)) for x in angles[k])
        entries = []
        if k % every == 0:
            state = (roll, pitch, yaw % 36000, *ned.v[k], 0.0, *ned.p[k])
            entries += [("XKF1", t, 0, *state), ("XKF1", t, 1, *state[:3], *(np.array(state[3:]) + 100.0))]
        w = rates[k]
        entries += [("RATE", t, w[0], w[0], 0.0, w[1], w[1], 0.0, w[2], w[2], 0.0, 0.0, 0.0, share[k])]
        entries += [("IMU", t, i, *(w / DEG), *(force[k] + 50.0 * i)) for i in (0, 1)]
        entries += [("RCOU", t, *[round(1000 + 800 * share[k])] * 4)]
        rows += [(t, message(*each)) for each in entries if each[0] not in without]
    return rows


def dataflash(*parts, without=()):
    """Return a log of the messages of one or more flights."""
    parameter = message("PARM", 1000, b"MOT_THST_HOVER", 0.35)
    return formats(without) + parameter + b"".join(sorted_messages(each) for each in parts)


def body_messages(flight, start=3.0):
    """Return ArduCopter messages of a flight with rates only."""
    rows = []
    c, w, f = flight.command @ FRD_OF_FLU.T * DEG, flight.rates @ FRD_OF_FLU.T * DEG, flight.force @ FRD_OF_FLU.T
    share = flight.motors.mean(axis=1)
    for k, at in enumerate(flight.t):
        t = round(1e6 * (at + start))
        rows.append((t, message("RATE", t, c[k, 0], w[k, 0], 0.0, c[k, 1], w[k, 1], 0.0, c[k, 2], w[k, 2], 0.0, 0.0,
                                0.0, share[k])))  # fmt: skip
        rows.append((t, message("IMU", t, 0, *(w[k] / DEG), *f[k])))
    return rows
