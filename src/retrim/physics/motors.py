"""Command rotor speeds externally, without a rate controller."""

import equinox as eqx
from jaxtyping import Array, Float

from .state import Command
from .substep import RotorState
from .vehicle import Vehicle


class CommandedSpeeds(eqx.Module):
    """Replacement for a rate controller: the rotors turn at the given speeds, whatever the command."""

    speeds: Float[Array, "4"]
    """Rotor speeds [rad/s]."""
    thrust_map: Float[Array, ""]
    """Thrust map, as in a rate controller; unused."""

    def __call__(
        self, vehicle: Vehicle, s: RotorState, u: Command
    ) -> tuple[Float[Array, "4"], Float[Array, "3"], Float[Array, "3"]]:
        """Return the given speeds and the unchanged memory of the rate controller."""
        return self.speeds, s.integral, s.slow_setpoint
