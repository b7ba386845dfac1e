"""Write Blackbox logs from the description of the format: I, P and S frames with every encoding, and two events."""

import struct
from functools import cache

import numpy as np

from fake_body_flight import IDLE
from retrim.physics.state import STANDARD_GRAVITY

DEG = 180.0 / np.pi
LOW, HIGH = 158, 2047
I_EVERY, P_EVERY = 256, 8  # loops
END = b"E\xffEnd of log\x00"
DISARM = b"E\x0f\x04"


def vb(value):
    """Encode a variable-length unsigned integer."""
    value &= 0xFFFFFFFF
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def svb(value):
    """Encode a variable-length signed integer."""
    return vb(value << 1 ^ value >> 31)


def eight(values):
    """Encode up to eight numbers after a byte that marks the non-zero ones."""
    if len(values) == 1:
        return svb(values[0])
    return bytes([sum((v != 0) << k for k, v in enumerate(values))]) + b"".join(svb(v) for v in values if v)


def fits(values, bits):
    return all(-(1 << (b - 1)) <= v < 1 << (b - 1) for v, b in zip(values, bits, strict=True))


def whole_bytes(values):
    sizes = [next(k for k in (1, 2, 3, 4) if fits([v], [8 * k])) for v in values]
    tag = 0xC0 | sum(size - 1 << 2 * k for k, size in enumerate(sizes))
    return bytes([tag]) + b"".join(
        v.to_bytes(size, "little", signed=True) for v, size in zip(values, sizes, strict=True)
    )


def three(values):
    """Encode three numbers of 2, 4 or 6 bits, or of whole bytes."""
    a, b, c = values
    if fits(values, (2, 2, 2)):
        return bytes([(a & 3) << 4 | (b & 3) << 2 | c & 3])
    if fits(values, (4, 4, 4)):
        return bytes([0x40 | a & 15, (b & 15) << 4 | c & 15])
    if fits(values, (6, 6, 6)):
        return bytes([0x80 | a & 63, b & 63, c & 63])
    return whole_bytes(values)


def four(values):
    """Encode four numbers of 0, 4, 8 or 16 bits, packed by half bytes."""
    sizes = [0 if v == 0 else 1 if fits([v], [4]) else 2 if fits([v], [8]) else 4 for v in values]
    tag = sum((0, 1, 2, 0, 3)[size] << 2 * k for k, size in enumerate(sizes))
    text = "".join(f"{v & (1 << 4 * size) - 1:0{size}x}" for v, size in zip(values, sizes, strict=True) if size)
    return bytes([tag]) + bytes.fromhex(text + "0" * (len(text) % 2))


CODES = {0: (svb, 1), 1: (vb, 1), 3: (lambda v: vb(-v & 0x3FFF), 1), 6: (eight, 8), 7: (three, 3), 8: (four, 4),
         9: (lambda v: b"", 1)}  # fmt: skip


def encode(codes, values):
    """Encode the numbers of a frame."""
    out, k = b"", 0
    while k < len(codes):
        write, most = CODES[codes[k]]
        count = 1
        while count < most and k + count < len(codes) and codes[k + count] == codes[k]:
            count += 1
        part = [int(v) for v in values[k : k + count]]
        out, k = out + (write(part) if most > 1 else write(part[0])), k + count
    return out


# field, signed, predictor and encoding of I, predictor and encoding of P
LAYOUT = [
    ("loopIteration", 0, 0, 1, 6, 9), ("time", 0, 0, 1, 2, 0),
    *((f"axisI[{k}]", 1, 0, 0, 1, 7) for k in range(3)),
    *((f"rcCommand[{k}]", int(k < 3), 0, int(k == 3), 1, 8) for k in range(4)),
    *((f"setpoint[{k}]", 1, 0, 0, 1, 8) for k in range(4)),
    *((f"gyroADC[{k}]", 1, 0, 0, 3, 0) for k in range(3)), *((f"accSmooth[{k}]", 1, 0, 0, 3, 0) for k in range(3)),
    *((f"debug[{k}]", 1, 0, 0, 1, 6) for k in range(8)), *((f"x[{k}]", 1, 0, 0, 1, 7) for k in range(3)),
    ("down", 1, 0, 3, 1, 3),
    ("motor[0]", 0, 11, 1, 3, 0), *((f"motor[{k}]", 0, 5, 0, 3, 0) for k in (1, 2, 3)),
]  # fmt: skip
UNFILTERED = [(f"gyroUnfilt[{k}]", 1, 0, 0, 3, 0) for k in range(3)]


def layout_of(version, without=()):
    """Return the fields of a firmware version."""
    fields = LAYOUT + (UNFILTERED if version >= (4, 5) else [])
    return [each for each in fields if not each[0].startswith(tuple(without) or ("-",))]


