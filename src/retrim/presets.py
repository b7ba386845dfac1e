"""Every number of an experiment, once: named presets as plain values.

A preset is a tree of frozen, validated dataclasses. A TOML file and then command-line flags may overlay it; an unknown
name or an impossible value is an error that gives its path.
"""

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import Any, Literal

from pydantic import (
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    TypeAdapter,
    ValidationError,
)
from pydantic.dataclasses import dataclass

from .tasks.hover import TILT

DT = 0.02  # [s]: 50 Hz (paper, Sec. III-E)
_STRICT = ConfigDict(extra="forbid")


@dataclass(frozen=True, config=_STRICT)
class Pretrain:
    """Training of the base policy in the nominal model."""

    epochs: PositiveInt = 300
    """One optimiser step each."""
    envs: PositiveInt = 100
    """Starts per epoch."""
    horizon: PositiveInt = 150
    """Ticks of a roll-out: 3 s."""
    rate: PositiveFloat = 5e-3
    """Adam's rate at the start; it falls to zero along a cosine. The paper is silent; the authors' code has 5e-3."""
    b2: float = Field(default=0.999, ge=0, lt=1)
    """Adam's second decay."""
    clip: PositiveFloat | None = None
    """Largest norm of a gradient; none is clipped by default."""
    hidden: tuple[PositiveInt, ...] = (512, 512)
    """Hidden layers of the policy."""
    heading: float = Field(default=math.pi, ge=0, le=math.pi)
    """Starts head within +- this angle of the x axis [rad]."""


@dataclass(frozen=True, config=_STRICT)
class Adapt:
    """Adaptation in flight (paper, Sec. IV-A.3)."""

    window: int = Field(default=100, ge=12)
    """Ticks of flight that are remembered: 2 s."""
    refine_every: float = Field(default=3.0, ge=DT, allow_inf_nan=False)
    """Time between residual fits [s]."""
    iters: PositiveInt = 100
    """Steps of one fit."""
    residual_rate: PositiveFloat = 1e-2
    """Adam's rate of the fit."""
    beta: float = Field(default=1e-3, ge=0)
    """Weight of the spectral penalty; the paper gives none."""
    improve_every: float = Field(default=5.0, ge=DT, allow_inf_nan=False)
    """Time between policy updates [s]."""
    epochs: PositiveInt = 30
    """Optimiser steps of one update."""
    envs: PositiveInt = 10
    """Starts per step."""
    rate: PositiveFloat = 1e-3
    """Adam's rate at the start of an update; it falls to zero along a cosine."""
    clip: PositiveFloat | None = None
    """Largest norm of a gradient; none is clipped by default."""
    refine_charge: float = Field(default=0.2, gt=0, allow_inf_nan=False)
    """Flight time until a fitted residual is used [s]."""
    improve_charge: float = Field(default=1.0, gt=0, allow_inf_nan=False)
    """Flight time until an improved policy flies [s]."""


@dataclass(frozen=True, config=_STRICT)
class Preset:
    """An experiment."""

    name: str = "paper"
    task: Literal["hover", "track", "vision"] = "hover"
    reference: str = "circle"
    """What a tracking policy is trained on: circle, figure8, star, a CSV file of t, x, y, z[, yaw], or several of these
    joined by +."""
    observation: Literal["state", "preview"] = "state"
    """state: o = [p, R, v]; preview: the reference relative to the vehicle, now and soon."""
    reward: Literal["paper", "sharp"] = "paper"
    """paper: as printed; sharp: ours, for every task."""
    spread: float = Field(default=1.0, gt=0, allow_inf_nan=False)
    """Tracking starts lie within this of the reference, per axis [m]."""
    honest: bool = False
    """Vision, in flight: what the camera does not see is not observed; else every point is fed, as in the paper."""
    pixel_noise: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    """Vision, in training and flight [px]."""
    dropout: float = Field(default=0.0, ge=0, lt=1)
    """Vision, in honest flight: probability that a visible point is missed in a frame."""
    whitened: bool = False
    """Vision: pixels whitened over random short motions; else as they are."""
    represent: NonNegativeInt = 0
    """Vision: steps of learning to see, before learning to fly."""
    lag: PositiveFloat | None = None
    """Time constant of the actuators in the model [s]; none by default."""
    vehicle: Literal["small", "large", "kingfisher"] = "small"
    """The vehicle that the policy is trained for."""
    goal: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.0, 0.0, 1.0)
    """Where to hover, world [m]."""
    box: PositiveFloat = 5.0
    """A vehicle farther than this from the goal along an axis is lost [m]."""
    history: NonNegativeInt = 0
    """Past commands in the observation."""
    delay: int = Field(default=0, ge=0, le=10)
    """Command delay inside the simulator [ticks]."""
    plant_delay: int = Field(default=1, ge=0, le=10)
    """Declared command delay of the plant [ticks], for pairing accelerations with commands."""
    pretrain: Pretrain = Field(default_factory=Pretrain)
    adapt: Adapt = Field(default_factory=Adapt)


