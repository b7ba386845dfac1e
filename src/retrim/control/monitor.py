"""Monitor an adapted policy, and step back if the adapted flight is worse than a flight without adaptation.

An adapted flight has parts that can fail separately: the re-trained policy with the learned residual, and the
disturbance observer. The monitor uses them in stages:

    ADAPTED   the re-trained policy, the learned residual and the observer,
    OBSERVED  the base policy and the observer,
    SLOW      the base policy and a mean of the estimate that is slow enough for late or wrongly scaled measurements,
    BASE      the base policy alone, in the world frame.

The monitor steps back after one of two tests. (1) A *twin*, a simulated vehicle, predicts the flight of the base
policy, in the nominal model with the mean of the estimated disturbance. If the vehicle's error exceeds that of the twin
in three consecutive intervals, or by a large amount in one, the flight steps back by one stage. The flight returns
after a waiting time, which doubles with each step back. If the base policy alone exceeds the twin's error as well, its
parts were not the cause, for example because the state estimate of an autopilot wanders. The flight then uses all of
its parts again, and tolerates this error. (2) An estimate that swings back and forth by itself
(:mod:`retrim.control.swings`) shows that the observer drives the vehicle, because measurements are later than declared
or wrongly scaled. Such a fault persists throughout the flight, so the base policy takes over at once. Later, the base
policy flies with the slow mean. After a second oscillation, it flies alone until the end of the flight.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..physics.actuator_response import ActuatorState
from ..physics.command_path import CommandPath, PathState
from ..physics.path_family import Member
from ..physics.state import STANDARD_GRAVITY, Command, State, where
from ..tasks.task import AbstractTask
from .condition import Cause, Condition, Stage
from .controller import AbstractController, PolicyController
from .gravity_frame import GravityFrame, GravityFrameState, StateDependentResidual
from .near_target import NearTarget
from .policy import AbstractPolicy
from .swings import Swings

INTERVAL = 1.0  # [s], interval over which errors are averaged
MARGIN = 0.03  # [m], limit of the error beyond that of the twin in each of INTERVALS consecutive intervals
SINGLE_MARGIN = 0.7  # [m], limit in a single interval
INTERVALS = 3  # consecutive intervals; a vehicle recovers from the largest kick of the gauntlet within two
STEP_BACK_RATIO = 0.5  # an excess error above this ratio of the one before the step back shows that it was no gain
TOLERANCE = 2.0  # ratio of the next margin to the excess error
LOST = 3.0  # [m]; a twin with a larger error restarts at the vehicle
SWINGS = 8.0  # the largest kick of the gauntlet reaches 6.7; measurements 60 ms late drive the estimate beyond 8
FULL_WEIGHT_SWINGS = 2.0  # swings up to which the estimate has its full weight
RAMP = 0.2  # [s], rise of the weight of the estimate at the start, since a launch with late measurements disturbs it
HOLD = 10.0  # [s], waiting time before the first return
REACH, REACH_RATE = 0.3, 0.1  # [m] and [m/s], largest error for the base policy after an oscillation, and its growth
# [1/s^2] and [m]: without a residual that its observation previews, a policy falls behind by about the residual divided
# by its stiffness, so an adapted flight is worse only beyond this distance.
STIFFNESS, ALLOWANCE = 50.0, 0.4
MEAN_TAU = 1.0  # [s], time constant of the mean of the estimate


class Twin(eqx.Module):
    """A simulated vehicle under the base policy, and the errors of both vehicles."""

    x: State
    memory: Any
    """Memory of the base policy."""
    excess: Float[Array, ""]
    """Sum over the interval of the vehicle's error minus that of the twin [m]."""
    ticks: Int[Array, ""]
    """Number of ticks since the start of the interval."""
    path: PathState | None = None
    """Command path of the simulated vehicle; None if it follows commands immediately."""


class MonitorState(eqx.Module):
    """Memory of the monitor."""

    flight: GravityFrameState
    base: AbstractPolicy
    """Policy at take-off."""
    stage: Int[Array, ""]
    cause: Int[Array, ""]
    """Reason for the last change of stage."""
    best: Int[Array, ""]
    """Best stage to which the flight may return."""
    swings: Swings
    d: Float[Array, "3"]
    """Mean of the estimated disturbance, in the world frame [m/s^2]."""
    twin: Twin
    strikes: Int[Array, ""]
    """Number of consecutive intervals with an error beyond that of the twin."""
    wait: Float[Array, ""]
    """Time until the flight may return to the previous stage [s]."""
    hold: Float[Array, ""]
    """Duration of the next step back [s]."""
    margin: Float[Array, ""]
    """Largest excess error that is tolerated [m]."""
    loss: Float[Array, ""]
    """Excess error because of which the flight left the first stage [m]."""


