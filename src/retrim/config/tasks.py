"""Tasks and references by name."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import random

from ..errors import ConfigError
from ..physics.felt_frame import FeltFrame
from ..physics.vehicle import Vehicle
from ..tasks.hover import Hover, L2Hover
from ..tasks.keypoints import Keypoints
from ..tasks.observation import AbstractObservation, StateObs
from ..tasks.preview import Preview
from ..tasks.reference import AbstractReference, Reference, joined
from ..tasks.shapes import REFERENCES as BUILT_IN
from ..tasks.task import AbstractTask
from ..tasks.track import AbstractTrack, L2Track, SharpTrack
from ..tasks.track import Track as PaperTrack
from ..tasks.trajectory_csv import from_csv
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

FELT_TAG = 5
"""Key of the pushes under which references are felt in training; the same for every seed of a policy."""

LEAD = 0.04  # [s]: about as late as commands act, behind a delay and motors
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
            laps, and any other is flown once; ``my.csv:laps`` insists on laps, ``my.csv:once`` flies it once. Several
            of them, joined by ``+``, become a family.

    Raises:
        ConfigError: There is no such reference, or its file cannot be used.
    """
    parts = names.split("+")
    if all(name in BUILT_IN for name in parts):
        return _built_in(names, jax.config.values["jax_enable_x64"])
    found = [_one_reference(name) for name in parts]
    return found[0] if len(found) == 1 else joined(found)


@functools.cache
def _built_in(names: str, x64: bool) -> Reference:
    """References that never change are sampled once per process and precision; files are read again each time."""
    found = [BUILT_IN[name]() for name in names.split("+")]
    return found[0] if len(found) == 1 else joined(found)


def make_training_reference(table: TrackTable) -> Reference:
    """Return the reference that a policy is trained on: as named, and as felt under constant pushes.

    Raises:
        ConfigError: As :func:`make_reference`.
    """
    if not table.felt_copies:
        return make_reference(table.reference)
    members = list[AbstractReference]()
    for name in table.reference.split("+"):
        plain = make_reference(name)
        members.append(plain)
        for k in range(table.felt_copies):
            push = table.felt_push * random.ball(random.fold_in(random.key(FELT_TAG), len(members) + k), 3)
            members.append(plain.in_frame(FeltFrame.of(push)))
    return joined(members)


def _one_reference(name: str) -> Reference:
    file, _, how = name.rpartition(":") if ".csv:" in name.lower() else (name, "", "")
    try:
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
    training = Keypoints.of(
        jnp.array(p.goal),
        request.vehicle.omega_max,
        occlusion=False,
        noise=table.pixel_noise,
        whitened=table.whiten_pixels,
        dt=p.dt,
        delay_ticks=p.plant_delay_ticks,
    )
    # Occluded points are predicted by a pose filter so well that training need not know of it.
    flown = training.occluded(table.dropout) if table.occlusion else None
    kind = L2Hover if p.reward == "l2" else Hover
    return kind(
        jnp.array(p.goal),
        training,
        jnp.array(p.termination_box),
        jnp.array(p.pretrain.max_start_yaw),
        p.dt,
        p.pretrain.horizon,
        flown,
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
register_task("vision", TaskEntry(_vision, "vision/ideal"))
register_task("track", TaskEntry(_track, "track/retrim", has_reference=True))
