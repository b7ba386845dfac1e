"""Flights of an identified vehicle: the inner controller receives the vehicle, thrust and rates."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random
from jaxtyping import Array, Float

from retrim.config import Setup, changed, load
from retrim.config.families import prior_belief
from retrim.control.actuator_tracking import ActuatorTracking
from retrim.control.belief_flight import IdentifiedFlight
from retrim.control.caution import Caution
from retrim.control.controller import AbstractController
from retrim.control.excitation import Excitation
from retrim.control.integral import IntegralAction
from retrim.control.near_target import NearTarget
from retrim.control.vehicle_report import VehicleEstimate, VehicleReport
from retrim.errors import ConfigError
from retrim.estimation.command_path import PathEstimator, ringing_of
from retrim.physics import ActuatorResponse, Command, CommandPath, State, small
from retrim.physics.actuator_response import ActuatorState
from retrim.physics.effects import ExternalEffects
from retrim.physics.path_family import Member, PathBelief, PathFamily
from retrim.physics.second_order import SecondOrderQuadrotor
from retrim.plants.measurement_faults import Late
from retrim.plants.sim import Simulation

pytestmark = pytest.mark.usefixtures("as_a_user")

DT, TICKS = 0.02, 140
family = PathFamily.of  # the dtype follows from the test
SHORT = {"num_updates": 10, "num_envs": 2, "horizon": 20, "hidden_sizes": (16, 16)}


class SlowHover(AbstractController[Command]):
    """A slow hover controller without a policy; its memory contains its last inputs.

    With a size of zero, it commands the hover thrust of its vehicle and no rates.
    """

    size: Float[Array, ""] = dataclasses.field(default_factory=lambda: jnp.array(1.0))
    actuators: ActuatorState = dataclasses.field(default_factory=lambda: ActuatorState.at(Command.hover()))
    member: Member = dataclasses.field(
        default_factory=lambda: Member(family().path(jnp.zeros(4)), PathBelief.unknown())
    )

    def init(self, x):
        return self.actuators, self.member, jnp.zeros_like(x.p[0])

    def __call__(self, memory, t, x):
        wobble = jnp.stack([jnp.sin(7.0 * t), jnp.cos(5.0 * t), jnp.sin(3.0 * t)])
        level = jnp.stack([-x.R[2, 1], x.R[2, 0], 0.0 * t])
        pull = -2.0 * (x.p[2] - 1.0) - 2.0 * x.v[2] + 0.5 * jnp.sin(11.0 * t)
        return Command(9.81 + self.size * pull, self.size * (2.0 * level + wobble)), (self.actuators, self.member, t)

    def with_actuators(self, actuators):
        return dataclasses.replace(self, actuators=actuators)

    def with_vehicle(self, member):
        return dataclasses.replace(self, member=member)


class Lift(eqx.Module):
    """A lift from 1.3 s on; a leaf, so that flights with another one are the same program."""

    size: Float[Array, ""]

    def __call__(self, t, x):
        push = jnp.where(t >= 1.3, self.size, 0.0) * jnp.array([0.0, 0.0, 1.0], x.p.dtype)
        return dataclasses.replace(ExternalEffects.calm(x.p.dtype), push=push.astype(x.p.dtype))


def simulation(delay, lag, *, damping=1.0, gain=1.0, lift=0.0):
    """Return a vehicle that is lifted by ``lift`` [m/s^2] from 1.3 s on."""
    limits = (small().command_min, small().command_max)
    response = ActuatorResponse.of(0.03, lag, inverse_damping=1.0 / damping, thrust_gain=gain)
    model = SecondOrderQuadrotor(response, jnp.array(1.0), jnp.array(0.3), limits, DT)
    return Simulation(model, Lift(jnp.array(lift)), None, random.key(0), jnp.array(delay))


@eqx.filter_jit
def fly(plant, controller, x0, senses):
    """Fly for ``TICKS``; return true states and the memories of the controller after each tick."""
    first = plant.launch(x0)

    def tick(carry, k):
        sim, memory = carry
        now = controller.with_inertial(*plant.inertial(sim, k)) if senses else controller
        u, memory = now(memory, plant.time(k, sim.a.dtype), plant.measure(sim))
        return (plant.advance(sim, plant.within_limits(u), k), memory), (plant.true(sim), memory)

    return lax.scan(tick, (first, controller.init(plant.measure(first))), jnp.arange(TICKS))[1]


@pytest.fixture(scope="module")
def x0(as_a_user):
    return Setup.from_preset("hover/retrim").flight_starts(1, 3)[0]


def identified(plant, x0, *, size=1.0, excites=False, senses=True):
    """Return the memories of the identification after each tick of a flight; the same program flies all vehicles."""
    controller = IdentifiedFlight(
        SlowHover(jnp.array(size)),
        PathEstimator.of(DT),
        family(),
        PathBelief.unknown(),
        excitation=Excitation.of() if excites else Excitation.of(longest=0.0),
    )
    return fly(plant, controller, x0, senses)[1]


@pytest.mark.parametrize(("delay", "lag", "gain"), [(0.0, 0.03, 1.0), (0.05, 0.12, 0.7), (0.03, 0.2, 1.4)])
def test_vehicle_is_identified_in_flight(x0, delay, lag, gain):
    memory = identified(simulation(delay, lag, gain=gain), x0).flight
    last = jax.tree.map(lambda leaf: np.asarray(leaf)[-1], memory)
    true = family().coordinates(jnp.array(delay), jnp.array(lag), ringing_of(jnp.array(1.0)), jnp.array(0.03))
    assert abs(last.belief.centre[0] - true[0]) * 0.05 < 0.01  # [s]
    assert last.belief.half_width[0] < 0.5
    assert abs(float(last.gain) - gain) < 0.1 * gain
    assert np.all(np.asarray(memory.belief.half_width[0]) > 0.9)  # unknown at take-off


@pytest.mark.parametrize("senses", [True, False])
def test_late_states_count_as_delay_of_commands(x0, senses):
    """States that are 60 ms late show the motion of a vehicle with 60 ms more delay, with and without a gyroscope."""
    plant = dataclasses.replace(simulation(0.02, 0.06), fault=Late(3))
    memory = identified(plant, x0, senses=senses)
    delay = family().coordinates(jnp.array(0.08), jnp.array(0.06), ringing_of(jnp.array(1.0)), jnp.array(0.03))[0]
    assert abs(float(memory.flight.belief.centre[-1, 0]) - float(delay)) * 0.05 < 0.005  # [s]
    if not senses:
        return
    estimate, lateness = jax.tree.map(lambda leaf: leaf[-1], (memory.path.estimate, memory.lateness))
    np.testing.assert_allclose(estimate.delay.mean, 0.02, atol=0.005)  # the gyroscope shows that of the vehicle alone
    note = VehicleReport(estimate, None, lateness.value).note()
    assert re.search(r"rate delay (1|2)\d ms, .*; measurements (5|6)\d ms older than declared$", note), note
    # With the time at which states arrive, a vehicle would be ahead of its reference.
    t = np.asarray(memory.flight.inner[2])
    np.testing.assert_allclose(t[60:], DT * np.arange(TICKS)[60:] - 0.06, atol=2e-3)
    assert np.all(np.diff(t) > 0.5 * DT)


def test_excitation_identifies_hovering_vehicle(as_a_user):
    """Without the doublets, delay and lag are not excited."""
    plant, start, at = simulation(0.04, 0.1, gain=1.2), State.at(jnp.array([0.0, 0.0, 1.0])), 50  # 1 s
    still, excited = (identified(plant, start, size=0.0, excites=excites).path.estimate for excites in (False, True))
    assert abs(float(excited.delay.mean[at]) - 0.04) < 0.008
    assert abs(float(excited.rate_lag.mean[at]) - 0.1) < 0.02
    assert abs(float(excited.thrust_gain.mean[at]) - 1.2) < 0.024
    assert not bool(still.delay.excited[at])


@pytest.mark.parametrize("lift", [2.0, -2.0])
def test_push_is_not_identified_as_thrust_gain(x0, lift):
    """The controller reduces its thrust under a lift, as it would with a larger gain."""
    for senses in (True, False):
        gain = identified(simulation(0.02, 0.08, gain=0.8, lift=lift), x0, senses=senses).path.estimate.thrust_gain
        assert np.abs(np.asarray(gain.mean)[60:] - 0.8).max() < 0.04


def test_belief_and_gain_change_continuously(x0):
    memory = identified(simulation(0.08, 0.2, gain=0.6), x0).flight
    low, high = jax.vmap(lambda each: each.ends)(memory.belief)
    for ends in (low, high):
        assert np.abs(np.diff(np.asarray(ends), axis=0)).max() <= 2.0 * DT + 1e-5
    assert np.abs(np.diff(np.asarray(memory.gain))).max() <= 1.0 * DT + 1e-5


@pytest.mark.parametrize("rates_sensed", [True, False])
def test_tracked_rates_equal_rates_of_vehicle(x0, rates_sensed):
    """The rates are exact if the path is known. With a gyroscope, they are exact at once for an unknown path."""
    model = CommandPath.of(0.03, ActuatorResponse.of(0.03, 0.1, inverse_damping=1.0))
    path = model if not rates_sensed else CommandPath.of(0.0, ActuatorResponse.of(0.03, 0.01))
    plant = simulation(0.03, 0.1)

    true, memory = fly(plant, ActuatorTracking(SlowHover(), path, DT), x0, rates_sensed)
    message, _, _ = memory.inner
    R = np.asarray(true.R)
    turn = np.einsum("kji,kjl->kil", R[:-1], R[1:])
    mean = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
    omega = np.asarray(message.command.omega)
    np.testing.assert_allclose(0.5 * (omega[:-1] + omega[1:]), mean / (2.0 * DT), atol=0.06)


@pytest.mark.parametrize("wrap", ["integral", "near", "tracking"])
def test_wrappers_forward_vehicle_to_inner_controller(wrap, x0):
    """Otherwise a wrapper would silently fly a policy for the wrong vehicle."""
    task = Setup.from_preset("hover/retrim").flight_task
    makers = {
        "integral": lambda inner: IntegralAction(inner, task, jnp.array(0.5), jnp.array(1.0)),
        "near": lambda inner: NearTarget(inner, task, jnp.array(1.0)),
        "tracking": lambda inner: ActuatorTracking(inner, family().path(jnp.zeros(4)), DT),
    }
    outer = makers[wrap](SlowHover())
    member = Member(family().path(jnp.ones(4)), PathBelief.between(jnp.ones(4), jnp.ones(4)))
    np.testing.assert_array_equal(outer.with_vehicle(member).inner.member.belief.centre, np.ones(4))
    if wrap != "tracking":  # the wrapper forwards the vehicle
        message = outer.with_actuators(ActuatorState.at(Command(jnp.array(5.0), jnp.ones(3))))
        assert float(message.inner.actuators.command.c) == 5.0


def test_vehicle_file_sets_belief_within_factor_of_two():
    vehicle = {
        "name": "mine", "mass": 0.3, "inertia": [4e-4, 5e-4, 8e-4], "arm": [0.06, 0.07], "thrust_max": 11.0,
        "rates_max": [10.0, 10.0, 4.0], "motor_tau": 0.03, "rate_lag": [0.1, 0.1, 0.2], "command_delay": 0.03,
    }  # fmt: skip
    preset = changed(load("hover/any"), vehicle=vehicle)
    low, high = prior_belief(preset, family()).ends
    for factor in (0.5, 1.0, 2.0):
        at = family().coordinates(
            jnp.array(factor * 0.03), jnp.array(factor * 0.1), jnp.array(0.3), jnp.array(factor * 0.03)
        )
        assert np.all(at >= low - 1e-5)
        assert np.all(at <= high + 1e-5)
    assert float(high[0]) < 0.5  # the file states something
    np.testing.assert_array_equal(prior_belief(load("hover/any"), family()).half_width, np.ones(4))


def test_preset_for_one_vehicle_has_no_identification():
    setup = Setup.from_preset(changed(load("hover/retrim"), pretrain=SHORT))
    with pytest.raises(ConfigError, match="hover/any"):
        setup.pilot(setup.new_policy(random.key(0)), "base-id")


def test_past_commands_must_cover_delays_of_family():
    with pytest.raises(ConfigError, match="5 ticks"):
        changed(load("hover/any"), command_history=4)


def test_observer_and_prediction_follow_vehicle(as_a_user):
    """The observer is as fast as the vehicle, and a change is predicted only for a known vehicle without caution."""
    setup = Setup.from_preset(changed(load("hover/any"), pretrain=SHORT))
    flight = setup.pilot(setup.new_policy(random.key(0)), "base-id").controller
    calm = Caution.none(State.at(jnp.zeros(3)))

    def frame(low, high, level=0.0):
        belief = PathBelief.between(jnp.array(low), jnp.array(high))
        caution = dataclasses.replace(calm, level=jnp.array(level))
        return flight.follow(VehicleEstimate(belief, jnp.array(1.0)))._flying(belief, caution).inner

    fast, middle, slow = [-1.0] * 4, [0.0] * 4, [1.0] * 4  # middle: 50 ms of delay and of lag
    taus = [float(frame(*ends).observer.tau) for ends in ((fast, fast), (slow, slow), (fast, slow), (middle, middle))]
    assert taus == pytest.approx([0.015, 0.05, 0.05, 0.25 * 0.1], rel=1e-3)  # an unknown vehicle may be slow
    assert float(frame(middle, middle).certainty) == pytest.approx(1.0, abs=1e-3)
    assert float(frame(fast, slow).certainty) == 0.0
    assert [float(frame(middle, middle, level).certainty) for level in (0.5, 1.0)] == pytest.approx(
        [0.5, 0.0], abs=1e-3
    )
    np.testing.assert_allclose(frame(middle, middle).horizon[:2], 2.5 * 0.1, rtol=1e-3)
