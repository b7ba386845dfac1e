"""The learner of a preset, and the frame that its policy is flown in."""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..adapt.learner import OnlineLearner
from ..adapt.optimisers import CarriedAdam, FreshAdam
from ..adapt.starts import FlownStarts, TaskStarts
from ..adapt.views import AbstractView, GravityView, RestView, WorldView
from ..control.controller import AbstractController
from ..control.gravity_frame import AtRest, GravityFrame, RestFrame
from ..errors import ConfigError, FrameError
from ..estimation.disturbance_observer import DisturbanceObserver
from ..learn.env import Env
from ..learn.residuals.model import ResidualModel
from ..physics.dynamics import PointMass, Residual
from ..physics.felt_frame import FeltFrame
from ..tasks.keypoints import Keypoints
from ..tasks.task import AbstractTask
from .presets import Preset

OBSERVER_TAU = 0.05  # [s]: half of it is unstable where the plant's delay is 40 ms longer than declared
WANDER = 4.0  # [m/s^2] in a second
TILT_LIMIT = 6.0  # [m/s^2], largest disturbance that turns a frame: gravity keeps a downward part


def make_learner(preset: Preset, model: ResidualModel, env: Env) -> OnlineLearner:
    """Return the learner of a preset.

    Args:
        preset: Its table [adapt] says how to learn.
        model: Residual model.
        env: Environment of the flight.

    Raises:
        ConfigError: The preset turns the frame of a task that cannot be turned.
    """
    a = preset.adapt
    if a.frame != "world":
        check_frame(preset, env.task, observer=a.frame == "gravity")
    adam = CarriedAdam if a.optimiser == "carried" else FreshAdam
    return OnlineLearner(
        env,
        model,
        adam(jnp.array(a.learning_rate), jnp.array(a.max_grad_norm or math.inf)),
        plant_delay_ticks=preset.plant_delay_ticks,
        num_updates=a.num_updates,
        num_envs=a.num_envs,
        starts=TaskStarts() if a.task_starts is None else FlownStarts(jnp.array(a.start_noise), a.task_starts),
        view=VIEWS[a.frame](),
    )


VIEWS: dict[str, Callable[[], AbstractView]] = {
    "world": WorldView,
    "gravity": lambda: GravityView(jnp.array(TILT_LIMIT)),
    "rest": lambda: RestView(jnp.array(TILT_LIMIT)),
}


def check_frame(preset: Preset, task: AbstractTask, *, observer: bool = True) -> None:
    """Refuse a frame for a task that cannot be turned, and an observer for a policy that sees no state.

    Raises:
        ConfigError: It names the task, and what cannot be turned.
    """
    if observer and isinstance(task.observation, Keypoints):
        raise ConfigError(
            f"task {preset.task!r} has no frame for a disturbance observer: it sees the state at every tick, which a "
            "policy that sees keypoints is not shown"
        )
    try:
        task.in_frame(FeltFrame.of(jnp.zeros(3)))
    except FrameError as error:
        raise ConfigError(f"task {preset.task!r} has no frame for a disturbance observer: {error}") from error


def gravity_frame(controller: AbstractController[Any], preset: Preset, known: Residual | None = None) -> GravityFrame:
    """Return a controller, flown in the gravity that a disturbance observer feels.

    Args:
        controller: It can be turned.
        preset: Its control period and declared delay are those of the observer.
        known: What is known of the residual; the observer sees the rest.
    """
    observer = DisturbanceObserver(
        PointMass(preset.dt),
        jnp.array(OBSERVER_TAU),
        jnp.array(TILT_LIMIT),
        jnp.array(WANDER),
        delay_ticks=preset.plant_delay_ticks,
    )
    return GravityFrame(controller, observer, known)


def rest_frame(controller: AbstractController[Any], known: Residual, home: Float[Array, "3"]) -> RestFrame:
    """Return a controller, flown in the gravity that ``known`` predicts at rest at ``home``, world [m]."""
    return RestFrame(controller, AtRest(known, home, jnp.array(TILT_LIMIT)))
