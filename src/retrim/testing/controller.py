"""Conformance suite for controllers."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..control.controller import AbstractController
from ..physics.state import Command, State
from ..plants.plant import as_numpy
from .laws import close, require, shapes


def check_controller(controller: AbstractController[Any], *, x0: State | None = None) -> None:
    """Check a controller.

    Args:
        controller: Controller to check.
        x0: Start state of the check.

    Raises:
        AssertionError: A law is broken.
    """
    start = State.at(jnp.array([0.3, -0.2, 1.2])) if x0 is None else x0
    memory = controller.init(start)
    step = eqx.filter_jit(lambda controller, memory, t, x: controller(memory, t, x))
    t = jnp.zeros_like(start.p[0])
    u, later = step(controller, memory, t, start)
    require(u.c.shape == () and u.omega.shape == (3,), "a command is a thrust and three body rates")
    require(bool(np.isfinite(as_numpy(u)).all()), "commands are finite")
    require(shapes(memory) == shapes(later), "the memory keeps its shapes")
    same, _ = step(controller, memory, t, start)
    close(as_numpy(u), as_numpy(same), 0.0, "the same memory, time and state give the same command")
    memory_after = controller.accept(later, Command.hover())
    require(shapes(memory_after) == shapes(later), "a corrected memory keeps its shapes")
