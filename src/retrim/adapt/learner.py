"""The online learner: pure functions of a window of flight, without internal state and without a clock."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Key

from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy
from ..learn.bptt import PolicyState, bptt
from ..learn.env import Env
from ..learn.residuals.model import FittedResidual, ResidualModel
from ..learn.residuals.targets import residual_targets
from ..learn.screening import screen
from ..learn.window import Window
from ..physics.state import where
from ..tasks.task import Start
from .gate import Verdict, all_finite, judge
from .learner_state import FitReport, LearnerState
from .optimisers import AbstractPolicyOptimiser
from .starts import AbstractStarts, TaskStarts
from .trim import AbstractTrim, NoTrim
from .updates import Layer
from .vehicles import AbstractVehicles, OwnVehicle
from .views import AbstractView, WorldView
from .worker import Worker

GATE_STARTS = 8  # number of starts for the roll-outs of the gate
RETRAIN = 2**30 + 6  # folded into the key of an update for the random numbers of its training
VEHICLES = 2**30 + 5  # folded into the keys of starts to draw the vehicles at these starts


class OnlineLearner(eqx.Module):
    """Learns from a window of flight (paper, Sec. IV-A.3). Every number that may change is an array.

    A custom learner is a subclass. It overrides :meth:`retrain`, which trains in the corrected model, or
    :meth:`worker`, for a learner that JAX cannot trace. The preset names, in ``adapt.learner``, a function that takes a
    :class:`~retrim.LearnerRequest` and builds the learner.

    Example::

        class Frozen(retrim.OnlineLearner):
            def retrain(self, state, env, starts, key):
                return state

        def make(request):
            return request.create(Frozen)
    """

    env: Env
    """The task of the flight, the nominal model and its delay; the model is independent of the plant."""
    residual_model: ResidualModel
    optimiser: AbstractPolicyOptimiser
    """Optimiser that re-trains the policy."""
    plant_delay_ticks: int = eqx.field(static=True)
    """Declared command delay of the plant [ticks]; it pairs accelerations with the commands that caused them."""
    num_updates: int = eqx.field(static=True)
    """Optimiser steps per policy update."""
    num_envs: int = eqx.field(static=True)
    """Starts per optimiser step."""
    starts: AbstractStarts = TaskStarts()
    """Source of the starts."""
    view: AbstractView = WorldView()
    """Coordinates in which the policy is trained and flies."""
    trim: AbstractTrim = NoTrim()
    """Correction of the policy's command at rest after an update."""
    vehicles: AbstractVehicles = OwnVehicle()
    """Vehicle of the flight: that of the model, or an identified one."""
    low_rank_optimiser: AbstractPolicyOptimiser | None = None
    """Optimiser for a low-rank delta, of the same kind as ``optimiser``; None for ``optimiser`` itself."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` for invalid sizes."""
        for name in ("num_updates", "num_envs"):
            if getattr(self, name) < 1:
                raise ValueError(f"OnlineLearner.{name} = {getattr(self, name)} must be at least 1")
        if self.plant_delay_ticks < 0:
            raise ValueError(f"OnlineLearner.plant_delay_ticks = {self.plant_delay_ticks} must not be negative")

    def init(self, policy: AbstractPolicy | LoraPolicy, key: Key[Array, ""]) -> LearnerState:
        """Return the state before the first fit, with a residual that predicts zero; the key is consumed."""
        fresh = PolicyState(policy, self.optimiser.transformation(self.num_updates).init(policy.params))
        return LearnerState(fresh, _fresh_residual(self.residual_model, key))

    @eqx.filter_jit
    def fit_residual(self, state: Any, window: Window) -> tuple[Any, FitReport]:
        """Fit the residual model to a window, starting from the previous fit.

        Measurements that contradict each other are left out. If more than half contradict, the fit is not accepted.

        Args:
            state: State of the residual model.
            window: Ticks of flight.

        Returns:
            The new state, or ``state`` if the fit is not accepted, and a report.
        """
        screening, delay = screen(window, self.env.dynamics.dt), self.plant_delay_ticks
        window = self.vehicles.apply_path(window)
        rows = residual_targets(window, self.env.dynamics, delay_ticks=delay, consistent=screening.steps)
        residual, rms = self.residual_model.fit(state, rows)
        valid = all_finite(residual) & jnp.any(rows.valid) & screening.trusted
        return where(valid, residual, state), FitReport(rms, valid, screening.counts)

    @eqx.filter_jit
    def update_policy(
        self,
        state: PolicyState,
        residual: Any,
        window: Window,
        key: Key[Array, ""],
        active: AbstractPolicy | LoraPolicy | None = None,
    ) -> tuple[PolicyState, Verdict]:
        """Re-train the policy by back-propagation in the corrected model, and judge the result.

        Gradients flow through the analytical model only. The gate simulates flights from eight starts that the update
        did not use for training: four states from the window and four random starts from the task. Measurements that
        contradict their neighbours are not used as starts. While more than half of the measurements are contradictory,
        the gate refuses every policy.

        Args:
            state: Policy to start from.
            residual: State of the residual model.
            window: Ticks of flight.
            key: Random key, consumed.
            active: Policy in flight, with which the gate compares the trained one; by default that of ``state``.

        Returns:
            The trained policy, and the gate's verdict on it.
        """
        screening = screen(window, self.env.dynamics.dt)
        usable = jnp.where(jnp.any(screening.samples), screening.samples, window.valid)
        window = dataclasses.replace(window, valid=usable)
        corrected_env = self.view(self.env, FittedResidual(self.residual_model, residual))
        k_train, k_gate, k_window = random.split(key, 3)
        x0 = self.starts(self.env.task, window, k_train, self.num_updates, self.num_envs)
        vehicle = self.vehicles.identify(window)
        x0 = self.vehicles.assign_vehicles(x0, vehicle, random.fold_in(k_train, VEHICLES))
        candidate = self.retrain(state, corrected_env, x0, random.fold_in(k_train, RETRAIN))
        trained_state = PolicyState(self.trim(candidate.policy, corrected_env, window), candidate.optimiser)
        test_starts = jax.tree.map(
            lambda a, b: jnp.concatenate([a, b]),
            jax.vmap(self.env.task.reset)(random.split(k_gate, GATE_STARTS // 2)),
            self.starts.recent(self.env.task, window, k_window, GATE_STARTS // 2),
        )
        incumbent = state.policy if active is None else active
        test_starts = self.vehicles.assign_vehicles(test_starts, vehicle, random.fold_in(k_gate, VEHICLES))
        verdict = judge(trained_state.policy.merged(), incumbent.merged(), corrected_env, test_starts)
        return trained_state, verdict.require(screening.trusted)

    def retrain(self, state: PolicyState, env: Env, starts: Start, key: Key[Array, ""]) -> PolicyState:
        """Train the policy in the corrected model by back-propagation through time; JAX traces this method.

        Args:
            state: Policy to start from, and the state of its optimiser.
            env: Task and corrected model, in the coordinates of the policy.
            starts: Starts, ``num_updates`` x ``num_envs``.
            key: Random key, consumed.

        Returns:
            The trained policy, before trim and gate, with the structure and shapes of ``state``.
        """
        del key
        optimiser = (isinstance(state.policy, LoraPolicy) and self.low_rank_optimiser) or self.optimiser
        start = optimiser.begin(state, self.num_updates)
        return bptt(start, env, starts, optimiser=optimiser.transformation(self.num_updates))[0]

    def worker(self, layer: Layer, state: LearnerState, key: Key[Array, ""]) -> Worker | None:
        """Return a custom worker for a learning layer; None, the default, selects the built-in one.

        Args:
            layer: ``residual`` or ``policy``.
            state: Learner state at the start of the flight.
            key: Random key, consumed.
        """
        del layer, state, key
        return None


@eqx.filter_jit
def _fresh_residual(model: ResidualModel, key: Key[Array, ""]) -> Any:
    return model.init(key)
