"""From a policy and a scenario to a live flight."""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from ..adapt.learner import LearnerState
from ..adapt.updates import Layer
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..control.policy import Policy
from ..errors import ConfigError
from ..experiments.flights import FlightSpec
from ..io.trained import save_learnt
from ..onboard.guard import Limits
from ..onboard.messages import MOST_TICKS
from ..plants.plant import as_numpy
from ..runtime.pilot import ControllerPilot
from .controllers import adaptive_source, plain_source
from .spec import LiveSpec
from .states import vector_of

LAYERS: tuple[Layer, ...] = ("residual", "policy")
LEARNING = ("full", "lora")
BELOW_GROUND = 0.3  # [m], by which a fence lies below z = 0: starts may lie there, and a transient dips


@dataclass(frozen=True)
class LiveRequest:
    """What is asked of a live flight."""

    setup: Setup
    """Preset of the policy, on the reference that is flown."""
    policy: Policy
    scenario: Scenario
    method: str
    """``full`` and ``lora`` learn; any method whose pilot is a controller flies."""
    seconds: float
    """Length of the flight, of which the fence must hold the whole reference [s]."""
    seed: int
    fence: float
    """How far from the reference the vehicle may be along any axis [m]."""
    folder: Path
    state: LearnerState | None = None
    """What an earlier flight learnt, to go on from."""

    @property
    def flight(self) -> FlightSpec:
        """The flight as results name it."""
        return FlightSpec(self.scenario, self.method, 0, self.seed)


def live_spec(request: LiveRequest) -> LiveSpec:
    """Return everything that the processes of a flight are started with; nothing is started.

    Raises:
        ConfigError: The method cannot be flown live.
    """
    setup, preset = request.setup, request.setup.preset
    window = max(preset.adapt.window, round(3.0 / preset.dt))
    if window > MOST_TICKS:
        raise ConfigError(f"adapt.window = {window} ticks: a live flight reports at most {MOST_TICKS}")
    k_residual = random.split(request.flight.key())[0]
    start = request.folder / "start.safetensors"
    if request.method in LEARNING:
        policy = request.policy
        chosen = setup.low_rank(policy, request.flight.key()) if request.method == "lora" else policy
        state = request.state or setup.learner.init(chosen, k_residual)
        controller = adaptive_source(setup, state)
        save_learnt(start, state, preset)
    else:
        pilot = setup.pilot(request.policy, request.method, request.flight.key())
        if not isinstance(pilot, ControllerPilot):
            raise ConfigError(f"method {request.method!r} is no controller, so it cannot fly live; full and lora learn")
        controller = plain_source(setup, pilot.controller)
        save_learnt(start, setup.learner.init(request.policy, k_residual), preset)
    return LiveSpec(
        controller=controller,
        layers=LAYERS if request.method in LEARNING else (),
        start=start,
        reference=request.scenario.reference,
        scenario=request.scenario,
        vehicle=preset.vehicle,
        x0=vector_of(setup.flight_starts(1, request.seed)[0]),
        home=np.asarray(setup.flown.home(), dtype=float),
        limits=_limits(request),
        dt=preset.dt,
        delay_ticks=preset.plant_delay_ticks,
        window=window,
        seconds=request.seconds,
        seed=request.flight.plant_seed,
        folder=request.folder,
    )


def _limits(request: LiveRequest) -> Limits:
    """What the vehicle takes, and a box around everything that the reference passes."""
    setup, fence = request.setup, request.fence
    vehicle = request.scenario.make_vehicle(setup.preset.vehicle)
    times = jnp.arange(0.0, max(request.seconds, setup.preset.dt), 0.05)
    places = np.asarray(jax.jit(jax.vmap(setup.flown.target))(times), dtype=float)
    low, high = places.min(0) - fence, places.max(0) + fence
    low[2] = max(low[2], min(-BELOW_GROUND, float(places[:, 2].min()) - BELOW_GROUND))
    return Limits(low, high, as_numpy(vehicle.command_min).astype(float), as_numpy(vehicle.command_max).astype(float))
