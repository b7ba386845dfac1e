"""Draw JAX's random numbers in NumPy: Threefry-2x32 with 20 rounds (Salmon et al. 2011), with JAX's counter layout.

A key consists of two 32-bit words, on the last axis. Controllers that draw random numbers, for example to simulate a
camera, draw the same numbers in a live flight as in JAX.
"""

from typing import Any

import numpy as np

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = np.uint32(0x1BD11BDA)


def threefry(key: Any, high: Any, low: Any) -> tuple[Any, Any]:
    """Return the two random words for each counter (``high``, ``low``) under a key."""
    words = (key[0], key[1], key[0] ^ key[1] ^ PARITY)
    a, b = high + words[0], low + words[1]
    for i in range(5):
        for r in ROTATIONS[i % 2]:
            a = a + b
            b = (b << np.uint32(r) | b >> np.uint32(32 - r)) ^ a
        a = a + words[(i + 1) % 3]
        b = b + words[(i + 2) % 3] + np.uint32(i + 1)
    return a, b


def seed(value: Any) -> np.ndarray:
    """Return a key made from an integer."""
    whole = int(value) & (0xFFFFFFFF if np.asarray(value).dtype.itemsize <= 4 else 0xFFFFFFFFFFFFFFFF)
    return np.array([whole >> 32, whole & 0xFFFFFFFF], dtype=np.uint32)


def fold_in(key: Any, value: Any) -> np.ndarray:
    """Return a new key made from a key and an integer."""
    high, low = seed(value)
    return np.stack(threefry(key, high, low))


def split(key: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of new keys."""
    return np.stack(threefry(key, *_counters(shape)), axis=-1)


def bits(key: Any, shape: tuple[int, ...], width: int) -> Any:
    """Return random integers with a width of 8 to 64 bits."""
    a, b = threefry(key, *_counters(shape))
    words = (a ^ b).astype(f"uint{width}")
    return words if width < 64 else a.astype(np.uint64) << np.uint64(32) | b.astype(np.uint64)


def _counters(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    low = np.arange(int(np.prod(shape)), dtype=np.uint32).reshape(shape)
    return np.zeros_like(low), low
