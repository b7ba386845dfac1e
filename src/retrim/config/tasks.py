"""Tasks and references by name."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import ConfigError
from ..physics.felt_frame import FeltFrame
from ..physics.vehicle import Vehicle
from ..tasks.hover import AbstractHover, Hover, L2Hover
from ..tasks.keypoints import Keypoints
from ..tasks.observation import AbstractObservation, StateObs
from ..tasks.occluded import OccludedKeypoints
from ..tasks.preview import Preview
from ..tasks.reference import Reference, joined
from ..tasks.shapes import AT_SPEED, FASTEST
from ..tasks.shapes import REFERENCES as BUILT_IN
from ..tasks.task import AbstractTask
from ..tasks.track import AbstractTrack, L2Track, SharpTrack
from ..tasks.track import Track as PaperTrack
from ..tasks.trajectory_csv import from_csv
from ..tasks.view import ViewHover
from .presets import Preset
from .presets import Track as TrackTable
from .presets import Vision as VisionTable
from .registry import Registry

REFERENCES: Registry[Callable[[], Reference]] = Registry(
    "reference", example="a CSV file of t, x, y, z, as my.csv or my.csv:once, or module:name"
)
for _name, _make in BUILT_IN.items():
    REFERENCES.register(_name, _make)
register_reference = REFERENCES.register

FELT_SEED = 0
"""Of the pushes under which references are felt in training; the same for every seed of a policy."""

LEAD = 0.04  # [s]: about as late as commands act, behind a delay and motors
VISION_REWARDS: dict[str, type[AbstractHover]] = {"paper": Hover, "l2": L2Hover, "view": ViewHover}
TRACKS: dict[str, type[AbstractTrack]] = {"paper": PaperTrack, "l2": L2Track, "sharp": SharpTrack}

LAPS = {"": None, "laps": True, "once": False}
"""What may stand behind a CSV file and a colon: whether it repeats."""


@dataclass(frozen=True)
class TaskRequest:
    """What a preset asks of a task."""

    preset: Preset
    vehicle: Vehicle
    reference: Reference | None = None
    """What is tracked; None for a task that tracks nothing."""

    @property
    def options(self) -> Mapping[str, Any]:
        """The preset's free table, for a task of one's own."""
        return self.preset.options

    def state_observation(self) -> StateObs:
        """Return the paper's observation, o = [p, R, v], with the preset's past commands."""
        return StateObs(jnp.array(self.preset.goal), self.vehicle.omega_max, self.preset.command_history)


@dataclass(frozen=True)
class TaskEntry:
    """A kind of task."""

    make: Callable[[TaskRequest], AbstractTask]
    default_preset: str = "hover/fast"
    """Preset that is trained unless another is asked for."""
    has_reference: bool = False
    """Whether it tracks a reference."""


TASKS: Registry[TaskEntry] = Registry("task", example="module:name of a TaskEntry")
register_task = TASKS.register


def find_task(name: str) -> TaskEntry:
    """Return the entry of a task by name; ``module:name`` may be a function of a :class:`TaskRequest`.

    Raises:
        ConfigError: There is no such task, or ``module:name`` is no entry.
    """
    entry: Any = TASKS.find(name)
    if isinstance(entry, TaskEntry):
        return entry
    if not callable(entry):
        raise ConfigError(f"task {name!r} is a {type(entry).__name__}, not a function of a TaskRequest")
    return TaskEntry(entry)


def make_reference(names: str) -> Reference:
    """Return a reference by name.

    Args:
        names: A registered name, ``module:name`` of a function that makes one, or a CSV file. A closed file repeats as
            laps, and any other is flown once; ``my.csv:laps`` insists on laps, ``my.csv:once`` flies it once. A
            built-in shape may have a top speed [m/s], as ``circle=8``. Several of them, joined by ``+``, become a
            family.

    Raises:
        ConfigError: There is no such reference, or its file cannot be used.
    """
    return _made(names, 0, 0.0)


def make_training_reference(table: TrackTable) -> Reference:
    """Return the reference that a policy is trained on: as named, and as felt under constant pushes.

    Raises:
        ConfigError: As :func:`make_reference`.
    """
    return _made(table.reference, table.felt_copies, table.felt_push)


def _made(names: str, copies: int, push: float) -> Reference:
    """A reference or a family; each member also as felt under so many pushes of up to ``push`` [m/s^2]."""
    if all(name.partition("=")[0] in BUILT_IN for name in names.split("+")):
        return _built_in(names, copies, push, jax.config.values["jax_enable_x64"])
    return _family([_one_reference(name) for name in names.split("+")], copies, push)


@functools.cache
def _built_in(names: str, copies: int, push: float, x64: bool) -> Reference:
    """References that never change are sampled once per process and precision; files are read again each time."""
    return _family([_one_reference(name) for name in names.split("+")], copies, push)


def _family(plain: Sequence[Reference], copies: int, push: float) -> Reference:
    if len(plain) == 1 and not copies:
        return plain[0]
    draw = np.random.default_rng(FELT_SEED)
    directions = draw.normal(size=(len(plain), copies, 3))
    sizes = push * draw.uniform(size=(len(plain), copies, 1)) ** (1.0 / 3.0)  # evenly in a ball
    pushes = sizes * directions / np.linalg.norm(directions, axis=2, keepdims=True)
    felt = [r.in_frame(FeltFrame.of(jnp.asarray(d))) for r, many in zip(plain, pushes, strict=True) for d in many]
    return joined([*plain, *felt])


def _one_reference(name: str) -> Reference:
    file, _, how = name.rpartition(":") if ".csv:" in name.lower() else (name, "", "")
    shape, sized, speed = name.partition("=")
    try:
        if sized and shape in AT_SPEED:
            return AT_SPEED[shape](_speed(name, speed))
        if file.lower().endswith(".csv"):
            if how not in LAPS:
                raise ConfigError(f"{name}: {how!r} is not 'laps' or 'once'")
            return from_csv(Path(file), LAPS[how])
        made: Any = REFERENCES.find(name)()
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror or error}") from error
    except (TypeError, ValueError) as error:
        raise error if isinstance(error, ConfigError) else ConfigError(f"reference {name}: {error}") from error
    if not isinstance(made, Reference):
        raise ConfigError(f"reference {name!r} is a {type(made).__name__}, not a function that gives a Reference")
    return made


def _speed(name: str, text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.1 <= speed <= FASTEST:
        raise ConfigError(f"reference {name!r}: {text!r} is no top speed of 0.1 to {FASTEST:g} m/s")
    return speed


def _hover(request: TaskRequest) -> AbstractTask:
    p = request.preset
    kind = L2Hover if p.reward == "l2" else Hover
    return kind(
        jnp.array(p.goal),
        request.state_observation(),
        jnp.array(p.termination_box),
        jnp.array(p.pretrain.max_start_yaw),
        p.dt,
        p.pretrain.horizon,
    )


def _vision(request: TaskRequest) -> AbstractTask:
    p, table = request.preset, request.preset.vision or VisionTable()
    omega_max = request.vehicle.omega_max
    training = Keypoints.of(
        jnp.array(p.goal), omega_max, noise=table.pixel_noise, whitened=table.whiten_pixels, dt=p.dt
    )
    # A filter estimates the pose so well that training need not know of it.
    lag = None if p.actuator_tau is None else jnp.array(p.actuator_tau)
    flown = OccludedKeypoints(training, jnp.array(table.dropout), lag, delay_ticks=p.plant_delay_ticks)
    kind = VISION_REWARDS[p.reward]
    return kind(
        jnp.array(p.goal),
        training,
        jnp.array(p.termination_box),
        jnp.array(p.pretrain.max_start_yaw),
        p.dt,
        p.pretrain.horizon,
        flown if table.occlusion else None,
    )


def _track(request: TaskRequest) -> AbstractTask:
    p, table = request.preset, request.preset.track or TrackTable()
    if request.reference is None:
        raise ConfigError("task 'track' needs a reference")
    observation: AbstractObservation[Any] = request.state_observation()
    if table.observation != "state":
        ahead = (LEAD,) if table.observation == "flat" else ()
        observation = Preview(request.reference, request.vehicle.omega_max, p.command_history, ahead)
    kind = TRACKS[p.reward]
    return kind(
        request.reference,
        observation,
        jnp.array(table.start_spread),
        jnp.array(p.termination_box),
        p.dt,
        p.pretrain.horizon,
    )


register_task("hover", TaskEntry(_hover, "hover/retrim"))
register_task("vision", TaskEntry(_vision, "vision/retrim"))
register_task("track", TaskEntry(_track, "track/retrim", has_reference=True))
