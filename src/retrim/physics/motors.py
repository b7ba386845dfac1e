"""Rotors that somebody else commands, in the place of a rate controller."""

import equinox as eqx
from jaxtyping import Array, Float

from .state import Command
from .substep import RotorState
from .vehicle import Vehicle


class CommandedSpeeds(eqx.Module):
    """A rate controller in form only: the rotors go as fast as it was told, whatever the command says."""

    speeds: Float[Array, "4"]
    """[rad/s]"""
    thrust_map: Float[Array, ""]
    """As that of a rate controller; nothing here depends on it."""

    def __call__(
        self, vehicle: Vehicle, s: RotorState, u: Command
    ) -> tuple[Float[Array, "4"], Float[Array, "3"], Float[Array, "3"]]:
        """Return the speeds, and what a rate controller remembers, unchanged."""
        return self.speeds, s.integral, s.wanted_slow
