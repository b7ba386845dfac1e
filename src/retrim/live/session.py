"""Derive the specification of a live flight from a policy and a scenario."""

import secrets
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Key

from ..adapt.learner_state import LearnerState
from ..adapt.updates import Layer
from ..config.faults import measurement_fault
from ..config.methods import find_method, learning_methods
from ..config.presets import Preset
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..config.trust import python_names
from ..control.policy import AbstractPolicy
from ..errors import ConfigError
from ..io.policies import save_learner_state
from ..onboard.guard import Limits
from ..onboard.messages import MOST_TICKS
from ..physics.state import State
from ..plants.plant import as_numpy
from ..runkit.disturbance_text import describe_disturbance
from ..runkit.flights import FlightSpec
from ..runtime.pilot import ControllerPilot
from ..transport.remote import Address
from ..transport.shared_key import read_key
from .live_options import choices, paths
from .operator.page import free_port
from .processes.controllers import adaptive_source, plain_source
from .spec import VEHICLE, LiveSpec, PageSpec
from .states import vector_of

LAYERS: tuple[Layer, ...] = ("residual", "policy")
PATH_S = 20.0  # [s], duration of the reference path on the page
WORLD_S = 60.0  # [s], flight time for which the page describes the disturbance
STEP = 0.05  # [s] between two positions on the path
FENCE_DEPTH = 0.3  # [m], depth of the fence below z = 0: flights may start at z = 0, and transients go lower
LONGEST = 3600.0  # [s], maximum duration of a flight


def live_setup(preset: Preset, reference: str | None, method: str) -> Setup:
    """Return the set-up of a live flight after checking, before training begins, that the method suits the preset.

    Args:
        preset: Preset of the policy.
        reference: Reference of the flight; by default, the one in the preset.
        method: Method of the flight.

    Raises:
        ConfigError: The method cannot be used with the preset, or in a live flight.
    """
    setup = Setup.from_preset(preset, reference)
    if find_method(method).learns is None:
        _pilot(setup, setup.new_policy(random.key(0)), method, random.key(0))
    return setup


def _pilot(setup: Setup, policy: AbstractPolicy, method: str, key: Key[Array, ""]) -> ControllerPilot:
    """Return the pilot of a method that does not learn, or raise ``ConfigError`` if the method cannot fly live."""
    if find_method(method).on_board is not None:
        raise ConfigError(
            f"method {method!r} commands the motors on board; a live flight commands thrust and body rates"
        )
    pilot = setup.pilot(policy, method, key)
    if not isinstance(pilot, ControllerPilot):
        raise ConfigError(f"method {method!r} must learn or return a ControllerPilot to fly live")
    return pilot


def check_limits(fence: float, seconds: float | None, policy_age: float | None) -> None:
    """Check the limits of a live flight before training begins.

    Args:
        fence: Maximum distance of the vehicle from the reference [m].
        seconds: Duration of the flight [s]; by default, the user stops the flight.
        policy_age: Maximum age of the flight data from which the policy was learned [s]; by default, there is no limit.

    Raises:
        ConfigError: One of the limits is out of range.
    """
    if policy_age is not None and not policy_age > 0.0:
        raise ConfigError(f"--policy-age {policy_age:g} s must be positive")
    if not 0.5 <= fence <= 1000.0:
        raise ConfigError(f"--fence {fence:g} m must be between 0.5 and 1000")
    if seconds is not None and not 1.0 <= seconds <= LONGEST:
        raise ConfigError(f"--seconds {seconds:g} must be between 1 and {LONGEST:g}")


