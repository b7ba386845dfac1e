"""Process that reads flight rows, and identifies the vehicle and publishes it during a flight."""

import contextlib
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...adapt.vehicles import PIECE
from ...config.families import declared_vehicle, make_family
from ...config.presets import Preset
from ...control.belief_flight import vehicle_estimate
from ...control.vehicle_report import REPORTS, VehicleEstimate, VehicleReport
from ...errors import ConfigError, MessageError
from ...estimation.command_path import PathEstimator
from ...estimation.command_path import PathState as EstimatorState
from ...io.policies import load_learner_state
from ...onboard.heartbeat import Pacemaker
from ...onboard.messages import COLUMNS, COMMAND, MEASURED, FlightRows, Parameters, pack_note
from ...onboard.realtime import ParentWatch
from ...onboard.topics import VEHICLE
from ...physics.path_family import PathFamily
from ...physics.state import Command, State
from ...runkit.compile_cache import enable_compile_cache
from ...transport import wire
from ...transport.bus import Bus
from ...transport.shared_memory import SharedMemoryBus
from ..states import state_of

PERIOD = 0.1  # [s] between two messages
CHECK_EVERY = 0.005  # [s]
ALLOWANCE = 5.0  # [s], longest time to read the bus once and process the rows
ROWS_PER_STEP = 5 * PIECE  # rows per step
LEAST_CHANGE = 1e-3  # an estimate is published only if one of its numbers changes by more than this amount


@dataclass(frozen=True)
class IdentifierPlan:
    """Arguments of the process."""

    folder: Path
    """Folder of the bus."""
    start: Path
    """File with the preset."""
    base: str
    """Hash of the flight's controller."""
    parent: int
    trust: tuple[str, ...] = ()
    """Python names that ``start`` may contain."""


class IdentifierLoop:
    """Identifies the vehicle during one flight. Call :meth:`step` repeatedly."""

    def __init__(self, preset: Preset, base: str, bus: Bus) -> None:
        """Initialise the loop.

        Args:
            preset: Preset of the policy, with a vehicle family.
            base: Hash of the flight's controller.
            bus: Bus of the flight.

        Raises:
            ConfigError: The preset is for a single vehicle.
        """
        family = make_family(preset)
        if family is None:
            raise ConfigError(f"preset {preset.name!r} is for one vehicle, which is not identified")
        self.bus, self._base, self._family = bus, base, family
        self._estimator, self._declared = PathEstimator.of(preset.dt), declared_vehicle(preset)
        self._state: EstimatorState | None = None
        self._rows: deque[np.ndarray] = deque()
        self._flight_version, self._newest, self._row_count, self._t, self._due = 0, -1.0, 0, 0.0, -np.inf
        self._published: np.ndarray | None = None
        self._reports: list[tuple[float, str]] = []
        message = bus.latest(f"parameters.{VEHICLE}")
        self._version = 0 if message is None else message.version  # version from an earlier process

    def warm_up(self) -> None:
        """Compile the flight's programs with rows from a hovering vehicle, and discard the result."""
        row = np.zeros(len(COLUMNS))
        row[MEASURED] = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
        row[COMMAND] = np.asarray(Command.hover().vector())
        for _ in range(2 * PIECE):
            self._take(row)
        assert self._state is not None
        jax.block_until_ready(_vehicle(self._family, self._state))
        self._state, self._row_count, self._t = None, 0, 0.0

    def step(self) -> bool:
        """Process some of the new rows; return whether there were new rows."""
        self._look()
        if not self._rows:
            return False
        for _ in range(min(ROWS_PER_STEP, len(self._rows))):
            self._take(self._rows.popleft())
        if not self._rows and self._t >= self._due:
            self._due = self._t + PERIOD
            self._conclude(self._t)
        return True

    def _look(self) -> None:
        message = self.bus.latest("flight", self._flight_version)
        if message is None:
            return
        self._flight_version = message.version
        with contextlib.suppress(MessageError):
            rows = FlightRows.unpack(message.data).rows
            new = rows[rows[:, 0] > self._newest]
            self._rows.extend(new)
            self._newest = max([self._newest, *new[:, 0].tolist()])

    def _take(self, row: np.ndarray) -> None:
        dtype = np.dtype(np.float32)
        t, age = (jnp.asarray(value, dtype) for value in (row[1], row[2]))
        x, u = state_of(row[MEASURED], dtype), Command.of(jnp.asarray(row[COMMAND], dtype))
        state = _start(self._estimator, x) if self._state is None else self._state
        self._state = _measure(self._estimator, state, t, x, age, u)
        self._t, self._row_count = float(row[1]), self._row_count + 1
        if self._row_count % PIECE == 0:
            self._state = _estimate(self._estimator, self._state)

    def _conclude(self, t: float) -> None:
        """Publish the estimate if it has changed, and publish the report when it is due."""
        assert self._state is not None
        self._state = _estimate(self._estimator, self._state)
        arrays = wire.names(_vehicle(self._family, self._state))
        numbers = np.concatenate([np.ravel(np.asarray(leaf, dtype=float)) for leaf in arrays.values()])
        if self._published is None or np.abs(numbers - self._published).max() > LEAST_CHANGE:
            self._published, self._version = numbers, self._version + 1
            self.bus.publish(f"parameters.{VEHICLE}", Parameters(VEHICLE, self._version, self._base, t, arrays).pack())
        if len(self._reports) < len(REPORTS) and t >= REPORTS[len(self._reports)]:
            self._reports.append((t, VehicleReport(self._state.estimate, self._declared).note()))
            self.bus.publish("identified", pack_note("identified", reports=self._reports))


@eqx.filter_jit
def _start(estimator: PathEstimator, x: State) -> EstimatorState:
    return estimator.init(x)


@eqx.filter_jit
def _measure(
    estimator: PathEstimator, s: EstimatorState, t: Float[Array, ""], x: State, age: Float[Array, ""], u: Command
) -> EstimatorState:
    return estimator.issue(estimator.observe(s, t, x, age=age), u)


@eqx.filter_jit
def _estimate(estimator: PathEstimator, s: EstimatorState) -> EstimatorState:
    return estimator.estimate_path(s)


@eqx.filter_jit
def _vehicle(family: PathFamily, s: EstimatorState) -> VehicleEstimate:
    return vehicle_estimate(family, s.estimate)


def identify(plan: IdentifierPlan) -> None:
    """Identify the vehicle until the flight is over; this is the main function of the process."""
    enable_compile_cache()
    bus, parent = SharedMemoryBus(plan.folder), ParentWatch(plan.parent)
    _, preset = load_learner_state(plan.start, trust=plan.trust)
    loop = IdentifierLoop(preset, plan.base, bus)
    loop.warm_up()
    bus.publish("ready.identifier", pack_note("ready", base=plan.base))
    with contextlib.suppress(KeyboardInterrupt), Pacemaker(bus, "identifier") as heart:
        while not parent.has_ended() and bus.latest("ended") is None:
            heart.touch(ALLOWANCE)
            if not loop.step():
                time.sleep(CHECK_EVERY)
