"""Leave out short spikes in commands and inertial measurements that no vehicle can follow."""

import numpy as np

from . import log_map as maps
from .resampling import period
from .series import Series

LARGEST_SHARE, LARGEST_THRUST = 1.5, 200.0  # share of full thrust, and mass-normalised thrust [m/s^2]
LARGEST_RATE = {"rates": 20.0, "measured_rates": 40.0}  # [rad/s]
LARGEST_ACCELERATION = 400.0  # [m/s^2]
FACTOR = 5.0  # smallest ratio of a spike to the 95th percentile of all samples
LONGEST = 0.05  # [s]: a command that lasts longer has an effect, and may be intended
ONE_SAMPLE = 1.5  # [periods]: the same in a slow log


def leave_out_spikes(
    series: Series, name: str, spec: maps.Thrust | maps.BodyRates | maps.Acceleration
) -> tuple[Series, list[str]]:
    """Return a series without spikes, and a note on them.

    A spike exceeds the limits of a vehicle and is much larger than the other samples, but lasts only for a moment.

    Args:
        series: The samples of a command or an inertial measurement, in the log's unit.
        name: Name of the quantity.
        spec: The quantity's table in the map.
    """
    zero = spec.zero if isinstance(spec, maps.Thrust) else 0.0
    sizes = np.max(np.abs(series.values - zero), axis=1)
    large = sizes > max(_limit(name, spec), FACTOR * float(np.percentile(sizes, 95)))
    longest, spikes = max(LONGEST, ONE_SAMPLE * period(series)), np.zeros(len(large), dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], large.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        spikes[first:last] = series.t[min(last, len(large) - 1)] - series.t[first] <= longest
    if not spikes.any():
        return series, []
    note = f"{name}: {np.sum(spikes)} of {len(spikes)} samples are spikes that no vehicle can follow, and are left out"
    return Series(series.t[~spikes], series.values[~spikes]), [note]


def _limit(name: str, spec: maps.Thrust | maps.BodyRates | maps.Acceleration) -> float:
    """Return the limit of a vehicle in the log's unit."""
    if isinstance(spec, maps.Thrust):
        return LARGEST_SHARE * (spec.full - spec.zero) if spec.scale is None else LARGEST_THRUST / spec.scale
    if isinstance(spec, maps.BodyRates):
        return LARGEST_RATE[name] / maps.RATES[spec.unit]
    return LARGEST_ACCELERATION / maps.ACCELERATIONS[spec.unit]
