"""In what a policy is pretrained, and by what: the nominal model and the optimiser of a preset."""

import math
from typing import Any

import jax.numpy as jnp
import optax

from ..physics.actuators import Lagged
from ..physics.dynamics import AbstractDynamics, PointMass
from .presets import Preset, Pretrain


def nominal_model(preset: Preset) -> AbstractDynamics[Any]:
    """Return the point mass of Eq. (1) of the paper, behind the lag of the actuators where a preset declares one."""
    model = PointMass(preset.dt)
    return model if preset.actuator_tau is None else Lagged(model, jnp.array(preset.actuator_tau))


def pretraining_optimiser(table: Pretrain) -> optax.GradientTransformation:
    """Return Adam under a cosine, behind a clip; each call makes another object, for which programs compile anew."""
    rate = optax.cosine_decay_schedule(table.learning_rate, table.num_updates)
    return optax.chain(optax.clip_by_global_norm(table.max_grad_norm or math.inf), optax.adam(rate, b2=table.adam_b2))