class Monitor(AbstractController[MonitorState]):
    """Flies an adapted policy in the frame of the effective gravity, and steps back if necessary."""

    frame: GravityFrame
    """The adapted flight; the inner controller is a :class:`~retrim.control.controller.PolicyController`."""
    task: AbstractTask
    """Task, which defines the error."""
    path: CommandPath | None = None
    """Command path of the twin; None if it follows commands immediately."""

    def with_age(self, age: float | Float[Array, ""]) -> "Monitor":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(self, frame=self.frame.with_age(age))

    def with_vehicle(self, member: Member) -> "Monitor":
        """Return the same controller for an identified vehicle."""
        return Monitor(self.frame.with_vehicle(member), self.task, member.path)

    def with_actuators(self, actuators: ActuatorState) -> "Monitor":
        """Return the same controller for a tick in which thrust and body rates are known."""
        return dataclasses.replace(self, frame=self.frame.with_actuators(actuators))

    def init(self, x: State) -> MonitorState:
        """Return the memory at the start of a flight; the present policy becomes the base policy."""
        policy, zero, never = self._inner.policy, jnp.zeros_like(x.p[0]), jnp.array(0)
        twin = Twin(x, self._inner.init(x), zero, never, self._at_hover(x))
        flight, hold = self.frame.init(x), jnp.full_like(zero, HOLD)
        still = jnp.zeros_like(x.p)
        margin = jnp.full_like(zero, MARGIN)
        return MonitorState(
            flight, policy, never, never, never, Swings.none(still), still, twin, never, zero, hold, margin, zero
        )

    def __call__(self, memory: MonitorState, t: Float[Array, ""], x: State) -> tuple[Command, MonitorState]:
        """Return the command for the present stage, and test the stage."""
        is_adapted, observes = memory.stage == Stage.ADAPTED, memory.stage <= Stage.OBSERVED
        slow = memory.stage == Stage.SLOW
        flying = dataclasses.replace(
            self.frame,
            inner=self._limit_distance(where(is_adapted, self._inner.policy, memory.base), self._reach(memory)),
            trust_estimate=observes.astype(x.p.dtype) * self._trust(memory, t),
            trust_residual=is_adapted.astype(x.p.dtype),
            steady=slow.astype(x.p.dtype) * memory.d,
        )
        u, flight = flying(memory.flight, t, x)
        return u, self._judge(dataclasses.replace(memory, flight=flight), t, x)

    def accept(self, memory: MonitorState, u: Command) -> MonitorState:
        """Remember the accepted command."""
        trust = (memory.stage == Stage.ADAPTED).astype(u.c.dtype)
        frame = dataclasses.replace(self.frame, trust_residual=trust)
        return dataclasses.replace(memory, flight=frame.accept(memory.flight, u))

    def condition(self, memory: MonitorState) -> Condition:
        """Return the stage of the next command, and the cause of this stage."""
        return Condition(memory.stage, memory.cause)

    def disturbance(self, memory: MonitorState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the disturbance that the adapted flight expects."""
        return self.frame.disturbance(memory.flight, x, u)

    def _trust(self, memory: MonitorState, t: Float[Array, ""]) -> Float[Array, ""]:
        """Return the weight of the estimate: small at launch, and smaller the more the estimate swings."""
        calm = jnp.clip((SWINGS - memory.swings.size) / (SWINGS - FULL_WEIGHT_SWINGS), 0.0, 1.0)
        return calm * jnp.minimum(1.0, t / RAMP).astype(calm.dtype)

    def _reach(self, memory: MonitorState) -> Float[Array, ""]:
        """Return the largest error in the observation of the policy [m].

        With late measurements, a policy that flies well near its target oscillates under a large error. The limit
        grows, since the policy needs an error to hold against an uncompensated push.
        """
        swung = (memory.cause == Cause.OSCILLATION) & (memory.stage == Stage.BASE)
        return jnp.where(
            swung,
            jnp.minimum(REACH + REACH_RATE * (HOLD - jnp.minimum(memory.wait, HOLD)), self._own_reach),
            self._own_reach,
        )

    @property
    def _own_reach(self) -> Float[Array, ""]:
        """Limit of a flight without an oscillation [m]; infinite if there is none."""
        inner = self.frame.inner
        return inner.reach if isinstance(inner, NearTarget) else jnp.array(jnp.inf)

    def _limit_distance(self, policy: AbstractPolicy, reach: Float[Array, ""]) -> NearTarget:
        return NearTarget(dataclasses.replace(self._inner, policy=policy), self.task, reach)

    @property
    def _inner(self) -> PolicyController:
        inner = self.frame.inner
        policy = inner.inner if isinstance(inner, NearTarget) else inner
        assert isinstance(policy, PolicyController)
        return policy

    def _judge(self, s: MonitorState, t: Float[Array, ""], x: State) -> MonitorState:
        """Return the memory after the tests of this tick."""
        dt, d_hat = self.frame.observer.nominal.dt, s.flight.observer.d_hat
        d = s.d + (dt / MEAN_TAU) * (d_hat - s.d)
        known = self._known_force(s, x)
        # A small part of a large known force, which comes and goes on the path, is not a separate swing.
        swings = s.swings.after(d_hat / (1.0 + known / STANDARD_GRAVITY), dt)
        twin = self._step(s, t, x, jnp.minimum(known / STIFFNESS, ALLOWANCE))
        over = twin.ticks >= round(INTERVAL / dt)
        excess = twin.excess / twin.ticks
        worse = over & (excess > s.margin)
        strikes = jnp.where(over, jnp.where(worse, s.strikes + 1, 0), s.strikes)
        strikes = jnp.where(over & (excess > SINGLE_MARGIN), INTERVALS, strikes)
        fails = (strikes >= INTERVALS) & (s.stage < Stage.BASE)
        swung = swings.size > SWINGS
        wait = jnp.maximum(s.wait - dt, 0.0)
        returns = over & ~worse & ~fails & (wait <= 0.0) & (s.stage > s.best)
        # Never after an oscillation, whose cause lasts throughout the flight.
        shared = (excess > STEP_BACK_RATIO * s.loss) & (excess < 0.5 * SINGLE_MARGIN)
        no_gain = over & (strikes >= INTERVALS) & (s.stage == Stage.BASE) & (s.best == Stage.ADAPTED) & shared
        loss = jnp.where(fails & (s.stage == Stage.ADAPTED), excess, s.loss)
        stage = s.stage + fails.astype(s.stage.dtype) - returns.astype(s.stage.dtype)
        stage = jnp.where(no_gain, Stage.ADAPTED, stage)
        changes_stage = fails | returns | no_gain
        cause = jnp.where(fails, Cause.ERROR, jnp.where(returns, Cause.RECOVERY, s.cause))
        cause = jnp.where(no_gain, Cause.NO_GAIN, cause)
        cause = jnp.where(swung & (s.stage < Stage.BASE), Cause.OSCILLATION, cause)
        best = jnp.where(s.stage < Stage.SLOW, Stage.SLOW, Stage.BASE)
        calm = Swings.none(d_hat)
        return MonitorState(
            flight=s.flight,
            base=s.base,
            stage=jnp.where(swung, Stage.BASE, stage),
            cause=cause,
            best=jnp.where(swung & (s.stage < Stage.BASE), best, s.best),
            swings=where(swung, calm, swings),
            d=d,
            twin=Twin(
                twin.x, twin.memory, jnp.where(over, 0.0, twin.excess), jnp.where(over, 0, twin.ticks), twin.path
            ),
            strikes=jnp.where(changes_stage | swung, 0, strikes),
            wait=jnp.where(changes_stage | swung, s.hold, wait),
            hold=jnp.where(fails, 2.0 * s.hold, s.hold),
            margin=jnp.where(
                no_gain, jnp.minimum(TOLERANCE * jnp.maximum(excess, s.loss), 0.5 * SINGLE_MARGIN), s.margin
            ),
            loss=loss,
        )

    def _step(self, s: MonitorState, t: Float[Array, ""], x: State, allowance: Float[Array, ""]) -> Twin:
        """Return the twin one tick later; the vehicle's error may exceed that of the twin by ``allowance`` [m]."""
        nominal, base = self.frame.observer.nominal, self._limit_distance(s.base, self._own_reach)
        excess = self.task.error(t, x) - self.task.error(t, s.twin.x)
        near = self.task.error(t, s.twin.x) < LOST  # also false for an error that is not a number
        at, memory, path = where(near, (s.twin.x, s.twin.memory, s.twin.path), (x, base.init(x), self._at_hover(x)))
        if path is None or self.path is None:
            u, memory = base(memory, t, at)
            acting = u
        else:
            u, memory = base.with_actuators(path.actuators)(memory, t, at)
            acting, path = self.path(path, u, nominal.dt)
        after = nominal.state(nominal.step(nominal.init(at), acting, s.d))
        excess = s.twin.excess + jnp.where(near, excess - allowance, 0.0)
        return Twin(after, memory, excess, s.twin.ticks + 1, path)

    def _known_force(self, s: MonitorState, x: State) -> Float[Array, ""]:
        """Return the size of the residual that the observation previews [m/s^2]; the twin's world lacks this force."""
        frame, none = self.frame, jnp.zeros_like(x.p[0])
        if frame.known_residual is None or not frame.inner.previews_residual:
            return none
        unsteady = StateDependentResidual(frame.known_residual, jnp.ones_like(none), frame.place)
        force = unsteady(x, s.flight.observer.commands.newest)
        return jnp.where(s.stage == Stage.ADAPTED, jnp.sqrt(jnp.sum(force * force)), none)

    def _at_hover(self, x: State) -> PathState | None:
        if self.path is None:
            return None
        return self.path.init(Command.hover(x.p.dtype), self.frame.observer.nominal.dt)
