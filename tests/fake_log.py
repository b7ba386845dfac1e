"""A flight with exactly known states, as arrays and as log files."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from retrim.physics.state import STANDARD_GRAVITY

G = np.array([0.0, 0.0, STANDARD_GRAVITY])
NED_OF_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_OF_FLU = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Flight:
    """World ENU, body forward-left-up."""

    t: np.ndarray
    p: np.ndarray
    R: np.ndarray
    v: np.ndarray
    a: np.ndarray
    c: np.ndarray
    """Thrust, which acts and equals the command [m/s^2]."""
    omega: np.ndarray


def fly_once(seconds=30.0, dt=0.02, wind=(0.0, 0.0, 0.0), gain=1.0, seed=0, size=1.0):
    """Return an agile flight: sums of sines, thrust from flatness, a turning heading; ``wind`` is a constant push."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(round(seconds / dt) + 1)
    waves = 2 * np.pi * rng.uniform(0.1, 0.45, size=(3, 4))
    size = size * np.array([0.5, 0.5, 0.25])[:, None] * rng.uniform(0.5, 1.0, size=(3, 4))
    phase = rng.uniform(0, 2 * np.pi, size=(3, 4))
    angle = waves[None] * t[:, None, None] + phase[None]
    p = np.sum(size * np.sin(angle), axis=2) + np.array([0.0, 0.0, 2.0])
    v = np.sum(size * waves * np.cos(angle), axis=2)
    a = np.sum(-size * waves**2 * np.sin(angle), axis=2)
    specific_force = a + G - np.array(wind)
    R = _attitudes(specific_force, 0.6 * np.sin(0.9 * t))
    omega = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec() / dt
    c = np.linalg.norm(specific_force, axis=1) / gain
    return Flight(t, p, R, v, a, c, np.concatenate([omega, omega[-1:]]))


def _attitudes(specific_force, yaw):
    z = specific_force / np.linalg.norm(specific_force, axis=1, keepdims=True)
    ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    y = np.cross(z, ahead)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=2)


def columns(flight: Flight) -> dict[str, np.ndarray]:
    """Return the columns of a CSV file, by name."""
    q = Rotation.from_matrix(flight.R).as_quat()
    parts = {"p": flight.p, "v": flight.v, "q": q, "w": flight.omega}
    names = {f"{name}{'xyzw'[i]}": x[:, i].copy() for name, x in parts.items() for i in range(x.shape[1])}
    return {"t": flight.t.copy(), **names, "c": flight.c.copy()}


MAP = """
[time]
field = "t"
[position]
fields = ["px", "py", "pz"]
[velocity]
fields = ["vx", "vy", "vz"]
[attitude]
fields = ["qx", "qy", "qz", "qw"]
form = "xyzw"
[thrust]
fields = ["c"]
unit = "m/s^2"
[rates]
fields = ["wx", "wy", "wz"]
"""


def write_csv(path: Path, table: dict[str, np.ndarray]) -> Path:
    """Write columns as CSV."""
    rows = zip(*table.values(), strict=True)
    lines = [",".join(table)] + [",".join("" if x is None else f"{x:.9g}" for x in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_map(path: Path, text: str = MAP, **changes: str) -> Path:
    """Write a map; ``table__key="value"`` changes or adds a line of a table."""
    for name, value in changes.items():
        table, _, key = name.partition("__")
        lines = [line for line in text.splitlines() if line.strip()]
        if f"[{table}]" not in lines:
            lines.append(f"[{table}]")
        at = lines.index(f"[{table}]") + 1
        end = next((i for i in range(at, len(lines)) if lines[i].startswith("[")), len(lines))
        rest = [line for line in lines[at:end] if not line.startswith(f"{key} =")]
        text = "\n".join([*lines[:at], *rest, f"{key} = {value}", *lines[end:]])
    path.write_text(text)
    return path


def turned_frames(flight: Flight) -> Flight:
    """Return the same flight in NED and forward-right-down."""
    W, B = NED_OF_ENU, FRD_OF_FLU
    return dataclasses.replace(
        flight, p=flight.p @ W.T, v=flight.v @ W.T, a=flight.a @ W.T, R=W @ flight.R @ B, omega=flight.omega @ B
    )
