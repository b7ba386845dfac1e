"""Converts a log's axes, named by letters, to east-north-up and forward-left-up."""

import numpy as np

WORLD = {"E": (1, 0, 0), "W": (-1, 0, 0), "N": (0, 1, 0), "S": (0, -1, 0), "U": (0, 0, 1), "D": (0, 0, -1)}
BODY = {"F": (1, 0, 0), "B": (-1, 0, 0), "L": (0, 1, 0), "R": (0, -1, 0), "U": (0, 0, 1), "D": (0, 0, -1)}


def check_world(name: str) -> str:
    """Return the world axes if they are three of east, west, north, south, up and down, one from each pair."""
    return _check(name, WORLD, "E, W, N, S, U, D, as ENU, NED, NWU or EUS")


def check_body(name: str) -> str:
    """Return the body axes if they are three of forward, back, left, right, up and down, one from each pair."""
    return _check(name, BODY, "F, B, L, R, U, D, as FLU, FRD or RFU")


def to_world(name: str) -> np.ndarray:
    """Return the matrix (3, 3) from the log's world axes to east, north, up."""
    return np.array([WORLD[letter] for letter in name], dtype=float).T


def to_body(name: str) -> np.ndarray:
    """Return the matrix (3, 3) from the log's body axes to forward, left, up."""
    return np.array([BODY[letter] for letter in name], dtype=float).T


def left_handed(name: str) -> bool:
    """Return whether world or body axes are left-handed."""
    table = WORLD if set(name) <= set(WORLD) else BODY
    return bool(np.linalg.det(np.array([table[letter] for letter in name], dtype=float)) < 0.0)


def _check(name: str, letters: dict[str, tuple[int, int, int]], words: str) -> str:
    rows = [letters.get(letter, (0, 0, 0)) for letter in name]
    if len(name) != 3 or abs(np.linalg.det(np.array(rows, dtype=float))) != 1.0:
        raise ValueError(f"{name[:20]!r} are not three axes; they must be three of {words}")
    return name
