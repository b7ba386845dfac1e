"""Build the nominal model, optimiser, online-learner settings and control frame of a preset."""

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optax
from jaxtyping import Array

from ..adapt.optimisers import AbstractPolicyOptimiser
from ..adapt.starts import TaskStarts, WindowStarts
from ..adapt.trim import NoTrim, RestTrim
from ..adapt.vehicles import IdentifiedVehicle, OwnVehicle
from ..adapt.views import AbstractView, GravityView, RestView, WorldView
from ..control.controller import AbstractController, PolicyController
from ..control.gravity_frame import GravityFrame, lead_of
from ..control.lap_learning import LapLearning
from ..control.monitor import Monitor
from ..control.policy import AbstractPolicy
from ..control.pose_frame import PoseFrame
from ..control.slung_load import LoadCompensation
from ..errors import ConfigError, FrameError
from ..estimation.command_path import PathEstimator
from ..estimation.disturbance_observer import DisturbanceObserver
from ..learn.env import Env
from ..learn.residuals.model import FittedResidual
from ..physics.actuators import LaggedModel
from ..physics.dynamics import AbstractDynamics, PointMass
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.vehicle import Vehicle
from ..tasks.reference import Reference
from ..tasks.task import AbstractTask
from .command_paths import declared_path, longest_delay, response_of
from .families import identify_vehicle, policy_controller, track_actuators
from .presets import Preset, Pretrain
from .tasks import find_task

OBSERVER_TAU = 0.05  # [s]: half this value is unstable if the plant's delay is 40 ms longer than declared
WANDER = 4.0  # [m/s^2]: random walk of the disturbance in one second
# The same for a family, whose stiffer policy turns estimation noise into motion. Without noise, both work equally well.
FAMILY_WANDER = 1.0
TILT_LIMIT = 6.0  # [m/s^2]: largest disturbance that rotates a frame, so that gravity keeps a downward component


def nominal_model(preset: Preset, vehicle: Vehicle) -> AbstractDynamics[Any]:
    """Return the point mass of the paper's Eq. (1), with actuator lag if the preset or the vehicle has one."""
    model, response = PointMass(preset.dt), response_of(preset, vehicle)
    return model if response is None else LaggedModel(model, response)


@functools.lru_cache(maxsize=32)
def pretraining_optimiser(table: Pretrain) -> optax.GradientTransformation:
    """Return the pretraining optimiser: gradient clipping, then Adam with a cosine schedule.

    Equal tables give the same object, so compiled programs are shared.
    """
    rate = optax.cosine_decay_schedule(table.learning_rate, table.num_updates)
    return optax.chain(optax.clip_by_global_norm(table.max_grad_norm or math.inf), optax.adam(rate, b2=table.adam_b2))


def learner_settings(
    preset: Preset, env: Env, optimiser: Callable[[Array, Array], AbstractPolicyOptimiser]
) -> dict[str, Any]:
    """Return the settings of an online learner by field name.

    Args:
        preset: Preset whose table [adapt] contains the parameters.
        env: Environment of the flight.
        optimiser: Function that takes a learning rate and a largest gradient norm, and returns the optimiser of policy
            updates.

    Raises:
        ConfigError: The preset rotates a task that cannot be rotated, or trims a task that does not rest at home.
    """
    a, family = preset.adapt, env.family
    if a.frame != "world":
        check_frame(preset, env.task)
    if a.trim == "rest" and find_task(preset.task).has_reference:
        raise ConfigError(f"adapt.trim = 'rest' is for a task that rests at home, not for {preset.task!r}")
    rates = (a.learning_rate, a.low_rank_learning_rate or a.learning_rate)
    all_weights, low_rank = (optimiser(jnp.array(rate), jnp.array(a.max_grad_norm or math.inf)) for rate in rates)
    return {
        "optimiser": all_weights,
        "low_rank_optimiser": low_rank,
        "plant_delay_ticks": preset.plant_delay_ticks if family is None else 0,  # the identified path has the delay
        "num_updates": a.num_updates,
        "num_envs": a.num_envs,
        "starts": TaskStarts() if a.task_starts is None else WindowStarts(jnp.array(a.start_noise), a.task_starts),
        "view": _view(preset, env.task),
        "trim": RestTrim() if a.trim == "rest" and env.task.rests else NoTrim(),
        "vehicles": OwnVehicle() if family is None else IdentifiedVehicle(PathEstimator.of(preset.dt), family),
    }


