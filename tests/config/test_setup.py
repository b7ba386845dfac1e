"""From the numbers of a preset to objects: for every preset, every number has its effect."""

import itertools
import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import draw_starts, tiny_preset
from retrim import ConfigError
from retrim.adapt.optimisers import CarriedAdam, FreshAdam
from retrim.adapt.starts import TaskStarts
from retrim.adapt.trim import NoTrim, RestTrim
from retrim.adapt.vehicles import IdentifiedVehicle, OwnVehicle
from retrim.adapt.views import GravityView, RestView, WorldView
from retrim.config import PRESETS, Scenario, Setup, changed, load, setup
from retrim.config.learners import check_frame
from retrim.config.vehicle_file import VehicleSpec
from retrim.config.vehicles import make_vehicle
from retrim.control.actuator_tracking import ActuatorTracking
from retrim.control.belief_flight import IdentifiedFlight
from retrim.control.controller import PolicyController
from retrim.control.gravity_frame import GravityFrame
from retrim.control.lap_learning import LapLearning
from retrim.control.monitor import Monitor
from retrim.control.near_target import NearTarget
from retrim.control.pose_frame import PoseFrame
from retrim.learn import policy_loss
from retrim.physics.actuators import LaggedModel
from retrim.physics.dynamics import PointMass
from retrim.runtime import fly
from retrim.tasks import (
    Hover,
    Keypoints,
    L2Hover,
    L2Track,
    OccludedKeypoints,
    Preview,
    SharpTrack,
    StateAndErrorObs,
    StateObs,
    Track,
)  # fmt: skip
from retrim.tasks.heading_obs import HeadingObs
from retrim.tasks.hover import StiffHover
from retrim.tasks.vehicle_obs import VehicleObs
from retrim.tasks.view import ViewHover

pytestmark = pytest.mark.usefixtures("optax_promotion")
UNCLIPPED = ("hover/paper", "hover/released", "track/paper", "track/blind", "vision/paper")


@pytest.fixture(scope="module", params=PRESETS)
def case(request):
    """Return a preset with a small network, and its setup."""
    preset = changed(load(request.param), pretrain={"hidden_sizes": (12, 12)})
    with jax.numpy_dtype_promotion("standard"):
        return preset, Setup.from_preset(preset)


# ---- the environment


def test_all_parts_have_same_control_tick(case):
    preset, setup = case
    for env in (setup.env, setup.learner.env):
        assert env.dynamics.dt == env.task.dt == preset.dt
    assert setup.flight_task.dt == preset.dt
    assert Scenario().make(dt=preset.dt).dt == preset.dt


def test_model_has_delay_and_lag_of_preset(case):
    preset, setup = case
    delays = {"hover/paper": 0, "track/paper": 0, "track/blind": 0, "hover/released": 2, "hover/100hz": 2}
    assert preset.delay_ticks == delays.get(preset.name, 1)
    for env in (setup.env, setup.learner.env):
        assert float(env.delay) == pytest.approx(preset.delay_ticks * preset.dt)
        if preset.name in ("track/preview", "track/retrim", "track/any", "track/fast", "track/paced", "vision/retrim"):
            assert isinstance(env.dynamics, LaggedModel)
            assert preset.actuator_tau == 0.033
            assert {float(env.dynamics.response.thrust_lag), *env.dynamics.response.rate_lag.tolist()} == {0.033}
            assert isinstance(env.dynamics.base, PointMass)
        else:
            assert preset.actuator_tau is None
            assert isinstance(env.dynamics, PointMass)


