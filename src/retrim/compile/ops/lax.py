"""Implement controller operations for which NumPy has no function, with the semantics of :mod:`jax.lax`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

Index = tuple[int, ...]


def logistic(x: Any) -> Any:
    """Return the logistic function."""
    return 1 / (1 + np.exp(-x))


def erf_inv(x: Any) -> Any:
    """Return the inverse of the error function."""
    # A local import, because SciPy takes as long to import as all of retrim. Every program runs once before the flight.
    from scipy import special

    return special.erfinv(x)


def integer_div(a: Any, b: Any) -> Any:
    """Return the quotient of integers, rounded towards zero."""
    return (np.sign(a) * np.sign(b) * (np.abs(a) // np.abs(b))).astype(np.asarray(a).dtype)


def to_integer(x: Any, dtype: str) -> Any:
    """Return floats as integers, rounded towards zero and clamped to the range; NaN becomes 0."""
    x, range_ = np.asarray(x, dtype=float), np.iinfo(dtype)
    inside = np.where((x > range_.min) & (x < range_.max), x, 0.0).astype(dtype)
    low, high = np.array(range_.min, dtype), np.array(range_.max, dtype)
    return np.where(x >= range_.max, high, np.where(x <= range_.min, low, inside))


def pad(x: Any, value: Any, config: Sequence[tuple[int, int, int]]) -> Any:
    """Pad each axis by (low, high, interior); negative values crop."""
    x = np.asarray(x)
    shape = [
        max(0, low + high + n + max(0, n - 1) * inside) for n, (low, high, inside) in zip(x.shape, config, strict=True)
    ]
    wide = np.full([n + max(0, n - 1) * c[2] for n, c in zip(x.shape, config, strict=True)], value, dtype=x.dtype)
    wide[tuple(slice(None, None, c[2] + 1) for c in config)] = x
    out = np.full(shape, value, dtype=x.dtype)
    source, target = [], []
    for n, m, (low, _, _) in zip(wide.shape, shape, config, strict=True):
        source.append(slice(max(0, -low), max(0, min(n, m - low))))
        target.append(slice(max(0, low), max(0, low) + source[-1].stop - source[-1].start))
    out[tuple(target)] = wide[tuple(source)]
    return out


def dynamic_slice(x: Any, starts: Sequence[Any], sizes: Index) -> Any:
    """Return a block of ``x``; its start is clamped so that the block lies inside."""
    at = _clamp(x.shape, starts, sizes)
    return x[tuple(slice(i, i + n) for i, n in zip(at, sizes, strict=True))]


def dynamic_update_slice(x: Any, block: Any, starts: Sequence[Any]) -> Any:
    """Return a copy of ``x`` with ``block`` written at a start that is clamped so that the block lies inside."""
    block, out = np.asarray(block), np.array(x)
    at = _clamp(out.shape, starts, block.shape)
    out[tuple(slice(i, i + n) for i, n in zip(at, block.shape, strict=True))] = block
    return out


def gather(
    x: Any,
    indices: Any,
    offset: Index,
    collapsed: Index,
    start_map: Index,
    sizes: Index,
    *,
    fill: bool,
    value: float | int | None = None,
) -> Any:
    """Return slices of ``x`` at ``indices``, whose last axis holds one index vector.

    Args:
        x: Source array.
        indices: Start of each slice.
        offset: Axes of the result that are axes of a slice.
        collapsed: Axes of a slice that are dropped.
        start_map: Axis of ``x`` for each entry of an index vector.
        sizes: Size of a slice.
        fill: Whether a slice that exceeds the array is filled with ``value``; otherwise the slice is moved inside.
        value: Fill value; by default NaN, the smallest signed or largest unsigned integer, or true.
    """
    x, indices = np.asarray(x), np.asarray(indices)
    batch = indices.shape[:-1]
    remaining_sizes = tuple(n for axis, n in enumerate(sizes) if axis not in collapsed)
    out = np.empty((*batch, *remaining_sizes), dtype=x.dtype)
    kind = x.dtype.kind
    if value is None:
        value = np.nan if kind == "f" else kind == "b" or getattr(np.iinfo(x.dtype), "max" if kind == "u" else "min")
    for row in np.ndindex(*batch):
        starts = [0] * x.ndim
        for axis, i in zip(start_map, indices[row], strict=True):
            starts[axis] = int(i)
        at = _clamp(x.shape, starts, sizes)
        block = x[tuple(slice(i, i + n) for i, n in zip(at, sizes, strict=True))].reshape(remaining_sizes)
        out[row] = value if fill and list(at) != starts else block
    order, rows, inner = [], iter(range(len(batch))), iter(range(len(batch), out.ndim))
    for axis in range(out.ndim):
        order.append(next(inner if axis in offset else rows))
    return out.transpose(order)


def scatter(x: Any, indices: Any, updates: Any, window: Index, inserted: Index, dims: Index) -> Any:
    """Return a copy of ``x`` with ``updates`` written at ``indices``; updates that exceed the array are dropped."""
    out, indices, updates = np.array(x), np.asarray(indices), np.asarray(updates)
    batch_axes = [axis for axis in range(updates.ndim) if axis not in window]
    updates = updates.transpose([*batch_axes, *window])
    sizes, inner = [1] * out.ndim, iter(updates.shape[len(batch_axes) :])
    for axis in range(out.ndim):
        if axis not in inserted:
            sizes[axis] = next(inner)
    for row in np.ndindex(*indices.shape[:-1]):
        starts = [0] * out.ndim
        for axis, i in zip(dims, indices[row], strict=True):
            starts[axis] = int(i)
        if list(_clamp(out.shape, starts, tuple(sizes))) == starts:
            out[tuple(slice(i, i + n) for i, n in zip(starts, sizes, strict=True))] = updates[row].reshape(sizes)
    return out


def _clamp(shape: Index, starts: Sequence[Any], sizes: Index) -> list[int]:
    return [min(max(int(i), 0), n - size) for i, n, size in zip(starts, shape, sizes, strict=True)]
