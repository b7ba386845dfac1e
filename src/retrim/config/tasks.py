"""Registry of tasks."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..errors import ConfigError
from ..physics.path_family import PathBelief
from ..physics.vehicle import Vehicle
from ..tasks.heading_obs import HeadingObs
from ..tasks.hover import AbstractHover, CustomHover, Hover, L2Hover, RewardRule, StiffHover
from ..tasks.keypoints import Keypoints
from ..tasks.moving_goal import GoalPath, MovingGoal
from ..tasks.observation import AbstractObservation, StateObs
from ..tasks.occluded import OccludedKeypoints
from ..tasks.preview import Preview
from ..tasks.reference import Reference
from ..tasks.task import AbstractTask
from ..tasks.thrust_preview import ThrustPreview
from ..tasks.track import AbstractTrack, ExactTrack, L2Track, SharpTrack
from ..tasks.track import Track as PaperTrack
from ..tasks.tracking_error import RelativeObs, StateAndErrorObs
from ..tasks.vehicle_obs import VehicleObs
from ..tasks.view import ViewHover
from .command_paths import lag_of
from .presets import Preset
from .presets import Track as TrackTable
from .presets import Vision as VisionTable
from .registry import Registry

LEAD = 0.04  # [s]: approximate time until a command acts: delay plus motor lag
HOVER_REWARDS: dict[str, type[AbstractHover]] = {"paper": Hover, "l2": L2Hover, "stiff": StiffHover}
VISION_REWARDS: dict[str, type[AbstractHover]] = {"paper": Hover, "l2": L2Hover, "view": ViewHover}
TRACK_OBSERVATIONS: dict[str, Callable[["TaskRequest", Reference], AbstractObservation[Any]]] = {
    "blind": lambda request, reference: request.state_observation(),
    "relative": lambda request, reference: RelativeObs(reference, *request.observed_commands()),
    "both": lambda request, reference: StateAndErrorObs(reference, request.state_observation()),
    "preview": lambda request, reference: Preview(reference, *request.observed_commands()),
    "flat": lambda request, reference: Preview(reference, *request.observed_commands(), (LEAD,)),
    "thrust": lambda request, reference: ThrustPreview(reference, *request.observed_commands()),
}
TRACKS: dict[str, type[AbstractTrack]] = {"paper": PaperTrack, "l2": L2Track, "sharp": SharpTrack, "exact": ExactTrack}


@dataclass(frozen=True)
class TaskRequest:
    """The inputs from which a task is built."""

    preset: Preset
    vehicle: Vehicle
    reference: Reference | None = None
    """Reference of a tracking task; None for other tasks."""

    @property
    def options(self) -> Mapping[str, Any]:
        """Free-form table of the preset, for custom tasks."""
        return self.preset.options

    def state_observation(self) -> StateObs:
        """Return the paper's observation, o = [p, R, v], with as many past commands as the preset specifies."""
        return StateObs(jnp.array(self.preset.goal), *self.observed_commands())

    def of_vehicle(self, observation: AbstractObservation[Any]) -> AbstractObservation[Any]:
        """Return an observation that also includes the vehicle if the preset is for a family of vehicles."""
        if self.preset.family is None:
            return observation
        return VehicleObs.of(observation, self.vehicle.omega_max, PathBelief.unknown())

    def hover(self, *, reward: RewardRule | None = None, goal: GoalPath | None = None) -> AbstractTask:
        """Return a hover task with the settings of the preset.

        Args:
            reward: Function of the goal [m], the state and the command; by default, the reward of the preset.
            goal: Function that takes a time [s] and returns the position of a moving goal, world [m]; by default, the
                goal of the preset.

        Example::

            def task(request: retrim.TaskRequest) -> retrim.AbstractTask:
                return request.hover(goal=lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 1.5 + 0.0 * t]))
        """
        p = self.preset
        centre = jnp.array(p.goal) if goal is None else jnp.zeros(3)
        observation = StateObs(centre, *self.observed_commands())
        base = observation if p.axes == "world" else HeadingObs(observation, centre)
        fields = (
            centre,
            self.of_vehicle(base),
            jnp.array(p.termination_box),
            jnp.array(p.pretrain.max_start_yaw),
            p.dt,
            p.pretrain.horizon,
        )
        kind = HOVER_REWARDS.get(p.reward, Hover) if reward is None else partial(CustomHover, rule=reward)
        hover = kind(*fields)
        return hover if goal is None else MovingGoal(hover, goal)

    def observed_commands(self) -> tuple[Float[Array, "3"], int]:
        """Return the scale of the observed body rates [rad/s] and the number of observed past commands."""
        return self.vehicle.omega_max, self.preset.command_history