def test_task_has_numbers_of_preset(case):
    preset, setup = case
    kinds = {("hover", "paper"): Hover, ("hover", "l2"): L2Hover, ("vision", "paper"): Hover, ("vision", "l2"): L2Hover}
    kinds |= {
        ("hover", "stiff"): StiffHover,
        ("vision", "view"): ViewHover,
        ("track", "paper"): Track,
        ("track", "l2"): L2Track,
        ("track", "sharp"): SharpTrack,
    }
    for task in (setup.env.task, setup.flight_task):
        assert type(task) is kinds[preset.task, preset.reward]
        assert task.horizon == preset.pretrain.horizon
        assert float(task.box) == preset.termination_box
        if preset.task == "track":
            assert float(task.spread) == preset.track.start_spread
        else:
            np.testing.assert_array_equal(task.goal, preset.goal)
            assert float(task.heading) == pytest.approx(preset.pretrain.max_start_yaw)
    sharp = {"hover/retrim", "track/preview", "vision/ideal", "vision/occluded"}
    assert (preset.reward == "l2") == (preset.name in sharp)


def test_observation_has_numbers_of_preset(case):
    preset, setup = case
    observation = setup.env.task.observation
    vehicle = make_vehicle(preset.vehicle)
    if preset.family is not None:
        assert isinstance(observation, VehicleObs)
        observation = observation.inner
    assert isinstance(observation, HeadingObs) == (preset.axes == "heading")
    observation = observation.inner if isinstance(observation, HeadingObs) else observation
    scales = observation.state if isinstance(observation, StateAndErrorObs) else observation
    np.testing.assert_array_equal(scales.omega_max, vehicle.omega_max)
    if preset.task == "vision":
        assert isinstance(observation, Keypoints)
        assert float(observation.noise) == preset.vision.pixel_noise
        assert bool(jnp.all(observation.whiten == jnp.eye(70))) == (not preset.vision.whiten_pixels)
        assert observation.dt == preset.dt
    else:
        kind = preset.track.observation if preset.task == "track" else "state"
        kinds = {"both": StateAndErrorObs, "preview": Preview, "flat": Preview}
        assert type(observation) is kinds.get(kind, StateObs)
        if isinstance(observation, Preview):
            assert observation.accelerations == ((0.04,) if kind == "flat" else ())
        assert scales.history == preset.command_history


def test_occlusion_acts_in_flight_only(case):
    preset, setup = case
    flight = setup.flight_task.observation_in_flight
    if preset.name in ("vision/occluded", "vision/retrim"):
        assert isinstance(flight, OccludedKeypoints)
        assert float(flight.dropout) == preset.vision.dropout == 0.05
        assert float(flight.full.noise) == preset.vision.pixel_noise == 1.0
        assert (flight.lag is None) == (preset.actuator_tau is None)
        assert flight.delay_ticks == preset.plant_delay_ticks
        np.testing.assert_array_equal(flight.full.whiten, setup.env.task.observation.whiten)
        assert isinstance(setup.learner.env.task.observation, Keypoints)  # no occlusion in updates
    else:
        assert flight is setup.flight_task.observation


def test_policy_has_layers_of_preset_and_limits_of_vehicle(case):
    preset, setup = case
    policy = setup.new_policy(random.key(0))
    sizes = (setup.env.task.observation.size, *preset.pretrain.hidden_sizes, 4)
    assert [layer.weight.shape for layer in policy.layers] == [(b, a) for a, b in itertools.pairwise(sizes)]
    vehicle = make_vehicle(preset.vehicle)
    np.testing.assert_array_equal(policy.u_max.vector(), vehicle.command_max.vector())
    np.testing.assert_array_equal(policy.u_min.vector(), vehicle.command_min.vector())


# ---- the learner


