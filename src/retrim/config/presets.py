"""Presets: all parameters of an experiment, as plain, validated values.

A preset is a tree of frozen dataclasses. :mod:`.named_presets` contains the named presets. A TOML file, and then
command-line flags, may replace values. An unknown name or an impossible value raises an error that states its path.
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
    """Number of optimiser steps."""
    num_envs: Count = 100
    """Number of starts per step."""
    horizon: Count = 150
    """Length of a roll-out [ticks]."""
    learning_rate: LearningRate = 5e-3
    """Initial learning rate of Adam; a cosine schedule reduces it to zero. The paper does not state this rate; the
    authors' code uses 5e-3."""
    adam_b2: float = Field(default=0.999, ge=0, lt=1, strict=True)
    """Second decay rate of Adam."""
    max_grad_norm: Positive | None = None
    """Largest gradient norm; by default, gradients are not clipped."""
    hidden_sizes: tuple[Count, ...] = Field(default=(512, 512), min_length=1, max_length=8)
    """Widths of the hidden layers in the policy network."""
    network: Printable = "mlp"
    """Policy network: mlp (a perceptron with ReLU), or module:name of a function that returns a network."""
    max_start_yaw: float = Field(default=math.pi, ge=0, le=math.pi, strict=True)
    """Largest yaw angle of a start, in either direction [rad]."""


@dataclass(frozen=True, config=STRICT)
class Adapt:
    """Adaptation in flight (paper, Sec. IV-A.3)."""

    window: int = Field(default=100, ge=12, le=100_000, strict=True)
    """Length of the stored flight window [ticks]."""
    residual: Printable = "ensemble"
    """Residual model: ensemble (the paper's), regression (ten physical numbers), layered (a regression, and
    an ensemble for the remaining error), linear (19 features, learned over the whole flight), place (a regression, and
    a map over position with a memory of minutes), swing (a regression, and an estimator of a load on a cable), or
    module:name."""
    memory: Seconds = 0.5
    """Regression: age at which a tick's weight is 1/e of the newest tick's weight [s]."""
    thrust_prior: float = Field(default=0.05, gt=0, le=1.0, strict=True)
    """Regression: prior standard deviation of the thrust gain [-]; a one-third larger mass corresponds to -0.25."""
    fit_every: Seconds = 3.0
    """Time between residual fits [s]."""
    fit_steps: Count = 100
    """Number of optimiser steps per fit."""
    fit_learning_rate: LearningRate = 1e-2
    """Learning rate of Adam for the fit."""
    spectral_weight: float = Field(default=1e-3, ge=0, le=1e6, allow_inf_nan=False, strict=True)
    """Weight of the spectral penalty; the paper does not state this weight."""
    update_every: Seconds = 5.0
    """Time between policy updates [s]."""
    num_updates: Count = 30
    """Number of optimiser steps per update."""
    num_envs: Count = 10
    """Number of starts per step."""
    learning_rate: LearningRate = 1e-3
    """Initial learning rate of Adam in an update; a cosine schedule reduces it to zero."""
    low_rank_learning_rate: LearningRate | None = None
    """Learning rate for LoRA; by default the same as for all weights. A few directions must have the effect of all
    weights."""
    max_grad_norm: Positive | None = None
    """Largest gradient norm; by default, gradients are not clipped."""
    learner: Printable = "bptt"
    """Online learner: bptt (back-propagation through time in the corrected model), or module:name of a function that
    takes a LearnerRequest."""
    optimiser: Printable = "fresh"
    """Optimiser of policy updates: fresh (a new Adam for each update, whose rate falls to zero), carried (one Adam with
    a constant rate), or module:name of an AbstractPolicyOptimiser."""
    task_starts: int | None = Field(default=None, ge=0, le=100_000, strict=True)
    """Number of starts per step that are drawn from the task; by default all. The others are recent states."""
    start_noise: float = Field(default=0.1, ge=0, le=10.0, strict=True)
    """Standard deviation of the noise added to starts from the flight: position [m] and velocity [m/s]."""
    frame: Literal["world", "gravity"] = "world"
    """Frame of flight and training. gravity: the frame of effective gravity, from the residual's prediction and a
    disturbance observer. For a policy that sees occluded keypoints, the pose filter provides this frame without a
    measured state."""
    trim: Literal["free", "rest"] = "free"
    """Correction after an update. rest: the policy is shifted so that it commands hover when the vehicle is at rest at
    home; free: no correction."""
    lap_learning: bool = Field(default=False, strict=True)
    """Whether the reference of a flight in laps is shifted against the error that repeats on every lap."""
    fit_latency: Seconds = 0.2
    """Flight time until a fitted residual is used [s]."""
    update_latency: Seconds = 1.0
    """Flight time until an updated policy is used [s]."""