def numbers(flight, version, fine=False):
    """Return the numbers of a board: deg/s (tenths if ``fine``), 2048 per g, and DSHOT motor commands."""
    k = 10.0 if fine else 1.0
    n = len(flight.t[::1])
    stick = (flight.motors.mean(axis=1) - IDLE) / (1.0 - IDLE)
    columns = {"loopIteration": P_EVERY * np.arange(n), "time": np.round(5e6 + 1e6 * flight.t)}
    columns |= {f"rcCommand[{i}]": k * flight.command[:, i] * DEG * 0.8 for i in range(3)}
    columns |= {"rcCommand[3]": k * (1000.0 + 1000.0 * stick), "setpoint[3]": 1000.0 * stick}
    for i in range(3):
        columns |= {f"setpoint[{i}]": k * flight.command[:, i] * DEG, f"gyroADC[{i}]": k * flight.rates[:, i] * DEG,
                    f"gyroUnfilt[{i}]": k * flight.rates[:, i] * DEG, f"axisI[{i}]": 40.0 * flight.rates[:, i],
                    f"accSmooth[{i}]": 2048.0 * flight.force[:, i] / STANDARD_GRAVITY,
                    f"x[{i}]": 10.0 ** (i + 1) * flight.rates[:, 0]}  # fmt: skip
    columns["down"] = 4000.0 + 90.0 * flight.rates[:, 0]
    columns |= {f"motor[{i}]": LOW + (HIGH - LOW) * (flight.motors[:, i] - IDLE) / (1.0 - IDLE) for i in range(4)}
    columns |= {f"debug[{i}]": 100.0 * (i == 2) * flight.rates[:, 0] for i in range(8)}
    return {name: np.round(column).astype(int) for name, column in columns.items()}


def header(layout, version, fine=False, **more):
    """Return the lines of a header."""

    def row(index):
        return ",".join(str(each[index]) for each in layout)

    values = {
        "Product": "Blackbox flight data recorder by Nicholas Sherlock", "Data version": "2",
        "Field I name": row(0), "Field I signed": row(1), "Field I predictor": row(2), "Field I encoding": row(3),
        "Field P predictor": row(4), "Field P encoding": row(5), "Field S name": "flightModeFlags,stateFlags,phase,a,b",
        "Field S signed": "0,0,0,0,0", "Field S predictor": "0,0,0,0,0", "Field S encoding": "1,1,7,7,7",
        "Firmware type": "Betaflight",
        "Firmware revision": f"Betaflight {version[0]}.{version[1]}.0 (0a1b2c3d) STM32F7X2",
        "I interval": I_EVERY, "P interval": P_EVERY if version >= (4, 5) else f"1/{P_EVERY}", "minthrottle": 1070,
        "gyro_scale": "0x3f800000", "motorOutput": f"{LOW},{HIGH}", "acc_1G": 2048, "looptime": 125,
        "pid_process_denom": 1, "blackbox_high_resolution": int(fine),
    } | more  # fmt: skip
    return "".join(f"H {name}:{value}\n" for name, value in values.items() if value is not None).encode()


def blackbox(flight, version=(4, 5), *, without=(), fine=False, end=DISARM + END, **more):
    """Return a log of one flight, as bytes."""
    lines = header(layout_of(version, without), version, fine, **more)
    return lines + frames(flight, version, tuple(without), fine) + end


@cache
def frames(flight, version, without, fine):
    """Return the frames of a flight; logs that differ in their headers share them."""
    layout = layout_of(version, without)
    columns = numbers(flight, version, fine)
    rows = np.stack([columns[each[0]] for each in layout], axis=1).tolist()
    names = [each[0] for each in layout]
    first_motor = names.index("motor[0]") if "motor[0]" in names else None
    out, one, two = [b"S" + encode([1, 1, 7, 7, 7], [1, 0, 0, 1, 1])], None, None
    for row in rows:
        main = row[0] % I_EVERY == 0
        difference = []
        for k, each in enumerate(layout):
            predictor = each[2 if main else 4]
            total = 0 if main else one[k] + two[k]
            expected = {0: 0, 5: row[first_motor] if first_motor is not None else 0, 11: LOW}.get(predictor, 0)
            if not main:
                mean = total // 2 if total >= 0 else -(-total // 2)
                expected = {1: one[k], 2: 2 * one[k] - two[k], 3: mean, 6: row[0]}[predictor]
            difference.append(row[k] - expected)
        out.append((b"I" if main else b"P") + encode([each[3 if main else 5] for each in layout], difference))
        one, two = row, row if main else one
    return b"".join(out)


def decoded_csv(flight, version=(4, 5), settings=()):
    """Return the table of blackbox_decode; Blackbox Explorer adds settings above the table."""
    layout, columns = layout_of(version), numbers(flight, version)
    names = [each[0] for each in layout]
    title = ", ".join("time" if settings and n == "time" else "time (us)" if n == "time" else n for n in names)
    lines = [f'"{name}","{value}"' for name, value in settings]
    rows = np.stack([columns[n] for n in names], axis=1).tolist()
    return "\n".join([*lines, title, *(", ".join(map(str, row)) for row in rows)]) + "\n"


assert struct.pack("<f", 1.0)[::-1].hex() == "3f800000"  # the scale of the gyroscope in the header