def test_learner_has_numbers_of_preset(case):
    preset, setup = case
    a, learner = preset.adapt, setup.learner
    if preset.family is None:
        assert learner.plant_delay_ticks == preset.plant_delay_ticks
        assert isinstance(learner.vehicles, OwnVehicle)
    else:  # the identified path contains the delay
        assert learner.plant_delay_ticks == 0
        assert isinstance(learner.vehicles, IdentifiedVehicle)
        assert learner.vehicles.family is setup.env.family
    assert learner.num_updates == a.num_updates
    assert learner.num_envs == a.num_envs
    assert float(learner.optimiser.rate) == a.learning_rate
    assert float(learner.optimiser.max_grad_norm) == (math.inf if a.max_grad_norm is None else a.max_grad_norm)
    assert (a.max_grad_norm is None) == (preset.name in UNCLIPPED)
    assert isinstance(learner.optimiser, CarriedAdam if a.optimiser == "carried" else FreshAdam)
    if a.task_starts is None:
        assert isinstance(learner.starts, TaskStarts)
    else:
        assert (learner.starts.from_task, float(learner.starts.spread)) == (a.task_starts, a.start_noise)
    if a.frame == "gravity":
        assert isinstance(learner.view, RestView if preset.task == "vision" else GravityView)
    else:
        assert isinstance(learner.view, WorldView)
    assert learner.env.task is setup.flight_task
    assert isinstance(learner.trim, RestTrim if a.trim == "rest" else NoTrim)
    model = learner.residual_model
    if a.residual != "ensemble":
        linear_model = model.first if a.residual == "layered" else model
        assert (float(linear_model.memory), linear_model.dt, linear_model.rates.dt) == (a.memory, preset.dt, preset.dt)
        assert float(linear_model.prior[3]) == pytest.approx(a.thrust_prior)
        if a.residual == "regression":
            return
        model = model.second
    np.testing.assert_array_equal(model.origin, preset.goal)
    np.testing.assert_array_equal(model.omega_max, setup.vehicle.omega_max)
    assert float(model.learning_rate) == a.fit_learning_rate == 1e-2
    assert float(model.spectral_weight) == a.spectral_weight == 1e-3
    assert model.steps == a.fit_steps


@pytest.mark.parametrize("latency", ["fixed", "measured"])
def test_pilot_has_schedule_of_preset(case, latency, monkeypatch):
    preset, result = case
    a, learners, pilots = preset.adapt, [], []

    class Learner(setup.LockstepLearner):
        def __init__(self, worker, latency_s, dt):
            learners.append((worker.layer, latency_s, dt))
            super().__init__(worker, latency_s, dt)

    class Pilot(setup.AdaptivePilot):
        def __init__(self, controller, state, schedule, *, dt, window):
            pilots.append((controller, [each.every_s for each in schedule], dt, window))
            super().__init__(controller, state, schedule, dt=dt, window=window)

    monkeypatch.setattr(setup, "LockstepLearner", Learner)
    monkeypatch.setattr(setup, "AdaptivePilot", Pilot)
    result.pilot(result.new_policy(random.key(0)), "full", random.key(1), latency=latency)
    fixed = latency == "fixed"
    assert learners == [
        ("residual", a.fit_latency if fixed else None, preset.dt),
        ("policy", a.update_latency if fixed else None, preset.dt),
    ]
    ((controller, *numbers),) = pilots
    assert numbers == [[a.fit_every, a.update_every], preset.dt, a.window]
    flight = controller(result.learner.init(result.new_policy(random.key(0)), random.key(2)))
    if a.lap_learning:
        assert isinstance(flight, LapLearning)
        flight = flight.inner
    if preset.family is not None:
        assert isinstance(flight, IdentifiedFlight)
        assert isinstance(flight.inner, ActuatorTracking)
        flight = flight.inner.inner
    if a.frame == "gravity" and preset.task == "vision":
        assert isinstance(flight, PoseFrame)
        flight = flight.inner
    elif a.frame == "gravity":
        assert isinstance(flight, Monitor)
        flight = flight.frame
        assert isinstance(flight, GravityFrame)
        unknown = 0.5 * sum((0.0, 0.0) if preset.family is None else preset.family.delay)
        declaration = preset.plant_delay_ticks * preset.dt
        assert float(flight.observer.path.delay) == pytest.approx(declaration if preset.family is None else unknown)
        assert eqx.tree_equal(flight.known_residual.model, result.learner.residual_model)
        flight = flight.inner
    if a.frame == "gravity" and preset.task != "vision":
        assert isinstance(flight, NearTarget)
        assert float(flight.reach) == pytest.approx(1.0 if preset.family is None else 0.5)
        flight = flight.inner
    assert isinstance(flight, PolicyController)
    if a.lap_learning:  # on the reference that the laps shift
        own = flight.observation.reference.reference
        assert eqx.tree_equal(own, result.flight_reference)
    elif preset.family is None:
        assert flight.observation is result.flight_task.observation_in_flight
    else:  # with the belief about the vehicle
        assert flight.observation.inner is result.flight_task.observation.inner


