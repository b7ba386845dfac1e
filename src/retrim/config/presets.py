"""Every number of an experiment, once, as plain, validated values; :mod:`.named_presets` has those with a name.

A preset is a tree of frozen dataclasses. A TOML file and then command-line flags may overlay it; an unknown name or an
impossible value is an error that gives its path.
"""

import math
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from .names import Plain, Printable, TaskName
from .vehicle_file import VehicleSpec

STRICT = ConfigDict(extra="forbid")
BUILT_IN_TASKS = ("hover", "track", "vision")
Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=1, le=1_000_000, strict=True)]
LearningRate = Annotated[float, Field(gt=0, le=10.0, strict=True)]
Seconds = Annotated[float, Field(ge=1e-3, le=3600.0, strict=True)]
Coordinate = Annotated[float, Field(ge=-1000.0, le=1000.0, allow_inf_nan=False, strict=True)]


@dataclass(frozen=True, config=STRICT)
class Pretrain:
    """Training of the base policy in the nominal model."""

    num_updates: Count = 300
    """Optimiser steps."""
    num_envs: Count = 100
    """Starts per step."""
    horizon: Count = 150
    """Ticks of a roll-out."""
    learning_rate: LearningRate = 5e-3
    """Adam's rate at the start; it falls to zero along a cosine. The paper gives none; the authors' code has 5e-3."""
    adam_b2: float = Field(default=0.999, ge=0, lt=1, strict=True)
    """Adam's second decay."""
    max_grad_norm: Positive | None = None
    """Largest norm of a gradient; none is clipped by default."""
    hidden_sizes: tuple[Count, ...] = Field(default=(512, 512), min_length=1, max_length=8)
    """Hidden layers of the policy."""
    max_start_yaw: float = Field(default=math.pi, ge=0, le=math.pi, strict=True)
    """Starts have a yaw within +- this angle [rad]."""


@dataclass(frozen=True, config=STRICT)
class Adapt:
    """Adaptation in flight (paper, Sec. IV-A.3)."""

    window: int = Field(default=100, ge=12, le=100_000, strict=True)
    """Ticks of flight that are remembered."""
    residual: Printable = "ensemble"
    """Residual model: ensemble (the paper's), regression (ten physical numbers), layered (an ensemble on what the
    regression leaves), linear (19 features, carried along the flight), or module:name."""
    memory: Seconds = 0.5
    """Regression: a tick counts for 1/e of the newest after this long [s]."""
    thrust_prior: float = Field(default=0.05, gt=0, le=1.0, strict=True)
    """Regression: standard deviation of the thrust gain before any flight [-]; a third more mass is -0.25."""
    fit_every: Seconds = 3.0
    """Time between residual fits [s]."""
    fit_steps: Count = 100
    """Optimiser steps of one fit."""
    fit_learning_rate: LearningRate = 1e-2
    """Adam's rate of the fit."""
    spectral_weight: float = Field(default=1e-3, ge=0, le=1e6, allow_inf_nan=False, strict=True)
    """Weight of the spectral penalty; the paper gives none."""
    update_every: Seconds = 5.0
    """Time between policy updates [s]."""
    num_updates: Count = 30
    """Optimiser steps of one update."""
    num_envs: Count = 10
    """Starts per step."""
    learning_rate: LearningRate = 1e-3
    """Adam's rate at the start of an update; it falls to zero along a cosine."""
    low_rank_learning_rate: LearningRate | None = None
    """The same of LoRA; that of all weights by default. A few directions have to do what all weights do."""
    max_grad_norm: Positive | None = None
    """Largest norm of a gradient; none is clipped by default."""
    optimiser: Literal["fresh", "carried"] = "fresh"
    """fresh: each update starts a new Adam, its rate falls to zero; carried: one Adam of constant rate."""
    task_starts: int | None = Field(default=None, ge=0, le=100_000, strict=True)
    """Starts of a step that the task draws; the others lie where the vehicle has just been. By default all of them."""
    start_noise: float = Field(default=0.1, ge=0, le=10.0, strict=True)
    """Standard deviation that is added to flown starts, position [m] and velocity [m/s]."""
    frame: Literal["world", "gravity"] = "world"
    """gravity: fly and train in the frame of the gravity that is felt. A disturbance observer feels it, beside what the
    residual predicts; for a policy that sees occluded keypoints, the pose filter does, which needs no state."""
    trim: Literal["free", "rest"] = "free"
    """rest: after an update the policy is shifted so that at rest at home it commands hover."""
    fit_latency: Seconds = 0.2
    """Flight time until a fitted residual is used [s]."""
    update_latency: Seconds = 1.0
    """Flight time until an updated policy flies [s]."""


