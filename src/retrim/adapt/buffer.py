"""Rolling buffer of the last few seconds of flight."""

from collections import deque
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..learn.window import Window
from ..physics.state import Command, State


class RollingBuffer:
    """Keeps the last ``size`` ticks (paper, Sec. IV-A.3: 100 for hover). ``window`` returns a copy, not a view."""

    def __init__(self, size: int) -> None:
        if size < 2:
            raise ValueError(f"RollingBuffer: size = {size} must be at least 2, for one difference of velocity")
        # The leaves are NumPy arrays: each tick is converted once, and not again for every window that contains it.
        self._rows: deque[tuple[float, float, list[np.ndarray]]] = deque(maxlen=size)
        self._structure: Any = None
        self._size = size

    def __len__(self) -> int:
        return len(self._rows)

    def push(self, t: float, x: State, u: Command, age: float = 0.0) -> None:
        """Append the state measured at time ``t`` [s], its ``age`` [s], and the command issued at this tick."""
        leaves, self._structure = jax.tree.flatten((x, u))
        self._rows.append((t, age, [np.asarray(leaf) for leaf in leaves]))

    def accept(self, u: Command) -> None:
        """Replace the last command with the one that the plant accepted."""
        late = [np.asarray(leaf) for leaf in jax.tree.leaves(u)]
        _, _, leaves = self._rows[-1]
        leaves[-len(late) :] = late

    def clear(self) -> None:
        """Remove all ticks."""
        self._rows.clear()

    def window(self) -> Window:
        """Return a snapshot of fixed shape; while the buffer fills, invalid copies of the oldest tick come first.

        Raises:
            ValueError: The buffer is empty.
        """
        if not self._rows:
            raise ValueError("RollingBuffer: no tick was pushed yet")
        missing = self._size - len(self._rows)
        rows = [self._rows[0]] * missing + list(self._rows)
        columns = zip(*(leaves for _, _, leaves in rows), strict=True)
        x, u = jax.tree.unflatten(self._structure, jax.device_put([np.stack(column) for column in columns]))
        t, age = (jnp.asarray(np.array(column), dtype=x.p.dtype) for column in list(zip(*rows, strict=True))[:2])
        return Window(t, x, u, jnp.arange(self._size) >= missing, age)