def test_methods(case):
    _, setup = case
    policy = setup.new_policy(random.key(0))
    with pytest.raises(ValueError, match="needs a key"):
        setup.pilot(policy, "full")
    full, low_rank = (setup.pilot(policy, method, random.key(1)) for method in ("full", "lora"))
    jax.tree.map(np.testing.assert_array_equal, full.state.policy.policy, policy)
    delta = low_rank.state.policy.policy
    jax.tree.map(np.testing.assert_array_equal, delta.base, policy)
    assert [thin.down.shape[0] for thin in delta.delta] == [4, 10, 1]
    assert float(delta.scale) == 4.0
    jax.tree.map(np.testing.assert_array_equal, delta.merged(), policy)


# ---- the optimiser of pretraining


@partial(jax.jit, static_argnums=0)
def steps_under(optimiser, rows):
    def step(memory, gradient):
        change, memory = optimiser.update(gradient, memory, jnp.zeros(4))
        return memory, change[0]

    return jax.lax.scan(step, optimiser.init(jnp.zeros(4)), rows)[1]


def optimiser_steps(optimiser, gradients):
    """Return the steps that the optimiser takes along a parameter under these gradients."""
    return np.asarray(steps_under(optimiser, np.tile(np.array(gradients)[:, None], 4)))


def test_pretraining_rate_follows_cosine(case):
    preset, setup = case
    p = preset.pretrain
    steps = -optimiser_steps(setup.optimiser, np.full(p.num_updates, 0.1))
    expected = 0.5 * p.learning_rate * (1.0 + np.cos(np.pi * np.arange(p.num_updates) / p.num_updates))
    np.testing.assert_allclose(steps, expected, rtol=1e-4)


def test_pretraining_clips_gradient_if_preset_has_limit(case):
    """Four entries of 0.5 have the norm 1; with this limit, a larger gradient moves the parameter no farther."""
    preset, setup = case
    limit = preset.pretrain.max_grad_norm
    assert limit in (None, 1.0)
    assert (limit is None) == (preset.name in UNCLIPPED)
    at_limit, beyond = (optimiser_steps(setup.optimiser, [0.01, 0.01, huge])[-1] for huge in (0.5, 5.0))
    assert (at_limit == pytest.approx(beyond)) == (limit is not None)


def test_pretraining_has_second_decay_of_preset(case):
    """After a large gradient and a zero gradient, the second moment of Adam shows its decay."""
    preset, setup = case
    b1, b2, rate = 0.9, preset.pretrain.adam_b2, preset.pretrain.learning_rate
    change = optimiser_steps(setup.optimiser, [0.4, 0.0, 0.0])[1]
    m, v = b1 * (1 - b1) * 0.4 / (1 - b1**2), b2 * (1 - b2) * 0.16 / (1 - b2**2)
    cosine = 0.5 * (1 + math.cos(math.pi / preset.pretrain.num_updates))
    assert float(change) == pytest.approx(-rate * cosine * m / (math.sqrt(v) + 1e-8), rel=1e-6)


# ---- wrong arguments