@dataclass(frozen=True)
class LiveRequest:
    """Request for a live flight."""

    setup: Setup
    """Set-up of the policy's preset with the flight's reference."""
    policy: AbstractPolicy
    scenario: Scenario
    method: str
    """Method of the flight: a learning method, or a method whose pilot is a controller."""
    seconds: float
    """Duration of the flight [s]; the fence encloses the reference over this time."""
    seed: int
    fence: float
    """Maximum distance of the vehicle from the reference along each axis [m]."""
    folder: Path
    state: LearnerState | None = None
    """Learned state of an earlier flight, from which learning continues."""
    page: tuple[str, int] | None = None
    """Address and port of the page, if any."""
    learners: Address | None = None
    """Address of the learners on another machine; by default, they run on this machine."""
    policy_age: float = float("inf")
    """Maximum age of the flight data from which the policy was learned [s]."""
    record: Path | None = None
    """Path of an additional recording, if any."""
    until_stop: bool = False
    """Whether an interruption is the intended end of the flight."""

    @property
    def reference_name(self) -> str:
        """Name of the initial reference; empty if there is no reference."""
        track = self.setup.preset.track
        return self.scenario.reference or ("" if track is None else track.reference)

    @property
    def flight(self) -> FlightSpec:
        """Specification of the flight for the results."""
        return FlightSpec(self.scenario, self.method, 0, self.seed)


def live_spec(request: LiveRequest) -> LiveSpec:
    """Return the specification of all processes of a flight; do not start the processes.

    Raises:
        ConfigError: The method cannot be used in a live flight, or the reference is not finite.
    """
    setup, preset = request.setup, request.setup.preset
    window = max(preset.adapt.window, round(3.0 / preset.dt))
    vehicle = request.scenario.entry.is_vehicle  # a vehicle starts at rest at the start of its reference
    if request.learners is not None:
        _check_remote(request)
    fault = measurement_fault(request.scenario.fault)
    if fault is not None and fault.interrupts:
        raise ConfigError(f"--fault {request.scenario.fault}: a live flight has its own clock; use `retrim fly`")
    if window > MOST_TICKS:
        raise ConfigError(f"adapt.window = {window} ticks: a live flight reports at most {MOST_TICKS}")
    start = request.folder / "start.safetensors"
    learns = find_method(request.method).learns is not None
    if learns:
        state = request.state or learner_state(request, request.policy, request.method)
        controller = adaptive_source(setup, state)
        save_learner_state(start, state, preset)
    else:
        pilot = _pilot(setup, request.policy, request.method, request.flight.key())
        controller = plain_source(setup, pilot.controller)
        save_learner_state(start, learner_state(request, request.policy, "full"), preset)
    # Make the hash unique: parameters and learners of a different flight must not match, even with the same controller.
    controller = replace(controller, base=f"{controller.base}-{secrets.token_hex(4)}")
    return LiveSpec(
        controller=controller,
        layers=LAYERS if learns else (),
        start=start,
        reference=request.scenario.reference,
        scenario=request.scenario,
        vehicle=preset.vehicle,
        x0=vector_of(
            State.at(setup.flight_task.target(jnp.array(0.0))) if vehicle else setup.flight_starts(1, request.seed)[0]
        ),
        home=np.asarray(setup.flight_task.home(), dtype=float),
        limits=_limits(request),
        dt=preset.dt,
        delay_ticks=preset.plant_delay_ticks,
        window=window,
        seconds=request.seconds,
        seed=request.flight.plant_seed,
        folder=request.folder,
        page=_page(request) if request.page is not None else None,
        learners=request.learners if learns else None,
        trust=python_names(preset),
        mains={"plant": VEHICLE} if vehicle else {},
    )


def learners_at(text: str | None, say: Callable[[str], None], key: Path | None = None) -> Address | None:
    """Return the address of the learners on another machine; None if the learners run on this machine.

    Args:
        text: Address, e.g. ``zenoh:192.168.1.5:7447``; by default, this machine.
        say: Function that is called with messages for the user.
        key: File with the key that the flight shares with the learners; by default, the key in ``RETRIM_KEY``, if any.

    Raises:
        ConfigError: The text is not an address, a required package is not installed, an address outside this machine
            has no key, or a key was passed but is not needed.
    """
    key_shared = read_key(key)
    if text is None:
        if key is not None:
            raise ConfigError("--key without --learners: learners on this machine need no key")
        return None
    address = Address.of(text, key_shared)
    address.check_shared()
    if address.kind == "zenoh" and find_spec("zenoh") is None:
        raise ConfigError("a bus by zenoh needs zenoh: pip install eclipse-zenoh")
    if not address.loopback:
        networks = {"zenoh": address.host, "ros2": f"domain {address.port} of ROS 2"}
        where = networks.get(address.kind, "the network of its rosmaster")
        say(f"warning: this machine listens on {where}; messages are signed, but anyone on the network can read them")
    return address