@dataclass(frozen=True, config=STRICT)
class Track:
    """What only tracking has."""

    reference: Printable = "circle"
    """Reference of training: circle, figure8, star, a CSV file, module:name, or several of these joined by +."""
    observation: Literal["blind", "relative", "both", "preview", "flat"] = "both"
    """blind: o = [p, R, v], without the reference; relative: o = [p - p_ref, R, v - v_ref]; both: o = [p, R, v,
    p - p_ref, v - v_ref]; preview: the reference relative to the vehicle, now and up to 0.4 s ahead; flat: preview with
    acceleration and jerk."""
    start_spread: Positive = 1.0
    """Starts lie within this of the reference, per axis [m]."""
    felt_copies: int = Field(default=0, ge=0, le=100, strict=True)
    """Training also follows so many copies of each reference as they are where a constant push is gravity."""
    felt_push: Positive = 4.0
    """Largest such push [m/s^2]."""

    @property
    def looks_ahead(self) -> bool:
        """Whether the policy observes the future of its reference, so that one policy can follow several."""
        return self.observation in ("preview", "flat")


@dataclass(frozen=True, config=STRICT)
class Vision:
    """What only hover from keypoints has."""

    occlusion: bool = Field(default=False, strict=True)
    """In flight, points outside the image are not observed; else every point is, as in the paper."""
    pixel_noise: float = Field(default=0.0, ge=0, le=1000.0, strict=True)
    """Standard deviation of a pixel coordinate, in training and flight [px]."""
    dropout: float = Field(default=0.0, ge=0, lt=1, strict=True)
    """With occlusion: probability that a visible point is missed in a frame."""
    whiten_pixels: bool = Field(default=False, strict=True)
    """Pixels are whitened over random short motions; else fed as they are."""
    encoder_steps: int = Field(default=0, ge=0, le=1_000_000, strict=True)
    """Optimiser steps of encoder pretraining, before the policy is trained."""
    encoder_motions: Literal["near", "wild"] = "near"
    """The encoder sees synthetic motions: those of a vehicle that hovers, or about as wide as those of a random policy.
    Pixels are whitened over the first."""


@dataclass(frozen=True, config=STRICT)
class Family:
    """The vehicles that one policy is trained for, by their command paths. The policy observes what is known of its
    vehicle: a vehicle file, and the identification in flight."""

    delay: tuple[NotNegative, Positive] = (0.0, 0.1)
    """Shortest and longest delay of commands [s]."""
    rate_lag: tuple[Positive, Positive] = (0.01, 0.25)
    """Smallest and largest time constant of the body rates, 2 zeta / omega_n [s]."""
    least_damping: Positive = 0.4
    """Smallest damping ratio zeta of the rate loop."""
    thrust_lag: tuple[Positive, Positive] = (0.01, 0.15)
    """Smallest and largest time constant of the thrust [s]."""
    least_frequency: Positive = 4.0
    """Smallest natural frequency omega_n of a rate loop [rad/s]; a slower one rings less."""