def _view(preset: Preset, task: AbstractTask) -> AbstractView:
    if preset.adapt.frame == "world":
        return WorldView()
    limit = jnp.array(TILT_LIMIT)
    return RestView(limit) if task.observation.has_frame_in_memory else GravityView(limit)


def check_frame(preset: Preset, task: AbstractTask) -> None:
    """Raise an error if a preset's task does not support the frame of effective gravity.

    Raises:
        ConfigError: The task cannot be rotated, or the observation neither measures nor estimates the state. The
            message names the task and the part that cannot be rotated.
    """
    observation = task.observation_in_flight
    if not observation.measures_state and observation.state_estimator is None:
        raise ConfigError(
            f"preset {preset.name!r}: the frame of effective gravity needs a measured state or a pose filter; set "
            "[vision] occlusion = true"
        )
    try:
        eqx.filter_eval_shape(lambda: task.in_frame(EffectiveGravityFrame.of(jnp.zeros(3))))
    except FrameError as error:
        raise ConfigError(f"task {preset.task!r} has no frame of effective gravity: {error}") from error


def effective_gravity_frame(
    controller: AbstractController[Any],
    preset: Preset,
    vehicle: Vehicle,
    known_residual: FittedResidual | None = None,
    load_task: AbstractTask | None = None,
) -> GravityFrame | PoseFrame:
    """Return a controller in the frame of effective gravity, which an observer or the observation estimates.

    Args:
        controller: Controller that can be rotated into this frame.
        preset: Preset with the control period and the declared delay of the observer.
        vehicle: Vehicle with the command limits and the lag of the observer.
        known_residual: Learned residual, including the learned body-rate bias. The observer estimates the remaining
            disturbance. The estimator of an observation ignores the residual and
            estimates the whole disturbance.
        load_task: Task of a flight with a load on a cable, which is estimated and compensated; None without a load.
    """
    limit = jnp.array(TILT_LIMIT)
    if isinstance(controller, PolicyController) and controller.observation.state_estimator is not None:
        return PoseFrame(controller, limit)
    path = declared_path(preset, vehicle)
    observer = DisturbanceObserver(
        PointMass(preset.dt),
        jnp.array(OBSERVER_TAU),
        limit,
        jnp.array(WANDER if preset.family is None else FAMILY_WANDER),
        path,
        (vehicle.command_min, vehicle.command_max),
        longest_delay=longest_delay(preset),
    )
    result = None if known_residual is None else known_residual.turning
    bias = jnp.zeros(3) if result is None else result.bias
    place = None if known_residual is None else known_residual.place
    load = None if load_task is None else LoadCompensation(load_task)
    return GravityFrame(
        controller, observer, known_residual, rate_bias=bias, place=place, lead=lead_of(path, preset.dt), load=load
    )


def make_adapted_flight(
    preset: Preset, task: AbstractTask, vehicle: Vehicle, policy: AbstractPolicy, residual: FittedResidual
) -> AbstractController[Any]:
    """Return the controller of an adapting policy, with the policy's observation and in the preset's frame.

    In the frame of effective gravity, a monitor reverts learned parameters that make the flight worse. If the preset
    specifies this, the reference of a flight in laps is shifted against the repeating error.

    Args:
        preset: Preset of the policy.
        task: Task of the flight.
        vehicle: Vehicle with the command limits.
        policy: Policy of the flight.
        residual: Learned residual.
    """
    flight = _in_frame(preset, task, vehicle, policy_controller(preset, task, policy), residual)
    reference = getattr(task, "reference", None)
    if not preset.adapt.lap_learning or not isinstance(reference, Reference):
        return flight
    return LapLearning.of(flight, reference, preset.dt)


def _in_frame(
    preset: Preset, task: AbstractTask, vehicle: Vehicle, plain: AbstractController[Any], residual: FittedResidual
) -> AbstractController[Any]:
    if preset.adapt.frame == "world":
        return track_actuators(plain, preset)
    load_task = task if hasattr(residual.model, "load") else None
    frame = effective_gravity_frame(plain, preset, vehicle, residual, load_task)
    if not isinstance(frame, GravityFrame):
        return frame
    monitor = track_actuators(Monitor(frame, task), preset)
    return monitor if preset.family is None else identify_vehicle(monitor, preset)