@dataclass(frozen=True)
class TaskEntry:
    """A kind of task."""

    make: Callable[[TaskRequest], AbstractTask]
    default_preset: str = "hover/fast"
    """Default preset for training."""
    has_reference: bool = False
    """Whether the task tracks a reference."""


TASKS: Registry[TaskEntry] = Registry(
    "task",
    example="module:name of a TaskEntry",
    expected="a function of a TaskRequest",
    accepts=lambda thing: callable(thing) or isinstance(thing, TaskEntry),
)
register_task = TASKS.register


def find_task(name: str) -> TaskEntry:
    """Return the entry of a task by name; ``module:name`` may be a function that takes a :class:`TaskRequest`.

    Raises:
        ConfigError: The task does not exist, or ``module:name`` is neither an entry nor a function.
    """
    entry: Any = TASKS.find(name)
    return entry if isinstance(entry, TaskEntry) else TaskEntry(entry)


def make_task(request: TaskRequest) -> AbstractTask:
    """Build the task of a preset.

    Raises:
        ConfigError: The task does not exist, or its entry does not return an ``AbstractTask``.
    """
    name = request.preset.task
    task = find_task(name).make(request)
    if not isinstance(task, AbstractTask):
        raise ConfigError(f"task {name!r} returns {type(task).__name__}, expected a retrim.AbstractTask")
    return task


def _hover(request: TaskRequest) -> AbstractTask:
    return request.hover()


def _vision(request: TaskRequest) -> AbstractTask:
    p, table = request.preset, request.preset.vision or VisionTable()
    omega_max = request.vehicle.omega_max
    training = Keypoints.of(
        jnp.array(p.goal), omega_max, noise=table.pixel_noise, whitened=table.whiten_pixels, dt=p.dt
    )
    occluded_observation: OccludedKeypoints | None = None
    if table.occlusion:  # the filter estimates the pose accurately, so training can ignore it
        lag = lag_of(p, request.vehicle)
        occluded_observation = OccludedKeypoints(
            training, jnp.array(table.dropout), lag, delay_ticks=p.plant_delay_ticks
        )
    kind = VISION_REWARDS[p.reward]
    return kind(
        jnp.array(p.goal),
        training,
        jnp.array(p.termination_box),
        jnp.array(p.pretrain.max_start_yaw),
        p.dt,
        p.pretrain.horizon,
        occluded_observation,
    )


def _track(request: TaskRequest) -> AbstractTask:
    p, table = request.preset, request.preset.track or TrackTable()
    if request.reference is None:
        raise ConfigError("task 'track' needs a reference")
    kind = TRACKS[p.reward]
    return kind(
        request.reference,
        request.of_vehicle(TRACK_OBSERVATIONS[table.observation](request, request.reference)),
        jnp.array(table.start_spread),
        jnp.array(p.termination_box),
        p.dt,
        p.pretrain.horizon,
    )


register_task("hover", TaskEntry(_hover, "hover/retrim"))
register_task("vision", TaskEntry(_vision, "vision/retrim"))
register_task("track", TaskEntry(_track, "track/retrim", has_reference=True))
