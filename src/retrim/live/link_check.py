"""Check a vehicle's link without propellers: ``python -m retrim.live.link_check mavlink:udp:0.0.0.0:14540``.

The program connects as a flight does, but does not arm the vehicle. Move the vehicle by hand, forwards, to its left and
upwards, and turn it about each axis: the printed numbers must follow. In the end, the program states whether velocities
and body rates agree with positions and attitudes.
"""

import argparse
import math
import sys
import time
from collections.abc import Iterable, Sequence

import numpy as np

from ..config.scenario import Scenario
from ..errors import ConfigError, RetrimError
from ..plants.bridges.frames import heading_of
from ..plants.bridges.vehicle_plant import VehiclePlant
from ..plants.bridges.vehicle_state import VehicleState

SAMPLE_PERIOD_S, REPORT_PERIOD_S = 0.02, 0.5  # [s] between two states, and between two lines
LEAST_SPEED, LEAST_TURN = 0.1, 0.2  # [m/s] and [rad/s], smallest mean motion that can be compared
LEAST_AGREEMENT = 0.8
LENGTHS_S = 1.0, 3600.0  # [s], length of a check
SMOOTH = 5  # states over which a difference is taken


def agreement(expected: np.ndarray, measured: np.ndarray, smallest: float) -> float | None:
    """Return the cosine between two series of vectors; None if there is too little motion.

    Args:
        expected: Derivative of positions or attitudes, one row for each time.
        measured: Velocities or body rates at the same times.
        smallest: Root mean square of a motion that can be compared.
    """
    if len(expected) < 2 or math.sqrt(float(np.mean(np.sum(expected**2, axis=1)))) < smallest:
        return None
    return float(np.sum(expected * measured) / (np.linalg.norm(expected) * np.linalg.norm(measured) + 1e-9))


def compare(states: Sequence[tuple[float, VehicleState]]) -> dict[str, float | None]:
    """Return the agreement of velocities and of body rates with positions and attitudes.

    Args:
        states: Times at which the states were valid [s], and the states.
    """
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    rows = [now for last, now in zip([None, *states], states, strict=False) if last is None or now[0] - last[0] > 1e-3]
    pairs = list(zip(rows, rows[SMOOTH:], strict=False))
    dt = np.array([[b[0] - a[0]] for a, b in pairs]).reshape(-1, 1)
    velocities = np.array([b[1].p - a[1].p for a, b in pairs]).reshape(-1, 3) / dt
    turn_rates = np.array([Rotation.from_matrix(a[1].R.T @ b[1].R).as_rotvec() for a, b in pairs]).reshape(-1, 3) / dt
    middle = [x for _, x in rows[SMOOTH // 2 : SMOOTH // 2 + len(pairs)]]
    v, omega = (np.array(each).reshape(-1, 3) for each in ([x.v for x in middle], [x.omega for x in middle]))
    return {
        "velocity is the derivative of position": agreement(velocities, v, LEAST_SPEED),
        "body rates are the derivative of attitude": agreement(turn_rates, omega, LEAST_TURN),
    }


def line(x: VehicleState) -> str:
    """Return a state in one line."""
    tilt = math.degrees(math.acos(float(np.clip(x.R[2, 2], -1.0, 1.0))))
    nose, left = (
        -math.degrees(math.asin(float(np.clip(x.R[2, 0], -1.0, 1.0)))),
        math.degrees(math.asin(float(np.clip(x.R[2, 1], -1.0, 1.0)))),
    )
    numbers = " ".join(f"{each:+.2f}" for each in x.p)
    return (
        f"position {numbers} m, heading {math.degrees(heading_of(x.R)):+.0f} deg, tilt {tilt:.0f} deg (nose down "
        f"{nose:+.0f}, left side up {left:+.0f}), age {1000.0 * x.news:.0f} ms"
    )


def verdicts(results: dict[str, float | None]) -> Iterable[tuple[str, bool]]:
    """Yield a line for each agreement, and whether it is sufficient."""
    for name, value in results.items():
        if value is None:
            yield f"{name}: not known, since there was too little motion", False
        else:
            yield (
                f"{name}: {100.0 * value:.0f} % agreement; at least {100.0 * LEAST_AGREEMENT:.0f} % are needed",
                value > LEAST_AGREEMENT,
            )


def check(plant: VehiclePlant, seconds: float) -> bool:
    """Print the states of a link for some time, and return whether they agree with each other."""
    states: list[tuple[float, VehicleState]] = []
    plant.connect()
    began = last_report = time.monotonic()
    while (now := time.monotonic()) - began < seconds:
        x = plant.read()
        states.append((now - x.age, x))
        if now - last_report > REPORT_PERIOD_S:
            last_report = now
            print(line(x), flush=True)
        plant.wait(now + SAMPLE_PERIOD_S)
    good = True
    for text, is_good in verdicts(compare(states)):
        good &= is_good
        print(text, flush=True)
    return good


def main(words: Sequence[str] | None = None) -> int:
    """Check a link, and return the exit status: 0 if the states agree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plant", help="as for `retrim live --plant`")
    parser.add_argument("--vehicle", default="small", help="name or file of the vehicle")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the check")
    options = parser.parse_args(words)
    try:
        if not LENGTHS_S[0] <= options.seconds <= LENGTHS_S[1]:
            raise ConfigError(f"--seconds must be {LENGTHS_S[0]:g} to {LENGTHS_S[1]:g}, got {options.seconds:g}")
        scenario = Scenario(plant=options.plant)
        if not scenario.entry.is_vehicle or scenario.entry.has_world:
            sys.exit(f"plant {options.plant!r} is simulated; a link to a vehicle is needed, as mavlink or msp:...")
        with scenario.make(options.vehicle) as plant:
            assert isinstance(plant, VehiclePlant)
            return 0 if check(plant, options.seconds) else 1
    except RetrimError as error:
        sys.exit(f"{options.plant}: {error}")
    except KeyboardInterrupt:
        return 1


if __name__ == "__main__":
    sys.exit(main())
