"""Build all objects that a preset describes."""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import optax
from jax import random
from jaxtyping import Array, Float, Key

from ..adapt.learner import OnlineLearner
from ..adapt.learner_state import LearnerState
from ..adapt.updates import Layer
from ..adapt.workers import make_worker
from ..control.controller import AbstractController
from ..control.lora import LoraPolicy
from ..control.pace import PaceLimits
from ..control.paced_flight import PacedFlight
from ..control.policy import AbstractPolicy, Policy
from ..errors import ConfigError
from ..learn.encoder import pretrain_encoder
from ..learn.env import Env
from ..learn.pretrain import pretrain
from ..learn.residuals.model import FittedResidual, ResidualModel
from ..physics.state import State
from ..physics.vehicle import Vehicle
from ..progress import Progress, show_progress
from ..runtime.adaptive import AdaptivePilot, ScheduledLearner
from ..runtime.lockstep import LockstepLearner
from ..runtime.pilot import ControllerPilot, Pilot
from ..tasks.abstract_reference import AbstractReference
from ..tasks.motions import MOTIONS, NEAR
from ..tasks.reference import Reference
from ..tasks.task import AbstractTask
from .command_paths import longest_delay, model_path, with_delay
from .families import make_family
from .initialisers import flight_starts, low_rank
from .learners import make_adapted_flight, nominal_model, pretraining_optimiser
from .loading import load
from .networks import NETWORKS, NetworkRequest, make_policy
from .online_learners import LearnerRequest, make_learner
from .pacing import SUFFIX, is_paced, pace_limits
from .presets import Preset
from .presets import Track as TrackTable
from .references import make_reference, make_training_reference
from .residuals import ResidualRequest, make_residual
from .tasks import TaskRequest, find_task, make_task
from .vehicles import make_vehicle

Latency = Literal["fixed", "measured"]
"""Flight time that learning takes: a fixed value from the preset, or the measured computing time."""