@dataclass(frozen=True, config=STRICT)
class Preset:
    """An experiment."""

    name: Plain = "hover/paper"
    task: TaskName = "hover"
    """hover, track, vision, or module:name."""
    reward: Literal["paper", "l2", "stiff", "sharp", "view"] = "paper"
    """paper: as printed; l2: ours, with a tip at the goal in hover; stiff: in hover, with cheap commands and a steep
    tip; sharp: l2 with a tip at the reference, too; view: l2 that keeps keypoints in the image."""
    vehicle: Printable | VehicleSpec = "small"
    """Vehicle of training: small, large, kingfisher, module:name, or a vehicle file."""
    dt: float = Field(default=0.02, ge=0.002, le=0.1, strict=True)
    """Control period [s]: 50 Hz in the paper (Sec. III-E). A whole number of milliseconds."""
    goal: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 1.0)
    """Where to hover, world [m]."""
    termination_box: Positive = 5.0
    """A vehicle farther than this from the goal or reference along an axis is terminated [m]."""
    axes: Literal["world", "heading"] = "world"
    """Axes of the observed state. heading: they turn with the vehicle, so that a hover policy flies alike at every
    heading."""
    command_history: int = Field(default=0, ge=0, le=50, strict=True)
    """Past commands in the observation."""
    delay_ticks: int = Field(default=0, ge=0, le=20, strict=True)
    """Command delay of the model [ticks]."""
    plant_delay_ticks: int = Field(default=1, ge=0, le=20, strict=True)
    """Declared command delay of the plant [ticks], to pair accelerations with commands."""
    actuator_tau: Positive | None = None
    """Time constant of the model's actuators [s]; none by default."""
    jump_cost: float = Field(default=0.0, ge=0.0, le=1e6, allow_inf_nan=False, strict=True)
    """Cost of the squared change of the command from tick to tick, c in m/s^2 and rates in rad/s."""
    track: Track | None = None
    vision: Vision | None = None
    family: Family | None = None
    """Vehicles of training; None: the vehicle alone."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Free table for a task of one's own."""
    pretrain: Pretrain = Field(default_factory=Pretrain)
    adapt: Adapt = Field(default_factory=Adapt)

    @model_validator(mode="after")
    def _consistent(self) -> "Preset":
        """A table belongs to its task; times fit the control period."""
        for name in ("track", "vision"):
            if getattr(self, name) is not None and self.task != name:
                raise ValueError(f"a table [{name}] needs task = {name!r}, not {self.task!r}")
        for reward, task in (("stiff", "hover"), ("sharp", "track"), ("view", "vision")):
            if self.reward == reward and self.task != task:
                raise ValueError(f"reward = {reward!r} is for task = {task!r}, not for {self.task!r}")
        if self.axes == "heading" and self.task != "hover":
            raise ValueError(f"axes = 'heading' is for task = 'hover', not for {self.task!r}")
        if self.family is not None:
            if self.task == "vision":
                raise ValueError("a table [family] is for a task with a measured state, not for 'vision'")
            if self.command_history * self.dt < self.family.delay[1]:
                raise ValueError(
                    f"command_history = {self.command_history} ticks must cover family.delay up to "
                    f"{self.family.delay[1]:g} s, that is {math.ceil(self.family.delay[1] / self.dt - 1e-6)} ticks"
                )
        if self.adapt.trim == "rest" and self.adapt.frame == "world":
            raise ValueError("adapt.trim = 'rest' needs adapt.frame = 'gravity': a push is part of hover there only")
        if self.options and self.task in BUILT_IN_TASKS:
            raise ValueError(f"a table [options] is for a task of one's own, not for {self.task!r}")
        if abs(1000 * self.dt - round(1000 * self.dt)) > 1e-6:
            raise ValueError(f"dt = {self.dt} s must be a whole number of milliseconds")
        if self.adapt.window < self.plant_delay_ticks + 12:
            raise ValueError(f"adapt.window = {self.adapt.window} is too short for plant_delay_ticks")
        return self