def test_inconsistent_arguments_give_one_line():
    for wrong in (
        changed(load("vision/ideal"), dt=0.008),  # a camera frame is not a whole number of ticks
        changed(load("vision/occluded"), plant_delay_ticks=9),
    ):
        with pytest.raises(ConfigError, match=r"preset 'vision/(ideal|occluded)': ") as error:
            Setup.from_preset(wrong)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("hidden", "message"), [((16, 16, 16), "3 ranks .* for 4 layers"), ((8, 16), "rank 10 for weights 16 x 8")]
)
def test_unsuitable_network_for_low_rank_is_refused(hidden, message):
    setup = Setup.from_preset(tiny_preset(pretrain={"hidden_sizes": hidden}))
    with pytest.raises(ConfigError, match=f"preset 'hover/fast': LoRA: {message}") as error:
        setup.pilot(setup.new_policy(random.key(0)), "lora", random.key(1))
    assert "\n" not in str(error.value)


# ---- starts


def test_flight_starts_depend_on_seed_and_home_only():
    one, other = (
        Setup.from_preset(tiny_preset()),
        Setup.from_preset(changed(load("hover/released"), pretrain={"hidden_sizes": (8,)})),
    )
    for a, b in zip(one.flight_starts(3, seed=5), other.flight_starts(3, seed=5), strict=True):
        np.testing.assert_array_equal(a.vector(), b.vector())
    starts = one.flight_starts(40)
    assert not np.array_equal(starts[0].p, one.flight_starts(1, seed=1)[0].p)
    p = np.stack([x.p for x in starts])
    assert np.all(np.abs(p - one.preset.goal) <= 1.0)
    assert np.all(p.std(axis=0) > 0.4)
    assert 0.05 < np.stack([x.v for x in starts]).std() < 0.2


def test_gravity_frame_is_refused_for_unsuitable_tasks():
    """Examples: a moving goal, and keypoints without occlusion, which have no filter that estimates the disturbance."""

    class Moving(Hover):
        def target(self, t):
            return self.goal + t

    fixed = Setup.from_preset(tiny_preset())
    f = fixed.flight_task
    check_frame(fixed.preset, f)
    with pytest.raises(ConfigError, match="Moving overrides target"):
        check_frame(fixed.preset, Moving(f.goal, f.observation, f.box, f.heading, f.dt, f.horizon))
    with pytest.raises(ConfigError, match=r"'vision/ideal': the frame of effective gravity needs .* occlusion = true"):
        Setup.from_preset(changed(load("vision/ideal"), adapt={"frame": "gravity"}))
    seeing = Setup.from_preset("vision/retrim")
    assert isinstance(seeing.learner.view, RestView)
    assert isinstance(seeing.pilot(seeing.new_policy(random.key(0)), "base-do").controller, PoseFrame)


def test_training_references_are_tilted_and_scaled():
    """Each member is a built-in reference, level or tilted and scaled; flights use the plain reference."""
    setup = Setup.from_preset(changed(load("track/retrim"), track={"reference": "circle+star", "gravity_copies": 2}))
    training_reference, flight = setup.env.task.reference, setup.flight_task.reference
    assert training_reference.joins.shape[0] == 2 * (1 + 2)
    assert flight.joins.shape[0] == 2
    starts = training_reference.joins[:, 0]
    p = jax.vmap(jax.vmap(training_reference, (0,)))(starts[:, None] + jnp.linspace(3.0, 12.0, 200)[None]).p
    height = np.ptp(np.asarray(p)[:, :, 2], axis=1)
    assert (height[:2] < 1e-4).all()
    assert (height[2:] > 0.01).all()
    width = np.linalg.norm(np.ptp(np.asarray(p), axis=1), axis=1)
    assert len(set(np.round(width[[0, 2, 3]], 2))) == 3


# ---- at 100 Hz