@dataclass(frozen=True, config=STRICT)
class Track:
    """Parameters of the tracking task."""

    reference: Printable = "circle"
    """Training reference: circle, figure8, star, a CSV file, module:name, or several of these joined by +. With the
    suffix =max, the pace grows up to the limits of the vehicle."""
    observation: Literal["blind", "relative", "both", "preview", "flat", "thrust"] = "both"
    """Observation. blind: o = [p, R, v], without the reference; relative: o = [p - p_ref, R, v - v_ref]; both: o = [p,
    R, v, p - p_ref, v - v_ref]; preview: the reference relative to the vehicle, now and up to 0.4 s ahead; flat:
    preview plus acceleration and jerk; thrust: the error and the thrust that the path needs ahead, in body axes."""
    start_spread: Positive = 1.0
    """Largest distance of a start from the reference, per axis [m]."""
    gravity_copies: int = Field(default=0, ge=0, le=100, strict=True)
    """Number of extra training copies of each reference, each in the effective gravity of a constant push."""
    gravity_push: Positive = 4.0
    """Largest push in these copies [m/s^2]."""

    @property
    def looks_ahead(self) -> bool:
        """Whether the policy observes the future of its reference, so one policy can follow several references."""
        return self.observation in ("preview", "flat", "thrust")


@dataclass(frozen=True, config=STRICT)
class Vision:
    """Parameters of hovering from keypoints."""

    occlusion: bool = Field(default=False, strict=True)
    """Whether points outside the image are hidden in flight; otherwise all points are observed, as in the paper."""
    pixel_noise: float = Field(default=0.0, ge=0, le=1000.0, strict=True)
    """Standard deviation of the noise on pixel coordinates, in training and in flight [px]."""
    dropout: float = Field(default=0.0, ge=0, lt=1, strict=True)
    """Probability that a visible point is missed in a frame; used only with occlusion."""
    whiten_pixels: bool = Field(default=False, strict=True)
    """Whether pixels are whitened over random short motions; otherwise raw pixels are used."""
    encoder_steps: int = Field(default=0, ge=0, le=1_000_000, strict=True)
    """Number of optimiser steps that pretrain the encoder before the policy is trained."""
    encoder_motions: Literal["near", "wild"] = "near"
    """Synthetic motions for encoder pretraining. near: those of a hovering vehicle; wild: motions about as large
    as those of a random policy. Pixels are whitened over the near motions."""


@dataclass(frozen=True, config=STRICT)
class Family:
    """Family of vehicles for which one policy is trained, given as ranges of command paths.

    The policy observes the belief about the vehicle, which comes from a vehicle file and from in-flight identification.
    """

    delay: tuple[NotNegative, Positive] = (0.0, 0.1)
    """Shortest and longest command delay [s]."""
    rate_lag: tuple[Positive, Positive] = (0.01, 0.25)
    """Smallest and largest time constant of the body rates, 2 zeta / omega_n [s]."""
    least_damping: Positive = 0.4
    """Smallest damping ratio zeta of the rate loop."""
    thrust_lag: tuple[Positive, Positive] = (0.01, 0.15)
    """Smallest and largest time constant of the thrust [s]."""
    least_frequency: Positive = 4.0
    """Smallest natural frequency omega_n of a rate loop [rad/s]; slower rate loops have more damping."""
    excitation: bool = False
    """Whether a flight begins with small doublets of thrust and body rates, until the vehicle is identified. The
    doublets move the vehicle by a few centimetres. Live flights do not use doublets."""