TRACK = Preset(
    name="track",
    task="track",
    reference="circle+figure8+star",
    observation="preview",
    reward="sharp",
    history=2,
    delay=1,
    lag=0.033,
    pretrain=Pretrain(epochs=600, envs=32, horizon=100, rate=3e-3, clip=1.0),
    adapt=Adapt(window=250, clip=1.0),
)

VISION = Preset(
    name="vision",
    task="vision",
    reward="sharp",
    delay=1,
    pixel_noise=0.5,
    whitened=True,
    represent=3000,
    pretrain=Pretrain(epochs=300, envs=16, rate=3e-3, b2=0.95, clip=1.0, hidden=(256, 256), heading=TILT),
    adapt=Adapt(clip=1.0),
)

PRESETS: dict[str, Preset] = {
    # As printed: o = [p, R, v], no delay in the model, 300 x 100 x 150.
    "paper": Preset(),
    # The delay and the observation of the authors' code: 2 ticks, the last three commands, 200 x 200 x 150.
    "released": Preset(name="released", history=3, delay=2, pretrain=Pretrain(epochs=200, envs=200)),
    # Ours: one tick of delay and the last two commands, a small budget that reaches the same hover error.
    "fast": Preset(
        name="fast",
        history=2,
        delay=1,
        pretrain=Pretrain(epochs=150, envs=16, b2=0.95, clip=1.0, heading=TILT),
        adapt=Adapt(clip=1.0),
    ),
    # Tracking as printed: the policy sees p, R, v and never its reference. Five seconds of flight are remembered.
    "track-paper": Preset(name="track-paper", task="track", spread=0.3, adapt=Adapt(window=250)),
    # Ours: the reference seen ahead, a sharp reward, one tick of delay and actuator lag in the model.
    "track": TRACK,
    # Seven points on the ground, five frames, three commands, no state; every point fed, as in the paper.
    "vision": VISION,
    # The same, but what the camera does not see is not observed; pixels are noisy and some are missed.
    "vision-honest": dataclasses.replace(VISION, name="vision-honest", honest=True, pixel_noise=1.0, dropout=0.05),
    # The paper's sizes: raw pixels, 500 x 300, updates of 50 epochs x 30 environments.
    "vision-paper": Preset(
        name="vision-paper",
        task="vision",
        delay=1,
        represent=3000,
        pretrain=Pretrain(epochs=500, envs=300, rate=1e-3, heading=TILT),
        adapt=Adapt(epochs=50, envs=30, improve_charge=5.0),
    ),
}


class PresetError(ValueError):
    """A preset that does not exist or cannot be. The text gives the path of each bad value."""


def load(name: str, overlay: Path | None = None) -> Preset:
    """The preset ``name``, overlaid with a TOML file; raises :class:`PresetError`."""
    if name not in PRESETS:
        raise PresetError(f"no preset {name!r}; there are {', '.join(PRESETS)}")
    return PRESETS[name] if overlay is None else overlaid(PRESETS[name], overlay)


def overlaid(preset: Preset, overlay: Path) -> Preset:
    """The preset with the values of a TOML file on top; raises :class:`PresetError`."""
    try:
        above = tomllib.loads(overlay.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise PresetError(f"{overlay}: {error}") from error
    return parse(_merged(values(preset), above), source=str(overlay))


def values(preset: Preset) -> dict[str, Any]:
    """As plain dictionaries and numbers."""
    return dataclasses.asdict(preset)


def parse(values: dict[str, Any] | str | bytes, *, source: str) -> Preset:
    """A validated preset, from a dictionary or from JSON; raises :class:`PresetError`."""
    adapter = TypeAdapter(Preset)
    try:
        return adapter.validate_python(values) if isinstance(values, dict) else adapter.validate_json(values)
    except ValidationError as error:
        wrong = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise PresetError(f"{source}: {wrong}") from error


def changed(preset: Preset, **tables: Any) -> Preset:
    """The preset with some values replaced, as in ``changed(preset, adapt={"epochs": 5})``; validated."""
    return parse(_merged(values(preset), tables), source="flags")


def dump(preset: Preset) -> str:
    """As JSON, the inverse of :func:`parse`."""
    return TypeAdapter(Preset).dump_json(preset).decode()


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    deep = {k: _merged(below[k], v) for k, v in above.items() if isinstance(v, dict) and isinstance(below.get(k), dict)}
    return {**below, **above, **deep}