def test_train_fly_and_adapt_at_100_hz():
    preset = changed(
        load("hover/100hz"),
        pretrain={"hidden_sizes": (32, 32), "num_updates": 150, "num_envs": 8, "horizon": 120},
        adapt={"fit_steps": 20, "num_updates": 3, "num_envs": 4, "window": 60}
        | {"fit_every": 0.5, "update_every": 0.8, "fit_latency": 0.1, "update_latency": 0.25},
    )
    setup = Setup.from_preset(preset)
    chunks = list(setup.pretraining(1))
    assert sum(losses.shape[0] for _, losses in chunks) == 150
    policy = chunks[-1][0]
    x0 = draw_starts(setup.env.task, random.key(7), 16)
    fresh, trained_loss = (policy_loss(p, setup.env, x0) for p in (setup.new_policy(random.key(1)), policy))
    assert float(trained_loss) < 0.7 * float(fresh)
    plant = Scenario("small", "simple").make(preset.vehicle, dt=preset.dt)
    assert plant.dt == 0.01
    pilot = setup.pilot(policy, "full", random.key(3))
    log = fly(plant, pilot, setup.flight_starts(1)[0], ticks=130)
    assert len(log.t) == 131
    np.testing.assert_allclose(np.diff(log.t), 0.01)
    assert log.missed_ticks == 0
    assert log.events[0].kind == "residual"
    np.testing.assert_allclose([e.t for e in log.events if e.kind == "residual"], [0.6, 1.1])
    np.testing.assert_allclose([e.t for e in log.events if e.kind in ("policy", "rejected")], [1.05])
    before, after = np.linalg.norm(log.p[[0, -1]] - np.array(preset.goal), axis=1)
    assert after < 0.7 * before


def test_model_has_known_lag_of_vehicle():
    spec = VehicleSpec("made_up", 1.0, (0.02, 0.02, 0.03), (0.2, 0.2), 20.0, (4.0, 4.0, 3.0), 0.05, (0.07, 0.08, 0.4))
    for name in ("hover/retrim", "track/retrim"):
        setup = Setup.from_preset(changed(load(name), vehicle=spec))
        response = setup.env.dynamics.response
        np.testing.assert_allclose([response.thrust_lag, *response.rate_lag], [0.05, 0.07, 0.08, 0.4])
        prior = setup.learner.residual_model.init(jax.random.key(0))
        rates = prior.rates if name == "hover/retrim" else prior.first.rates
        np.testing.assert_allclose(rates.tau, [0.07, 0.08, 0.4])


@pytest.mark.parametrize(("delay", "ticks"), [(0.041, 2), (0.0, 0), (None, 1)])
def test_model_has_known_delay_of_vehicle(delay, ticks):
    body = ("made_up", 1.0, (0.02, 0.02, 0.03), (0.2, 0.2), 20.0, (4.0, 4.0, 3.0), 0.05)
    setup = Setup.from_preset(changed(load("hover/retrim"), vehicle=VehicleSpec(*body, command_delay=delay)))
    assert setup.learner.plant_delay_ticks == setup.preset.plant_delay_ticks == ticks
    exact = 0.02 if delay is None else delay  # both the model, and the observer in flight
    observer = setup.controller(setup.learner.init(setup.new_policy(random.key(0)), random.key(2))).frame.observer
    assert [float(setup.env.delay), float(observer.path.delay)] == pytest.approx([exact, exact])
    assert Setup.from_preset(setup.preset).preset == setup.preset


def test_excessive_delay_is_refused_with_reason():
    body = ("made_up", 1.0, (0.02, 0.02, 0.03), (0.2, 0.2), 20.0, (4.0, 4.0, 3.0), 0.05)
    preset = changed(load("hover/retrim"), dt=0.005, vehicle=VehicleSpec(*body, command_delay=0.15))
    with pytest.raises(ConfigError, match=r"'made_up': command_delay = 0.15 s is 30 ticks of dt = 0.005 s") as error:
        Setup.from_preset(preset)
    assert "\n" not in str(error.value)
