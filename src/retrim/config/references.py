"""Registry of references: built-in shapes, CSV files, custom functions, and families of references."""

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..control.pace import PaceLimits
from ..errors import ConfigError
from ..physics.effective_gravity import EffectiveGravityFrame
from ..tasks.reference import Reference, join_references
from ..tasks.shapes import AT_SPEED, FASTEST
from ..tasks.shapes import REFERENCES as BUILT_IN
from ..tasks.trajectory_csv import from_csv
from .pacing import SUFFIX, is_paced, plain_name, training_tables
from .presets import Track
from .registry import Registry

REFERENCES: Registry[Callable[[], Reference]] = Registry(
    "reference",
    example="a CSV file of t, x, y, z, as my.csv or my.csv:once, or module:name",
    expected="a function that returns a Reference",
)
for _name, _make in BUILT_IN.items():
    REFERENCES.register(_name, _make)
register_reference = REFERENCES.register

PUSH_SEED = 0
"""Seed of the pushes whose effective gravity transforms training references; the same for every policy seed."""

LAPS = {"": None, "laps": True, "once": False}
"""Suffixes after a CSV file and a colon, which state whether the trajectory repeats."""


def make_reference(names: str) -> Reference:
    """Return a reference by name.

    Args:
        names: A registered name, ``module:name`` of a function that returns a reference, or a CSV file. A closed
            trajectory in a file repeats in laps; any other trajectory ends after one pass. ``my.csv:laps`` requires
            laps, and ``my.csv:once`` requires one pass. A top speed [m/s] may follow a shape, e.g. ``circle=8``.
            Several names joined by ``+`` form a family. The suffix ``=max`` of a paced reference does not change the
            result, since a controller chooses the pace in flight.

    Raises:
        ConfigError: There is no such reference, or a CSV file cannot be used.
    """
    return _make_reference(names, 0, 0.0)


def make_training_reference(table: Track, limits: PaceLimits) -> Reference:
    """Return the training reference: the named reference, and copies of it in the effective gravity of pushes.

    Args:
        table: Table of the task.
        limits: Limits of the training vehicle, for the growing pace of a paced reference.

    Raises:
        ConfigError: As for :func:`make_reference`.
    """
    if SUFFIX not in table.reference:
        return _make_reference(table.reference, table.gravity_copies, table.gravity_push)
    members = list[Reference]()
    for name in table.reference.split("+"):
        plain = _one_reference(name)
        members += training_tables(plain, limits) if is_paced(name) else [plain]
    return _family(members, table.gravity_copies, table.gravity_push)


def _make_reference(names: str, copies: int, push: float) -> Reference:
    """Return a reference or a family, with ``copies`` of each member under random pushes of up to ``push`` [m/s^2]."""
    if all(name.partition("=")[0] in BUILT_IN for name in names.split("+")):
        return _make_built_in(names, copies, push, jax.config.values["jax_enable_x64"])
    return _family([_one_reference(name) for name in names.split("+")], copies, push)


@functools.cache
def _make_built_in(names: str, copies: int, push: float, x64: bool) -> Reference:
    """Return built-in references, sampled once per process and precision; CSV files are read on every call instead."""
    return _family([_one_reference(name) for name in names.split("+")], copies, push)


def _family(plain: Sequence[Reference], copies: int, push: float) -> Reference:
    if len(plain) == 1 and not copies:
        return plain[0]
    draw = np.random.default_rng(PUSH_SEED)
    directions = draw.normal(size=(len(plain), copies, 3))
    sizes = push * draw.uniform(size=(len(plain), copies, 1)) ** (1.0 / 3.0)  # uniform in a ball
    pushes = sizes * directions / np.linalg.norm(directions, axis=2, keepdims=True)
    perturbed_copies = [
        r.in_frame(EffectiveGravityFrame.of(jnp.asarray(d)))
        for r, many in zip(plain, pushes, strict=True)
        for d in many
    ]
    return join_references([*plain, *perturbed_copies])


def _one_reference(name: str) -> Reference:
    name = plain_name(name)
    file, _, how = name.rpartition(":") if ".csv:" in name.lower() else (name, "", "")
    shape, size, speed = name.partition("=")
    try:
        if size and shape in AT_SPEED:
            return AT_SPEED[shape](_speed(name, speed))
        if file.lower().endswith(".csv"):
            if how not in LAPS:
                raise ConfigError(f"{name}: {how!r} is not 'laps' or 'once'")
            return from_csv(Path(file), LAPS[how])
        reference: Any = REFERENCES.find(name)()
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror or error}") from error
    except (TypeError, ValueError) as error:
        raise error if isinstance(error, ConfigError) else ConfigError(f"reference {name}: {error}") from error
    if not isinstance(reference, Reference):
        raise ConfigError(
            f"reference {name!r} is a {type(reference).__name__}, not a function that returns a Reference"
        )
    return reference


def _speed(name: str, text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.1 <= speed <= FASTEST:
        raise ConfigError(f"reference {name!r}: {text!r} is not a top speed of 0.1 to {FASTEST:g} m/s, and not max")
    return speed
