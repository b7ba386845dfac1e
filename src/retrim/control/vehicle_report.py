"""Report the identified vehicle to the controller and, as one line, to the log."""

import equinox as eqx
from jaxtyping import Array, Float

from ..estimation.command_path import PathEstimate, describe_path
from ..physics.path_family import PathBelief

REPORTS = (1.0, 5.0)
"""Flight times at which the identified vehicle is reported [s]."""


class VehicleEstimate(eqx.Module):
    """Present estimate of the vehicle."""

    belief: PathBelief
    gain: Float[Array, ""]
    """Ratio of actual to commanded thrust."""


class VehicleReport(eqx.Module):
    """Present estimate of the vehicle, and the values from the vehicle file."""

    estimate: PathEstimate
    declared: Float[Array, "2"] | None = None
    """Command delay and rate lag from the vehicle file [s]; None if the file does not state them."""

    def note(self) -> str:
        """Return a one-line description of the vehicle."""
        if self.declared is None:
            return describe_path(self.estimate)
        delay, lag = (float(each) for each in self.declared)
        return describe_path(self.estimate, (delay, lag))
