"""The rolling buffer returns copies of a window of fixed shape, with the commands that the plant accepted."""

import jax.numpy as jnp
import numpy as np
import pytest

from retrim.adapt import RollingBuffer
from retrim.physics import Command, State


def at(*p):
    return State.at(jnp.array(p))


def test_window_has_fixed_shape_and_masks_missing_ticks():
    buffer = RollingBuffer(4)
    with pytest.raises(ValueError, match="no tick was pushed"):
        buffer.window()
    for i in range(6):
        buffer.push(0.02 * i, at(float(i), 0.0, 1.0), Command(jnp.array(float(i)), jnp.zeros(3)))
        window = buffer.window()
        assert window.x.p.shape == (4, 3)
        assert int(window.valid.sum()) == min(i + 1, 4)
        newest = np.arange(max(0, i - 3), i + 1)
        np.testing.assert_allclose(window.t[np.asarray(window.valid)], 0.02 * newest)
        np.testing.assert_array_equal(window.x.p[np.asarray(window.valid), 0], newest)
        np.testing.assert_array_equal(window.u.c[np.asarray(window.valid)], newest)


def test_window_is_a_copy():
    buffer = RollingBuffer(2)
    buffer.push(0.0, at(1.0, 0.0, 1.0), Command.hover())
    before = buffer.window()
    buffer.push(0.0, at(2.0, 0.0, 1.0), Command.hover())
    buffer.push(0.0, at(3.0, 0.0, 1.0), Command.hover())
    assert float(before.x.p[-1, 0]) == 1.0


def test_accepted_command_replaces_only_last_command():
    buffer = RollingBuffer(3)
    for i in range(3):
        buffer.push(0.02 * i, at(float(i), 0.0, 1.0), Command(jnp.array(float(i)), jnp.zeros(3)))
    buffer.accept(Command(jnp.array(7.0), jnp.ones(3)))
    window = buffer.window()
    np.testing.assert_array_equal(window.u.c, [0.0, 1.0, 7.0])
    np.testing.assert_array_equal(window.u.omega[:, 0], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(window.x.p[:, 0], [0.0, 1.0, 2.0])
    assert len(buffer) == 3


def test_clear_empties_buffer():
    buffer = RollingBuffer(3)
    buffer.push(0.0, at(1.0, 0.0, 1.0), Command.hover())
    buffer.clear()
    assert len(buffer) == 0
    with pytest.raises(ValueError, match="no tick was pushed"):
        buffer.window()


def test_buffer_size():
    with pytest.raises(ValueError, match="size = 1 must be at least 2"):
        RollingBuffer(1)