def _check_remote(request: LiveRequest) -> None:
    """Raise :class:`ConfigError` if learners on another machine cannot learn for this flight."""
    if find_method(request.method).learns is None:
        raise ConfigError(f"--learners: {request.method!r} does not learn; {' and '.join(learning_methods())} do")
    preset = request.setup.preset
    training_reference = preset.track.reference if preset.track is not None else ""
    reference = request.scenario.reference or ""
    names = (
        preset.task,
        preset.adapt.residual,
        preset.adapt.learner,
        preset.adapt.optimiser,
        preset.pretrain.network,
        *training_reference.split("+"),
        *reference.split("+"),
    )
    if local := sorted({name for name in names if ":" in name or ".csv" in name.lower()}):
        raise ConfigError(f"--learners: another machine does not have {', '.join(local)}; built-in ones only")


def learner_state(request: LiveRequest, policy: AbstractPolicy, method: str, residual: Any = None) -> LearnerState:
    """Return the initial state of the learners.

    Args:
        request: Request for the flight.
        policy: Policy from which the learners start.
        method: Learning method.
        residual: State of the fitted residual; by default, the initial state.
    """
    key, prepare = request.flight.key(), find_method(method).learns
    start_policy = policy if prepare is None else prepare(request.setup, policy, key)
    state = request.setup.learner.init(start_policy, random.split(key)[0])
    return state if residual is None else LearnerState(state.policy, residual)


def _page(request: LiveRequest) -> PageSpec:
    assert request.page is not None
    host, port = request.page
    vehicle = request.scenario.make_vehicle(request.setup.preset.vehicle)
    learns = find_method(request.method).learns is not None
    methods = tuple(dict.fromkeys((request.method, *learning_methods()))) if learns else ()
    arm = float(np.hypot(*np.asarray(vehicle.arm)))
    name, mass = request.setup.preset.name, float(vehicle.mass)
    offer = choices(request.setup, request.reference_name) if methods else ()
    places = _places(request, PATH_S)
    scenario = request.scenario
    world = f"plant {scenario.plant}, disturbance {scenario.disturbance}"
    seconds = min(request.seconds, WORLD_S)
    if effects := describe_disturbance(scenario.disturbance, request.setup.flight_task.home(), seconds):
        world += f" ({effects})"
    return PageSpec(host, free_port(host, port), name, places, methods, arm, mass, paths(offer, PATH_S), world)


def _limits(request: LiveRequest) -> Limits:
    """Return the vehicle's command limits and a box around all reference positions."""
    setup, fence = request.setup, request.fence
    vehicle = request.scenario.make_vehicle(setup.preset.vehicle)
    places = _places(request, request.seconds)
    if not (finite := np.isfinite(places).all(1)).all():  # otherwise every position would count as inside
        at = STEP * int(np.argmin(finite))
        raise ConfigError(f"task {setup.preset.task!r}: its reference is not finite at {at:g} s; no fence can hold it")
    low, high = places.min(0) - fence, places.max(0) + fence
    low[2] = max(low[2], min(-FENCE_DEPTH, float(places[:, 2].min()) - FENCE_DEPTH))
    u_min, u_max = (as_numpy(u).astype(float) for u in (vehicle.command_min, vehicle.command_max))
    return Limits(low, high, u_min, u_max, policy_age=request.policy_age)


def _places(request: LiveRequest, seconds: float) -> np.ndarray:
    """Return positions along the reference in the world frame [m], (n, 3)."""
    setup = request.setup
    times = jnp.arange(0.0, max(seconds, setup.preset.dt), STEP)
    return np.asarray(jax.jit(jax.vmap(setup.flight_task.target))(times), dtype=float)
