"""Describes disturbances in words, for pictures and for the page of a live flight."""

import jax
import numpy as np
from jaxtyping import Array

from ..physics.effects import ExternalEffects
from .recovery import FREQUENT, timeline

MOST_CHANGES = 3  # changes of a disturbance that its description contains


def describe_effects(effects: ExternalEffects) -> str:
    """Return the effects at one instant in words; an empty string if there are no effects."""
    words = list[str]()
    if np.any(effects.push):
        same = len(set(effects.push.tolist())) == 1
        vector = ", ".join(f"{a:+g}" for a in effects.push)
        words.append(f"pushed by {effects.push[0]:+g} m/s² per axis" if same else f"pushed by ({vector}) m/s²")
    if np.any(effects.wind):
        words.append(f"wind of {np.linalg.norm(effects.wind):.1f} m/s")
    if effects.mass > 0:
        words.append(f"{1000 * effects.mass:.0f} g of load")
    if np.any(effects.gain != 1):
        words.append("rotors at " + ", ".join(f"{100 * g:.0f}" for g in effects.gain) + " %")
    return "; ".join(words)


def describe_disturbance(name: str, home: Array, seconds: float) -> str:
    """Return the effects of a disturbance on a vehicle at rest, with the times at which they begin.

    Args:
        name: Name of the disturbance.
        home: Position of the vehicle, world [m].
        seconds: Length of the flight [s].

    Returns:
        One line; an empty string if there are no effects.
    """
    times, effects, changes = timeline(name, home, seconds)
    if len(changes) > FREQUENT:
        return "changes all the time"
    parts = list[str]()
    for i in [0, *changes]:
        here: ExternalEffects = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], effects)
        if (words := describe_effects(here)) or parts:
            begin = f"from {times[i]:.1f} s " if i else ""
            parts.append(f"{begin}{words or 'nothing'}")
    more = ", and so on" if len(parts) > MOST_CHANGES else ""
    return ", ".join(parts[:MOST_CHANGES]) + more
