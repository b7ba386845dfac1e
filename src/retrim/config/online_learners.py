"""Registries of online learners and of the optimisers for their policy updates."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from jaxtyping import Array, Float

from ..adapt.learner import OnlineLearner
from ..adapt.optimisers import AbstractPolicyOptimiser, CarriedAdam, FreshAdam
from ..adapt.starts import TaskOnlyStarts
from ..errors import ConfigError
from ..learn.env import Env
from ..learn.residuals.model import ResidualModel
from .learners import learner_settings
from .presets import Preset
from .registry import Registry

L = TypeVar("L", bound=OnlineLearner)
Rate = Float[Array, ""]


@dataclass(frozen=True)
class LearnerRequest:
    """The inputs from which an online learner is built."""

    preset: Preset
    model: ResidualModel
    """Residual model."""
    env: Env
    """Environment of the learner: task, nominal model and delay."""
    paced: bool = False
    """Whether the reference of the flight has a variable pace. The learner then trains on the references of
    pretraining, which contain every pace."""

    def create(self, kind: Callable[..., L], **settings: Any) -> L:
        """Return a learner with the settings of the preset.

        Args:
            kind: :class:`~retrim.OnlineLearner` or a subclass.
            **settings: Values that replace those of the preset, and further fields of the subclass.

        Raises:
            ConfigError: The preset names an unknown optimiser, or contains settings that its task does not permit.
        """
        make = OPTIMISERS.find(self.preset.adapt.optimiser)
        result = learner_settings(self.preset, self.env, make)
        if self.paced:
            result["starts"] = TaskOnlyStarts()
        return kind(**{"env": self.env, "residual_model": self.model, **result, **settings})


LEARNERS: Registry[Callable[[LearnerRequest], OnlineLearner]] = Registry(
    "learner", example="module:name of a function", expected="a function of a LearnerRequest"
)
register_learner = LEARNERS.register
OPTIMISERS: Registry[Callable[[Rate, Rate], AbstractPolicyOptimiser]] = Registry(
    "optimiser", example="module:name of a class", expected="an AbstractPolicyOptimiser"
)
register_optimiser = OPTIMISERS.register


def make_learner(request: LearnerRequest) -> OnlineLearner:
    """Build the online learner of a preset.

    Raises:
        ConfigError: There is no such learner, or the function does not return an :class:`~retrim.OnlineLearner`.
    """
    name = request.preset.adapt.learner
    learner = LEARNERS.find(name)(request)
    if not isinstance(learner, OnlineLearner):
        raise ConfigError(f"learner {name!r} returns {type(learner).__name__}, expected a retrim.OnlineLearner")
    return learner


def _bptt(request: LearnerRequest) -> OnlineLearner:
    return request.create(OnlineLearner)


register_learner("bptt", _bptt)
register_optimiser("fresh", FreshAdam)
register_optimiser("carried", CarriedAdam)
