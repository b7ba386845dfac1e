"""The online learner: pure functions of a window of flight, without state of its own and without a clock."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float, Int, Key

from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..learn.bptt import PolicyState, bptt
from ..learn.env import Env
from ..learn.residuals.model import FittedResidual, ResidualModel
from ..learn.residuals.targets import residual_targets
from ..learn.screening import screen
from ..learn.window import Window
from ..physics.state import where
from .gate import Verdict, all_finite, judge
from .optimisers import AbstractPolicyOptimiser
from .starts import AbstractStarts, TaskStarts, drawn
from .trim import AbstractTrim, Untrimmed
from .vehicles import AbstractVehicles, OwnVehicle
from .views import AbstractView, WorldView

HELD_OUT = 8  # number of starts for the roll-outs of the gate
VEHICLES = 2**30 + 5  # folded into the keys of starts to draw the vehicles at these starts


class LearnerState(eqx.Module):
    """Learned policy and residual. They are separate, so that two processes can own one each."""

    policy: PolicyState
    residual: Any
    """State of the residual model: a pytree of arrays."""


class FitReport(eqx.Module):
    """Result of a residual fit."""

    rms_error: Float[Array, ""]
    """Root mean square of the error over the window [m/s^2]."""
    accepted: Bool[Array, ""]
    """False if the fit is not finite or no tick of the window could be used; the old state is then kept."""
    contradictions: Int[Array, "5"]
    """Steps of the window that were left out, by reason; see :class:`~retrim.learn.screening.Screening`."""


class OnlineLearner(eqx.Module):
    """Learner from a window of flight (paper, Sec. IV-A.3). Every number that may change is an array."""

    env: Env
    """Task of the flight, nominal model and its delay; the model is independent of the plant."""
    residual_model: ResidualModel
    optimiser: AbstractPolicyOptimiser
    """Optimiser that re-trains the policy."""
    plant_delay_ticks: int = eqx.field(static=True)
    """Declared command delay of the plant [ticks], to pair accelerations with the commands that caused them."""
    num_updates: int = eqx.field(static=True)
    """Optimiser steps of one policy update."""
    num_envs: int = eqx.field(static=True)
    """Starts per optimiser step."""
    starts: AbstractStarts = TaskStarts()
    """Source of the starts."""
    view: AbstractView = WorldView()
    """Coordinates in which the policy is trained and flies."""
    trim: AbstractTrim = Untrimmed()
    """Correction of the policy's command at rest after an update."""
    vehicles: AbstractVehicles = OwnVehicle()
    """Vehicle of the flight: that of the model, or an identified one."""
    low_rank_optimiser: AbstractPolicyOptimiser | None = None
    """Optimiser that re-trains a low-rank delta, of the same kind as ``optimiser``; None for ``optimiser`` itself."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` for sizes that cannot work."""
        for name in ("num_updates", "num_envs"):
            if getattr(self, name) < 1:
                raise ValueError(f"OnlineLearner.{name} = {getattr(self, name)} must be at least 1")
        if self.plant_delay_ticks < 0:
            raise ValueError(f"OnlineLearner.plant_delay_ticks = {self.plant_delay_ticks} must not be negative")

    def init(self, policy: Policy | LoraPolicy, key: Key[Array, ""]) -> LearnerState:
        """Return the state before the first fit, with a residual that predicts zero; the key is consumed."""
        fresh = PolicyState(policy, self.optimiser.transformation(self.num_updates).init(policy.params))
        return LearnerState(fresh, _fresh_residual(self.residual_model, key))

    @eqx.filter_jit
    def fit_residual(self, state: Any, window: Window) -> tuple[Any, FitReport]:
        """Fit the residual model to a window, starting from the last fit.

        Measurements that contradict each other are left out. If they are more than half, the fit is not accepted.

        Args:
            state: State of the residual model.
            window: Ticks of flight.

        Returns:
            The new state, or ``state`` if the fit is not finite or had no data, and a report.
        """
        screening, delay = screen(window, self.env.dynamics.dt), self.plant_delay_ticks
        window = self.vehicles.apply_path(window)
        rows = residual_targets(window, self.env.dynamics, delay_ticks=delay, consistent=screening.steps)
        fitted, rms = self.residual_model.fit(state, rows)
        accepted = all_finite(fitted) & jnp.any(rows.valid) & screening.trusted
        return where(accepted, fitted, state), FitReport(rms, accepted, screening.counts)

    @eqx.filter_jit
    def update_policy(
        self,
        state: PolicyState,
        residual: Any,
        window: Window,
        key: Key[Array, ""],
        flown: Policy | LoraPolicy | None = None,
    ) -> tuple[PolicyState, Verdict]:
        """Re-train the policy by back-propagation in the corrected model, and judge the result.

        Gradients flow through the analytical model only. The gate simulates flights from eight starts that the update
        did not use for training: four states of the window and four random starts of the task. Measurements that
        contradict their neighbours are not used as starts, and the gate refuses every policy while more than half of
        the measurements are contradictory.

        Args:
            state: Policy to start from.
            residual: State of the residual model.
            window: Ticks of flight.
            key: Random key, consumed.
            flown: Policy in flight, with which the gate compares the trained one; by default that of ``state``.

        Returns:
            The trained policy, and the gate's verdict on it.
        """
        screening = screen(window, self.env.dynamics.dt)
        usable = jnp.where(jnp.any(screening.samples), screening.samples, window.valid)
        window = dataclasses.replace(window, valid=usable)
        corrected = self.view(self.env, FittedResidual(self.residual_model, residual))
        k_train, k_gate, k_window = random.split(key, 3)
        x0 = self.starts(self.env.task, window, k_train, self.num_updates, self.num_envs)
        vehicle = self.vehicles.identify(window)
        x0 = self.vehicles.assign_vehicles(x0, vehicle, random.fold_in(k_train, VEHICLES))
        optimiser = (isinstance(state.policy, LoraPolicy) and self.low_rank_optimiser) or self.optimiser
        begun = optimiser.begin(state, self.num_updates)
        stepped, _ = bptt(begun, corrected, x0, optimiser=optimiser.transformation(self.num_updates))
        trained = PolicyState(self.trim(stepped.policy, corrected, window), stepped.optimiser)
        held_out = jax.tree.map(
            lambda a, b: jnp.concatenate([a, b]),
            jax.vmap(self.env.task.reset)(random.split(k_gate, HELD_OUT // 2)),
            drawn(window, k_window, (HELD_OUT // 2,)),
        )
        incumbent = state.policy if flown is None else flown
        held_out = self.vehicles.assign_vehicles(held_out, vehicle, random.fold_in(k_gate, VEHICLES))
        verdict = judge(trained.policy.merged(), incumbent.merged(), corrected, held_out)
        return trained, verdict.provided(screening.trusted)


@eqx.filter_jit
def _fresh_residual(model: ResidualModel, key: Key[Array, ""]) -> Any:
    return model.init(key)
