"""Report the identified vehicle to the controller and, as one line, to the log."""

import equinox as eqx
from jaxtyping import Array, Float

from ..estimation.command_path import PathEstimate, describe_path
from ..physics.path_family import PathBelief

REPORTS = (1.0, 5.0)
"""Flight times at which the identified vehicle is reported [s]."""
LEAST_LATENESS = 0.01  # [s], least lateness that is reported


class VehicleEstimate(eqx.Module):
    """Present estimate of the vehicle."""

    belief: PathBelief
    gain: Float[Array, ""]
    """Ratio of actual to commanded thrust."""


class VehicleReport(eqx.Module):
    """Present estimate of the vehicle, and the values from the vehicle file."""

    estimate: PathEstimate
    declared: Float[Array, "2"] | None = None
    """Command delay and rate lag from the vehicle file [s], if the file states both."""
    lateness: Float[Array, ""] | None = None
    """Undeclared lateness of measurements [s], if the flight has an inertial unit."""

    def age(self, declared: Float[Array, ""]) -> Float[Array, ""]:
        """Return the age of measurements [s].

        Args:
            declared: Declared age [s].
        """
        return declared if self.lateness is None else declared + self.lateness.astype(declared.dtype)

    def note(self) -> str:
        """Return a one-line description of the vehicle."""
        declared = None if self.declared is None else (float(self.declared[0]), float(self.declared[1]))
        result = describe_path(self.estimate, declared)
        if self.lateness is None or float(self.lateness) < LEAST_LATENESS:
            return result
        return f"{result}; measurements {1000.0 * float(self.lateness):.0f} ms older than declared"
