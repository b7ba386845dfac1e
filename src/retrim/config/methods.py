"""Registry of flight methods: unchanged, compensated or re-trained policies, and controllers without a policy."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Key

from ..adapt.learner_state import LearnerState
from ..control.baselines import BASELINES, Baseline
from ..control.controller import AbstractController
from ..control.integral import IntegralAction
from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy
from ..control.pose_filtered import PoseFilteredController
from ..errors import ConfigError
from ..plants.plant import Plant
from ..runtime.pilot import ControllerPilot, Pilot
from .baselines import baseline_request
from .families import identify_vehicle, policy_controller, track_actuators
from .learners import check_frame, effective_gravity_frame
from .registry import Registry

if TYPE_CHECKING:
    from .setup import Latency, Setup


@dataclass(frozen=True)
class MethodRequest:
    """The inputs from which a method builds a pilot."""

    setup: "Setup"
    policy: Any
    """Policy, or the network of a method that uses its own network."""
    key: Key[Array, ""] | None = None
    """Random key of the method, unless it is deterministic."""
    latency: "Latency" = "fixed"
    state: LearnerState | None = None
    """Learner state of an earlier flight, from which to continue; by default, a new learner state."""

    def controller(self) -> AbstractController[Any]:
        """Return the policy with the observation used in flight."""
        return policy_controller(self.setup.preset, self.setup.flight_task, self.policy.merged())

    def in_effective_gravity_frame(self, *, with_load: bool = False) -> AbstractController[Any]:
        """Return the policy in the frame of effective gravity.

        Args:
            with_load: Whether to estimate a load on a cable and to compensate its pull.

        Raises:
            ConfigError: The task cannot be rotated into this frame.
        """
        check_frame(self.setup.preset, self.setup.env.task)
        setup = self.setup
        load_task = setup.flight_task if with_load else None
        frame = effective_gravity_frame(self.controller(), setup.preset, setup.vehicle, load_task=load_task)
        return track_actuators(frame, setup.preset)

    def by_state(self, controller: AbstractController[Any], name: str | None = None) -> AbstractController[Any]:
        """Adapt a state-feedback controller to the observation, whose state estimator it uses if there is one.

        Args:
            controller: Controller that needs the state.
            name: Name of the method in error messages; by default, the name of the controller class.

        Raises:
            ConfigError: The observation neither measures nor estimates the state.
        """
        observation = self.setup.flight_task.observation_in_flight
        if observation.state_estimator is not None:
            return PoseFilteredController(controller, observation)
        if not observation.measures_state:
            method = name or type(controller).__name__
            raise ConfigError(
                f"method {method!r} needs the state, and preset {self.setup.preset.name!r} observes keypoints, "
                "from which only a pose filter gives one: set [vision] occlusion = true"
            )
        return controller

    def require_key(self) -> Key[Array, ""]:
        """Return the key.

        Raises:
            ValueError: The request has no key.
        """
        if self.key is None:
            raise ValueError("a method that learns needs a key")
        return self.key


Prepare = Callable[["Setup", AbstractPolicy, Key[Array, ""]], AbstractPolicy | LoraPolicy]
"""Function that takes a set-up, a policy and a random key, and returns the policy to train: the same policy, or one
with a delta."""


@dataclass(frozen=True)
class MethodEntry:
    """A flight method; :func:`learning_method` builds the entry of a method that learns in flight."""

    make: Callable[[MethodRequest], Pilot]
    label: str
    """Name used in tables."""
    on_board: Callable[["Setup", Plant], Plant] | None = None
    """Function that adds an on-board motor controller to a plant; None if the method commands thrust and body rates."""
    learns: Prepare | None = None
    """Function that prepares the policy for the learners; None for a method that does not learn in flight."""

    def modify_plant(self, setup: "Setup", plant: Plant) -> Plant:
        """Return the plant with the modifications that the method requires.

        Raises:
            ConfigError: The method does not support this plant.
            PlantError: A required package is not installed.
        """
        return plant if self.on_board is None else self.on_board(setup, plant)


METHODS: Registry[MethodEntry] = Registry(
    "method",
    example="module:name of a MethodEntry",
    expected="a retrim.config.MethodEntry",
    accepts=lambda thing: isinstance(thing, MethodEntry),
)
register_method = METHODS.register
find_method = METHODS.find


def learning_method(label: str, learns: Prepare) -> MethodEntry:
    """Return the entry of a method that learns in flight, in lockstep and live.

    Args:
        label: Name used in tables.
        learns: Function that prepares the policy for the learners.
    """

    def make(request: MethodRequest) -> Pilot:
        k_policy, key = random.split(request.require_key())
        policy = learns(request.setup, request.policy, k_policy)
        return request.setup.adaptive_pilot(policy, key, request.latency, request.state)

    return MethodEntry(make, label, learns=learns)


def learning_methods() -> tuple[str, ...]:
    """Return the names of the registered methods that learn in flight."""
    return tuple(name for name in METHODS if METHODS[name].learns is not None)


def _base(request: MethodRequest) -> Pilot:
    return ControllerPilot(track_actuators(request.controller(), request.setup.preset))


def _integral(request: MethodRequest) -> Pilot:
    if not request.setup.env.task.observation.measures_state:
        raise ConfigError(
            "method 'base-i' shifts the measured position; a policy that observes keypoints receives none"
        )
    integral = IntegralAction(
        request.controller(), request.setup.flight_task, gain=jnp.array(0.8), limit=jnp.array(2.0)
    )
    return ControllerPilot(track_actuators(integral, request.setup.preset))


def _gravity_frame(request: MethodRequest) -> Pilot:
    return ControllerPilot(request.in_effective_gravity_frame())


def _load(request: MethodRequest) -> Pilot:
    return ControllerPilot(request.in_effective_gravity_frame(with_load=True))


def _make_identifying_pilot(request: MethodRequest) -> Pilot:
    return ControllerPilot(identify_vehicle(request.in_effective_gravity_frame(), request.setup.preset))


def _without_policy(name: str, baseline: Baseline, request: MethodRequest) -> Pilot:
    return ControllerPilot(request.by_state(baseline.controller(baseline_request(request.setup, request.key)), name))


def _full(request: MethodRequest) -> Pilot:
    return request.setup.adaptive_pilot(request.policy, request.require_key(), request.latency, request.state)


def _all_weights(setup: "Setup", policy: AbstractPolicy, key: Key[Array, ""]) -> AbstractPolicy:
    del setup, key
    return policy


def _low_rank(setup: "Setup", policy: AbstractPolicy, key: Key[Array, ""]) -> LoraPolicy:
    return setup.low_rank(policy, key)


register_method("base", MethodEntry(_base, "base policy"))
register_method("base-i", MethodEntry(_integral, "base policy + integral action"))
register_method("base-do", MethodEntry(_gravity_frame, "base policy + disturbance observer"))
register_method("base-swing", MethodEntry(_load, "base policy + observer + load estimator"))
register_method("base-id", MethodEntry(_make_identifying_pilot, "base policy + observer + identification"))
for _name, _baseline in BASELINES.items():
    register_method(_name, MethodEntry(partial(_without_policy, _name, _baseline), _baseline.label))
register_method("full", MethodEntry(_full, "**adapted, all weights**", learns=_all_weights))
register_method("lora", learning_method("**adapted, LoRA**", _low_rank))
