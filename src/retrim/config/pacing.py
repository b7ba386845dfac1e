"""Paced references: names, limits of a vehicle, and tables with which a policy is trained."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..control.pace import PaceLimits
from ..control.paced_flight import feasible_share, ideal_step, slow_pace
from ..physics.vehicle import Vehicle
from ..tasks.paced_reference import Clock, PacedReference
from ..tasks.reference import Reference
from .command_paths import lag_of
from .presets import Preset

SUFFIX = "=max"
"""End of the name of a reference that is followed as fast as the vehicle permits."""
RESERVE = 0.1  # share of thrust and rates that is left for feedback
CORNER = 0.05  # [m], largest distance between the vehicle and a corner
TURN_ACCELERATION = 10.0  # [m/s^2], acceleration with which a vehicle turns at a corner
SHARES = (0.6, 1.0)  # shares of the feasible pace in training
RISE = 0.15  # [1/s], relative growth of this share
DT, SECONDS = 0.02, 20.0  # [s], time between rows and duration of a training table


def plain_name(name: str) -> str:
    """Return the name of a reference without the suffix of a paced reference."""
    return name.removesuffix(SUFFIX)


def is_paced(name: str) -> bool:
    """Return whether a name is that of one paced reference, and not that of a family."""
    return name.endswith(SUFFIX) and "+" not in name


def pace_limits(preset: Preset, vehicle: Vehicle) -> PaceLimits:
    """Return the limits of a vehicle along a path.

    Args:
        preset: Preset with the declared lag of the body rates.
        vehicle: Vehicle with the command limits.
    """
    share, lag = 1.0 - RESERVE, lag_of(preset, vehicle)
    return PaceLimits(
        share * vehicle.command_max.c,
        share * vehicle.omega_max,
        jnp.zeros(3) if lag is None else lag.omega,
        jnp.array(CORNER),
        jnp.array(TURN_ACCELERATION),
    )


def training_tables(reference: Reference, limits: PaceLimits) -> list[Reference]:
    """Return tables of a reference at growing pace, up to shares of the largest feasible pace.

    Args:
        reference: Reference.
        limits: Limits of the training vehicle.
    """
    return [Reference.from_rows(_rows(reference, limits, jnp.array(share)), jnp.array(DT)) for share in SHARES]


@eqx.filter_jit
def _rows(reference: Reference, limits: PaceLimits, share: Float[Array, ""]) -> Float[Array, "n 18"]:
    pace = slow_pace(reference)
    first = feasible_share(reference, limits, pace)

    def step(clock: Clock, _: None) -> tuple[Clock, Float[Array, "18"]]:
        point = PacedReference(reference, clock)(clock.t)
        present = jnp.minimum(first * jnp.exp(RISE * clock.t), share)
        row = jnp.concatenate([leaf.reshape(-1) for leaf in point])
        return ideal_step(reference, limits, clock, present, DT), row

    rows: Float[Array, "n 18"] = lax.scan(step, Clock.at_pace(pace), None, length=round(SECONDS / DT))[1]
    return rows
