"""Writes an identified vehicle as a vehicle file for pretraining."""

import tomllib

from ..config.names import LONGEST_NAME, plain_from
from ..config.vehicle_file import VehicleSpec
from ..config.vehicles import make_vehicle, name_of
from .identification import Estimate, IdentifiedVehicle

SHORTEST, LONGEST = 0.002, 0.5  # limits for a lag in a vehicle file [s]
SUFFIX = "-identified"
MARK = "# Identified from"
"""The beginning of a vehicle file of this module."""
LONGEST_DELAY = 0.2  # longest delay in a vehicle file [s]
DAMPINGS = (0.1, 10.0)  # limits for a damping ratio in a vehicle file


def vehicle_toml(identification: IdentifiedVehicle, spec: str | VehicleSpec, source: str, *, remark: str = "") -> str:
    """Return a vehicle file with the identified values; all other values come from ``spec``.

    Args:
        identification: The identified parameters.
        spec: Vehicle for the values that are not identified.
        source: Name of the log or description of the flight, in plain characters.
        remark: A further sentence for the comment at the beginning.
    """
    base = make_vehicle(spec)
    keep = spec if isinstance(spec, VehicleSpec) else None
    mass = float(base.mass)
    lines = [
        f"{MARK} {source}. Values without a remark are those of {plain_from(name_of(spec))!r}.",
        "# Intervals contain the true value with a probability of 90 %.",
        *([f"# {remark}"] if remark else []),
        *(
            []
            if identification.thrust_gain is None
            else [f"# Thrust per commanded thrust: {identification.thrust_gain.text('')}."]
        ),
        *(
            f"# Linear drag along body {a}: {d.text('1/s')}."
            for a, d in zip("xyz", identification.drag, strict=True)
            if d
        ),
        f'name = "{plain_from(name_of(spec))[: LONGEST_NAME - len(SUFFIX)]}{SUFFIX}"',
        f"mass = {mass:.6g}  # [kg]",
        f"inertia = {_row(base.inertia.tolist())}  # [kg m^2]",
        f"arm = {_row(base.arm.tolist())}  # [m]",
    ]
    if identification.full_thrust is None:
        lines.append(f"thrust_max = {float(base.thrust_max):.6g}  # [N]")
    else:
        newton = Estimate(*(mass * x for x in identification.full_thrust))
        lines.append(f"thrust_max = {newton.value:.6g}  # [N], identified: {newton.text('N')}")
    lines.append(f"rates_max = {_row(base.omega_max.tolist())}  # [rad/s]")
    if identification.thrust_lag is None:
        lines.append(f"motor_tau = {float(base.motor_tau):.6g}  # [s]")
    else:
        lag = identification.thrust_lag
        lines.append(f"motor_tau = {_limit(lag.value):.4g}  # [s], identified: {lag.text('ms', 1000.0)}")
    base_lag = None if base.rate_lag is None else base.rate_lag.tolist()
    if (level := identification.rate_lag) is not None:
        yaw = identification.yaw_lag
        known = yaw.text("ms", 1000.0) if yaw else f"not determined, {'assumed equal' if base_lag is None else 'kept'}"
        origin = f"roll and pitch {level.text('ms', 1000.0)}, yaw {known}"
        yaw_lag = _limit((yaw or level).value) if yaw is not None or base_lag is None else base_lag[2]
        lags = [_limit(level.value), _limit(level.value), yaw_lag]
        lines.append(f"rate_lag = {_row(lags)}  # [s], identified: {origin}")
        if (damping := identification.rate_damping) is not None:
            least, most = DAMPINGS
            ratio = min(max(damping.value, least), most)
            lines.append(f"rate_damping = {_row([ratio] * 3)}  # identified: {damping.text('')}")
    elif base_lag is not None:
        lines.append(f"rate_lag = {_row(base_lag)}  # [s]")
        if base.rate_damping is not None:  # an identified lag describes a first-order loop, which has no damping
            lines.append(f"rate_damping = {_row(base.rate_damping.tolist())}")
    if (delay := identification.delay) is not None:
        origin = delay.text("ms", 1000.0)
        lines.append(f"command_delay = {min(max(delay.value, 0.0), LONGEST_DELAY):.4g}  # [s], identified: {origin}")
    elif keep is not None and keep.command_delay is not None:
        lines.append(f"command_delay = {keep.command_delay:.6g}  # [s]")
    if keep is not None:
        lines += [] if keep.propeller is None else [f'propeller = "{keep.propeller}"']
        lines += [] if keep.propeller_diameter is None else [f"propeller_diameter = {keep.propeller_diameter:.6g}"]
        lines += [] if keep.drag_area is None else [f"drag_area = {_row(list(keep.drag_area))}"]
    text = "\n".join([*lines, ""])
    tomllib.loads(text)
    return text


def _limit(lag: float) -> float:
    return min(max(lag, SHORTEST), LONGEST)


def _row(values: list[float]) -> str:
    return "[" + ", ".join(f"{x:.6g}" for x in values) + "]"
