"""The learner that runs beside the flight: pure functions, no state of its own, no clock."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import random
from jaxtyping import Array, Bool, Float, Key

from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..learn.bptt import PolicyState, bptt
from ..learn.pretrain import starts
from ..learn.residual import EnsembleResidual, ResidualState, Window, fit_residual, residual_targets
from ..physics.dynamics import AbstractDynamics, Hybrid
from ..physics.state import where
from ..tasks.task import AbstractTask, Start
from .gate import Verdict, finite, judge


class AdaptState(eqx.Module):
    """What adaptation carries, in two halves, so that two learners can own one each."""

    policy: PolicyState
    residual: ResidualState


class Adapter(eqx.Module):
    """How to learn from a window of flight (paper, Sec. IV-A.3). Every number that may change is an array."""

    task: AbstractTask
    nominal: AbstractDynamics[Any]
    """The analytical model; it knows nothing of the plant."""
    residual_rate: Float[Array, ""]
    """Adam's rate for the residual; its moments are carried from fit to fit."""
    beta: Float[Array, ""]
    """Weight of the spectral penalty."""
    policy_rate: Float[Array, ""]
    """Adam's rate at the start of a burst; it falls to zero along a cosine. Each burst starts a fresh Adam."""
    clip: Float[Array, ""]
    """Largest norm of a policy gradient; infinity for none."""
    delay: int = eqx.field(static=True)
    """Command delay inside the simulator [ticks]."""
    plant_delay: int = eqx.field(static=True)
    """Declared command delay of the plant [ticks], to pair accelerations with the commands that caused them."""
    iters: int = eqx.field(static=True)
    """Steps of one residual fit."""
    epochs: int = eqx.field(static=True)
    envs: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Raise ``ValueError`` for sizes that cannot work."""
        for name in ("iters", "epochs", "envs"):
            if getattr(self, name) < 1:
                raise ValueError(f"Adapter.{name} = {getattr(self, name)} must be at least 1")
        if self.delay < 0 or self.plant_delay < 0:
            raise ValueError(f"Adapter.delay = {self.delay}, plant_delay = {self.plant_delay}: must not be negative")

    def init(self, policy: Policy | LoraPolicy, residual: EnsembleResidual) -> AdaptState:
        """Before the first fit. The residual should predict zero, so that the hybrid model starts as the nominal."""
        fresh = PolicyState(policy, self._policy_optimiser().init(policy.trained))
        return AdaptState(fresh, ResidualState.of(residual, self._residual_optimiser()))

    @eqx.filter_jit
    def refine(self, s: ResidualState, window: Window) -> tuple[ResidualState, Float[Array, ""], Bool[Array, ""]]:
        """Fit the residual to the window, from where the last fit ended; and its error, root mean square [m/s^2].

        A fit that is not finite is dropped: the old state comes back, and the last value is false.
        """
        rows = residual_targets(window, self.nominal, delay=self.plant_delay)
        fitted, errors = fit_residual(s, rows, optimiser=self._residual_optimiser(), iters=self.iters, beta=self.beta)
        sound = finite(fitted)
        return where(sound, fitted, s), jnp.sqrt(errors[-1]), sound

    @eqx.filter_jit
    def improve(
        self, s: PolicyState, residual: EnsembleResidual, window: Window, key: Key[Array, ""]
    ) -> tuple[PolicyState, Verdict]:
        """One burst of back-propagation through the hybrid model, and the gate's verdict on its result.

        Gradients flow through the analytical model only. The key is consumed. The gate flies eight starts that
        the burst did not train on: four states of the window, four resets.
        """
        hybrid = Hybrid(self.nominal, residual)
        k_train, k_gate, k_flown = random.split(key, 3)
        x0 = starts(self.task, k_train, self.epochs, self.envs)
        optimiser = self._policy_optimiser()
        fresh = PolicyState(s.policy, optimiser.init(s.policy.trained))
        trained, _ = bptt(fresh, hybrid, self.task, x0, optimiser=optimiser, delay=self.delay)
        held_out = jax.tree.map(
            lambda box, sky: jnp.concatenate([box, sky]),
            jax.vmap(self.task.reset)(random.split(k_gate, 4)),
            _drawn(window, k_flown, 4),
        )
        return trained, judge(trained.policy.plain(), s.policy.plain(), hybrid, self.task, held_out, delay=self.delay)

    def _residual_optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.residual_rate)

    def _policy_optimiser(self) -> optax.GradientTransformation:
        schedule = optax.cosine_decay_schedule(1.0, self.epochs)
        return optax.chain(
            optax.clip_by_global_norm(self.clip),
            optax.scale_by_adam(),
            optax.scale_by_schedule(lambda step: -self.policy_rate * schedule(step)),
        )


def _drawn(window: Window, key: Key[Array, ""], n: int) -> Start:
    """``n`` states, with their times, drawn from the valid part of the window."""
    weight = window.valid.astype(window.x.p.dtype)
    row = random.choice(key, window.valid.shape[0], (n,), p=weight / jnp.sum(weight))
    drawn: Start = jax.vmap(Start)(window.t[row], jax.tree.map(lambda leaf: leaf[row], window.x))
    return drawn