@dataclass(frozen=True)
class Setup:
    """All objects that a preset describes. Build it with :meth:`from_preset`."""

    preset: Preset
    vehicle: Vehicle
    """Training vehicle."""
    env: Env
    """Training environment: nominal model, task and delay."""
    flight_task: AbstractTask
    """Task of the flight: the training task, with the reference of the flight."""
    learner: OnlineLearner
    """In-flight learner, which re-trains the policy on ``flight_task``."""
    optimiser: optax.GradientTransformation
    """Pretraining optimiser: gradient clipping, then Adam with a cosine schedule."""
    pace: PaceLimits | None = None
    """Limits of the pace along the reference of the flight; None if the reference follows the flight time."""

    @classmethod
    def from_preset(
        cls,
        preset: str | Preset,
        reference: str | Reference | None = None,
        *,
        residual_model: ResidualModel | None = None,
    ) -> "Setup":
        """Build a set-up.

        Args:
            preset: Preset of the experiment, or its name.
            reference: Reference of a tracking flight, by name or as an object; by default the training reference. The
                name of a paced reference ends with ``=max``.
            residual_model: Residual model of the learner; by default, the model that the preset names.

        Raises:
            ConfigError: A name does not exist, the task does not track a reference, or values are inconsistent.

        Example::

            setup = retrim.Setup.from_preset("hover/retrim")
            policy = setup.pretrained(seed=0)
        """
        preset = load(preset) if isinstance(preset, str) else preset
        preset, entry = with_delay(preset), find_task(preset.task)
        if reference is not None and not entry.has_reference:
            raise ConfigError(f"reference {reference!r}: a {preset.task} policy follows no reference")
        NETWORKS.find(preset.pretrain.network)
        vehicle = make_vehicle(preset.vehicle)
        table = preset.track or TrackTable()
        limits = pace_limits(preset, vehicle)
        training_reference = make_training_reference(table, limits) if entry.has_reference else None
        if reference is None and (table.gravity_copies or SUFFIX in table.reference):
            reference = table.reference
        paced = isinstance(reference, str) and is_paced(reference)
        try:
            task = make_task(TaskRequest(preset, vehicle, training_reference))
            flight_task = task
            if reference is not None:
                flight_reference = make_reference(reference) if isinstance(reference, str) else reference
                flight_task = make_task(TaskRequest(preset, vehicle, flight_reference))
            nominal = nominal_model(preset, vehicle)
            jumps = jnp.array(preset.jump_cost) if preset.jump_cost else None
            delay, longest = model_path(preset, vehicle).delay, longest_delay(preset)
            env = Env(nominal, task, delay, jump_cost=jumps, family=make_family(preset), longest_delay=longest)
            model = residual_model or make_residual(ResidualRequest(preset, vehicle))
            learning = env if paced else dataclasses.replace(env, task=flight_task)
            learner = make_learner(LearnerRequest(preset, model, learning, paced))
        except (TypeError, ValueError) as error:
            raise (
                error if isinstance(error, ConfigError) else ConfigError(f"preset {preset.name!r}: {error}")
            ) from error
        pace = limits if paced else None
        return cls(preset, vehicle, env, flight_task, learner, pretraining_optimiser(preset.pretrain), pace)

    def on(self, reference: AbstractReference) -> "Setup":
        """Return the same set-up with a different reference for the flight and its learner.

        Args:
            reference: New reference. Programs are compiled again if its array sizes differ from those of the old one.
        """

        def other(part: Any) -> Any:
            return reference if isinstance(part, Reference) else part

        flight_task, learner = (
            jax.tree.map(other, part, is_leaf=lambda part: isinstance(part, Reference))
            for part in (self.flight_task, self.learner)
        )
        return dataclasses.replace(self, flight_task=flight_task, learner=learner)

    @property
    def flight_reference(self) -> Reference | None:
        """Reference of the flight; None if the task has no tabulated reference."""
        flight_reference = getattr(self.flight_task, "reference", None)
        return flight_reference if isinstance(flight_reference, Reference) else None

    def new_policy(self, key: Key[Array, ""]) -> AbstractPolicy:
        """Return an untrained policy; the key is consumed."""
        return make_policy(NetworkRequest(self.preset, self.env.task.observation.size, self.vehicle, key))

    def pretraining(self, seed: int = 0) -> Iterator[tuple[AbstractPolicy, Float[Array, " updates"]]]:
        """Train a policy from scratch.

        Args:
            seed: Seed of the weights and the starts.

        Yields:
            The policy after every few steps and the losses of those steps. If the preset has encoder steps, the
            encoder is trained before the first value is yielded.
        """
        k_init, k_train = random.split(random.key(seed))
        fresh, p = self.new_policy(k_init), self.preset.pretrain
        vision, observation = self.preset.vision, self.env.task.observation
        steps, motions = (0, NEAR) if vision is None else (vision.encoder_steps, MOTIONS[vision.encoder_motions])
        if steps and observation.state_examples(motions) is not None:
            if not isinstance(fresh, Policy):
                raise ConfigError("vision.encoder_steps needs a perceptron, pretrain.network = 'mlp'")
            fresh, _ = pretrain_encoder(fresh, observation, random.split(k_init)[1], motions=motions, steps=steps)
        chunks = pretrain(
            fresh,
            self.env,
            k_train,
            optimiser=self.optimiser,
            num_updates=p.num_updates,
            num_envs=p.num_envs,
            chunk=math.gcd(p.num_updates, 10),
        )
        return ((state.policy.merged(), losses) for state, losses in chunks)

    def pretrained(self, seed: int = 0, *, progress: Progress = show_progress) -> AbstractPolicy:
        """Return a policy trained from scratch.

        Args:
            seed: Seed of the weights and the starts.
            progress: Display of the progress; by default a bar in a notebook or a terminal, and nothing elsewhere.
        """
        steps, last = 0, self.preset.pretrain.num_updates
        with progress(f"pretraining {self.preset.name}") as advance:
            advance(0.0, "compiling")
            for each, losses in self.pretraining(seed):
                policy, steps = each, steps + len(losses)
                advance(steps / last, f"{steps} of {last} steps, loss {float(losses[-1]):.3f}")
        return policy

    def pilot(
        self,
        policy: Any,
        method: str = "base",
        key: Key[Array, ""] | None = None,
        *,
        latency: Latency = "fixed",
        state: LearnerState | None = None,
    ) -> Pilot:
        """Return a pilot for ``policy``.

        Args:
            policy: Policy of this preset, or the network of a method that uses its own network.
            method: Registered name of a method. ``base`` flies the policy unchanged; ``full`` and ``lora`` re-train it
                in flight.
            key: Random key of the learners; consumed. Methods that do not learn need no key.
            latency: Flight time that learning takes.
            state: Learner state of an earlier flight, from which to continue.

        Raises:
            ConfigError: There is no such method, or the method does not suit the task.
            ValueError: The method needs a key.
        """
        from .methods import MethodRequest, find_method  # imported here, because this module is imported there

        pilot = find_method(method).make(MethodRequest(self, policy, key, latency, state))
        if isinstance(pilot, ControllerPilot):
            pilot.controller = self.choose_pace(pilot.controller)
        pilot.dt = pilot.dt or self.preset.dt  # a controller does not store its control period
        return pilot

    def controller(self, state: LearnerState) -> AbstractController[Any]:
        """Return the controller of an adapting policy, with the policy's observation and in the preset's frame.

        In the frame of effective gravity, a monitor reverts learned parameters that make the flight worse.
        """
        residual = FittedResidual(self.learner.residual_model, state.residual)
        policy = state.policy.policy.merged()
        return self.choose_pace(make_adapted_flight(self.preset, self.flight_task, self.vehicle, policy, residual))

    def choose_pace(self, controller: AbstractController[Any]) -> AbstractController[Any]:
        """Return a controller that also chooses the pace of a paced reference; unchanged for any other reference.

        Args:
            controller: Controller with the reference of the flight.
        """
        if self.pace is None or self.flight_reference is None or isinstance(controller, PacedFlight):
            return controller
        return PacedFlight.of(controller, self.flight_reference, self.pace, self.preset.dt)

    def low_rank(self, policy: AbstractPolicy | LoraPolicy, key: Key[Array, ""]) -> LoraPolicy:
        """Return ``policy`` with a fresh low-rank delta (ranks 4, 10 and 1, and scale 4, as in the paper).

        Raises:
            ConfigError: The policy is not a perceptron with three layers, or a layer is too narrow for its rank.
        """
        try:
            return low_rank(policy, key)
        except ValueError as error:  # an error message from a traced function has several lines
            raise ConfigError(f"preset {self.preset.name!r}: {str(error).splitlines()[0]}") from error

    def adaptive_pilot(
        self,
        policy: AbstractPolicy | LoraPolicy,
        key: Key[Array, ""],
        latency: Latency = "fixed",
        state: LearnerState | None = None,
    ) -> AdaptivePilot:
        """Return a pilot that flies and re-trains ``policy``; the key is consumed. See :meth:`pilot`."""
        k_residual, k_learn = random.split(key)
        state = state or self.learner.init(policy, k_residual)
        a, dt, fixed = self.preset.adapt, self.preset.dt, latency == "fixed"
        fitter, trainer = (make_worker(self.learner, layer, state, k_learn) for layer in get_args(Layer))
        fit = LockstepLearner(fitter, a.fit_latency if fixed else None, dt)
        update = LockstepLearner(trainer, a.update_latency if fixed else None, dt)
        learners = ScheduledLearner(fit, a.fit_every), ScheduledLearner(update, a.update_every)
        return AdaptivePilot(self.controller, state, learners, dt=dt, window=a.window)

    def flight_starts(self, n: int, seed: int = 0) -> list[State]:
        """Return ``n`` starts within ±1 m of home and ±18 degrees per axis, with velocities of about 0.1 m/s per axis.

        The starts depend only on the seed and the home, so all presets of a task use the same starts.
        """
        return flight_starts(self.flight_task.home(), n, seed)

    def __repr__(self) -> str:
        """Return the preset, the vehicle, and the task of the flight, in a few lines."""
        v, task = self.vehicle, self.flight_task
        vehicle = f"vehicle: mass {float(v.mass):.3g} kg, largest thrust {float(v.thrust_max):.3g} N"
        flight = f"flight: {task.flight_seconds:g} s, {task.metric} over the last {task.steady_seconds:g} s"
        return "\n  ".join(["Setup", *repr(self.preset).splitlines(), vehicle, flight])

    def limits_exceeded(self, vehicle: Vehicle | None = None) -> str | None:
        """Describe the limits of a vehicle that the flight's reference exceeds; return None if there are none.

        Args:
            vehicle: Vehicle of the flight; by default the training vehicle.
        """
        return None if self.flight_reference is None else self.flight_reference.infeasibility(vehicle or self.vehicle)