@dataclass(frozen=True, config=STRICT)
class Preset:
    """All parameters of an experiment."""

    name: Plain = "hover/paper"
    task: TaskName = "hover"
    """Task: hover, track, vision, or module:name."""
    reward: Literal["paper", "l2", "stiff", "sharp", "exact", "view"] = "paper"
    """Reward. paper: as printed in the paper; l2: ours, with a tip at the goal in hover; stiff: for hover, with cheap
    commands and a steep tip; sharp: l2 with a tip at the reference; exact: the errors of sharp
    without its commands, for drag that changes the commands; view: l2 that also keeps keypoints in the image."""
    vehicle: Printable | VehicleSpec = "small"
    """Training vehicle: small, large, kingfisher, module:name, or a vehicle file."""
    dt: float = Field(default=0.02, ge=0.002, le=0.1, strict=True)
    """Control period [s], a whole number of milliseconds; the paper uses 50 Hz (Sec. III-E)."""
    goal: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 1.0)
    """Goal of the hover task, world frame [m]."""
    termination_box: Positive = 5.0
    """Largest distance from the goal or reference along any axis [m]; vehicles farther away are terminated."""
    axes: Literal["world", "heading"] = "world"
    """Axes of the observed state. heading: axes that turn with the vehicle, so a hover policy behaves the same at
    every heading."""
    command_history: int = Field(default=0, ge=0, le=50, strict=True)
    """Number of past commands in the observation."""
    delay_ticks: int = Field(default=0, ge=0, le=20, strict=True)
    """Command delay of the model [ticks]."""
    plant_delay_ticks: int = Field(default=1, ge=0, le=20, strict=True)
    """Declared command delay of the plant [ticks], used to pair accelerations with commands."""
    actuator_tau: Positive | None = None
    """Time constant of the actuators in the model [s]; by default the model has no lag."""
    jump_cost: float = Field(default=0.0, ge=0.0, le=1e6, allow_inf_nan=False, strict=True)
    """Weight of the cost on squared command changes between ticks, with c in m/s^2 and rates in rad/s."""
    track: Track | None = None
    vision: Vision | None = None
    family: Family | None = None
    """Family of training vehicles; by default only ``vehicle``."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Free-form table for a custom task."""
    pretrain: Pretrain = Field(default_factory=Pretrain)
    adapt: Adapt = Field(default_factory=Adapt)

    @model_validator(mode="after")
    def _consistent(self) -> "Preset":
        """Check that the tables belong to the task and that the times fit the control period."""
        for name in ("track", "vision"):
            if getattr(self, name) is not None and self.task != name:
                raise ValueError(f"a table [{name}] needs task = {name!r}, not {self.task!r}")
        for reward, task in (("stiff", "hover"), ("sharp", "track"), ("exact", "track"), ("view", "vision")):
            if self.reward == reward and self.task != task and self.task in BUILT_IN_TASKS:
                raise ValueError(f"reward = {reward!r} is for task = {task!r}, not for {self.task!r}")
        if self.axes == "heading" and self.task in ("track", "vision"):
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
            raise ValueError(
                "adapt.trim = 'rest' needs adapt.frame = 'gravity': only in that frame is a push part of hover"
            )
        starts, most = self.adapt.task_starts, self.adapt.num_envs
        if starts is not None and starts > most:
            raise ValueError(f"adapt.task_starts must be at most adapt.num_envs = {most}, got {starts}")
        if self.options and self.task in BUILT_IN_TASKS:
            raise ValueError(f"a table [options] is for a custom task, not for {self.task!r}")
        if abs(1000 * self.dt - round(1000 * self.dt)) > 1e-6:
            raise ValueError(f"dt = {self.dt} s must be a whole number of milliseconds")
        if self.adapt.window < self.plant_delay_ticks + 12:
            raise ValueError(f"adapt.window = {self.adapt.window} is too short for plant_delay_ticks")
        return self

    def __repr__(self) -> str:
        """Return the main numbers, in a few lines; ``dataclasses.asdict`` returns all of them."""
        train, adapt = self.pretrain, self.adapt
        vehicle = self.vehicle if isinstance(self.vehicle, str) else self.vehicle.name
        return "\n".join(
            [
                f"Preset {self.name}: task {self.task}, vehicle {vehicle}, control period {1000 * self.dt:g} ms",
                f"  pretraining: {train.num_updates} steps x {train.num_envs} starts x {train.horizon} ticks, "
                f"network {train.network} {' x '.join(map(str, train.hidden_sizes))}, reward {self.reward}",
                f"  adaptation: residual {adapt.residual} every {adapt.fit_every:g} s, "
                f"{adapt.num_updates} steps x {adapt.num_envs} starts every {adapt.update_every:g} s, "
                f"learner {adapt.learner}, frame {adapt.frame}",
            ]
        )
