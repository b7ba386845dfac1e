"""From a preset's numbers to objects: every number arrives where it acts, for every preset."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import draw_starts, tiny_preset
from retrim import ConfigError
from retrim.adapt.optimisers import CarriedAdam, FreshAdam
from retrim.adapt.starts import TaskStarts
from retrim.adapt.trim import RestTrim, Untrimmed
from retrim.adapt.vehicles import IdentifiedVehicle, OwnVehicle
from retrim.adapt.views import GravityView, RestView, WorldView
from retrim.config import PRESETS, Scenario, Setup, changed, load, setup
from retrim.config.learners import check_frame
from retrim.config.vehicle_file import VehicleSpec
from retrim.config.vehicles import make_vehicle
from retrim.control.actuator_tracking import ActuatorTracking
from retrim.control.controller import PolicyController
from retrim.control.gravity_frame import GravityFrame, PoseFrame
from retrim.control.identified import IdentifiedFlight
from retrim.control.monitor import Monitor
from retrim.control.near_target import NearTarget
from retrim.learn import policy_loss
from retrim.physics.actuators import Lagged
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
def built(request):
    """A preset, with a small network, and its set-up."""
    preset = changed(load(request.param), pretrain={"hidden_sizes": (12, 12)})
    with jax.numpy_dtype_promotion("standard"):
        return preset, Setup.from_preset(preset)


# ---- the environment


def test_every_clock_ticks_alike(built):
    preset, made = built
    for env in (made.env, made.learner.env):
        assert env.dynamics.dt == env.task.dt == preset.dt
    assert made.flight_task.dt == preset.dt
    assert Scenario().make(dt=preset.dt).dt == preset.dt


def test_the_model_has_the_presets_delay_and_lag(built):
    preset, made = built
    delays = {"hover/paper": 0, "track/paper": 0, "track/blind": 0, "hover/released": 2, "hover/100hz": 2}
    assert preset.delay_ticks == delays.get(preset.name, 1)
    for env in (made.env, made.learner.env):
        assert float(env.delay) == pytest.approx(preset.delay_ticks * preset.dt)
        if preset.name in ("track/preview", "track/retrim", "track/any", "track/fast", "vision/retrim"):
            assert isinstance(env.dynamics, Lagged)
            assert preset.actuator_tau == 0.033
            assert {float(env.dynamics.response.thrust_lag), *env.dynamics.response.rate_lag.tolist()} == {0.033}
            assert isinstance(env.dynamics.base, PointMass)
        else:
            assert preset.actuator_tau is None
            assert isinstance(env.dynamics, PointMass)


def test_the_task_has_the_presets_numbers(built):
    preset, made = built
    kinds = {("hover", "paper"): Hover, ("hover", "l2"): L2Hover, ("vision", "paper"): Hover, ("vision", "l2"): L2Hover}
    kinds |= {
        ("hover", "stiff"): StiffHover,
        ("vision", "view"): ViewHover,
        ("track", "paper"): Track,
        ("track", "l2"): L2Track,
        ("track", "sharp"): SharpTrack,
    }
    for task in (made.env.task, made.flight_task):
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


def test_the_observation_has_the_presets_numbers(built):
    preset, made = built
    seen = made.env.task.observation
    vehicle = make_vehicle(preset.vehicle)
    if preset.family is not None:
        assert isinstance(seen, VehicleObs)
        seen = seen.inner
    assert isinstance(seen, HeadingObs) == (preset.axes == "heading")
    seen = seen.inner if isinstance(seen, HeadingObs) else seen
    scales = seen.state if isinstance(seen, StateAndErrorObs) else seen
    np.testing.assert_array_equal(scales.omega_max, vehicle.omega_max)
    if preset.task == "vision":
        assert isinstance(seen, Keypoints)
        assert float(seen.noise) == preset.vision.pixel_noise
        assert bool(jnp.all(seen.whiten == jnp.eye(70))) == (not preset.vision.whiten_pixels)
        assert seen.dt == preset.dt
    else:
        kind = preset.track.observation if preset.task == "track" else "state"
        kinds = {"both": StateAndErrorObs, "preview": Preview, "flat": Preview}
        assert type(seen) is kinds.get(kind, StateObs)
        if isinstance(seen, Preview):
            assert seen.accelerations == ((0.04,) if kind == "flat" else ())
        assert scales.history == preset.command_history


def test_occlusion_is_switched_on_in_flight_alone(built):
    preset, made = built
    flown = made.flight_task.observation_in_flight
    if preset.name in ("vision/occluded", "vision/retrim"):
        assert isinstance(flown, OccludedKeypoints)
        assert float(flown.dropout) == preset.vision.dropout == 0.05
        assert float(flown.full.noise) == preset.vision.pixel_noise == 1.0
        assert (flown.lag is None) == (preset.actuator_tau is None)
        assert flown.delay_ticks == preset.plant_delay_ticks
        np.testing.assert_array_equal(flown.full.whiten, made.env.task.observation.whiten)
        assert isinstance(made.learner.env.task.observation, Keypoints)  # nor in updates
    else:
        assert flown is made.flight_task.observation


def test_a_policy_has_the_presets_layers_and_the_vehicles_limits(built):
    preset, made = built
    policy = made.new_policy(random.key(0))
    sizes = (made.env.task.observation.size, *preset.pretrain.hidden_sizes, 4)
    assert [layer.weight.shape for layer in policy.layers] == [(b, a) for a, b in itertools.pairwise(sizes)]
    vehicle = make_vehicle(preset.vehicle)
    np.testing.assert_array_equal(policy.u_max.vector(), vehicle.command_max.vector())
    np.testing.assert_array_equal(policy.u_min.vector(), vehicle.command_min.vector())


# ---- the learner


def test_the_learner_has_the_presets_numbers(built):
    preset, made = built
    a, learner = preset.adapt, made.learner
    if preset.family is None:
        assert learner.plant_delay_ticks == preset.plant_delay_ticks
        assert isinstance(learner.vehicles, OwnVehicle)
    else:  # the identified path has the delay
        assert learner.plant_delay_ticks == 0
        assert isinstance(learner.vehicles, IdentifiedVehicle)
        assert learner.vehicles.family is made.env.family
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
    assert learner.env.task is made.flight_task
    assert isinstance(learner.trim, RestTrim if a.trim == "rest" else Untrimmed)
    model = learner.residual_model
    if a.residual != "ensemble":
        closed = model.first if a.residual == "layered" else model
        assert (float(closed.memory), closed.dt, closed.rates.dt) == (a.memory, preset.dt, preset.dt)
        assert float(closed.prior[3]) == pytest.approx(a.thrust_prior)
        if a.residual == "regression":
            return
        model = model.second
    np.testing.assert_array_equal(model.origin, preset.goal)
    np.testing.assert_array_equal(model.omega_max, made.vehicle.omega_max)
    assert float(model.learning_rate) == a.fit_learning_rate == 1e-2
    assert float(model.spectral_weight) == a.spectral_weight == 1e-3
    assert model.steps == a.fit_steps


@pytest.mark.parametrize("latency", ["fixed", "measured"])
def test_the_pilot_has_the_presets_schedule(built, latency, monkeypatch):
    preset, made = built
    a, learners, pilots = preset.adapt, [], []

    class Learner(setup.LockstepLearner):
        def __init__(self, worker, latency_s, dt):
            learners.append((worker.layer, latency_s, dt))
            super().__init__(worker, latency_s, dt)

    class Pilot(setup.AdaptivePilot):
        def __init__(self, controller, state, scheduled, *, dt, window):
            pilots.append((controller, [each.every_s for each in scheduled], dt, window))
            super().__init__(controller, state, scheduled, dt=dt, window=window)

    monkeypatch.setattr(setup, "LockstepLearner", Learner)
    monkeypatch.setattr(setup, "AdaptivePilot", Pilot)
    made.pilot(made.new_policy(random.key(0)), "full", random.key(1), latency=latency)
    fixed = latency == "fixed"
    assert learners == [
        ("residual", a.fit_latency if fixed else None, preset.dt),
        ("policy", a.update_latency if fixed else None, preset.dt),
    ]
    ((controller, *numbers),) = pilots
    assert numbers == [[a.fit_every, a.update_every], preset.dt, a.window]
    flown = controller(made.learner.init(made.new_policy(random.key(0)), random.key(2)))
    if preset.family is not None:
        assert isinstance(flown, IdentifiedFlight)
        assert isinstance(flown.inner, ActuatorTracking)
        flown = flown.inner.inner
    if a.frame == "gravity" and preset.task == "vision":
        assert isinstance(flown, PoseFrame)
        flown = flown.inner
    elif a.frame == "gravity":
        assert isinstance(flown, Monitor)
        flown = flown.frame
        assert isinstance(flown, GravityFrame)
        unknown = 0.5 * sum((0.0, 0.0) if preset.family is None else preset.family.delay)
        declared = preset.plant_delay_ticks * preset.dt
        assert float(flown.observer.path.delay) == pytest.approx(declared if preset.family is None else unknown)
        assert flown.known.model is made.learner.residual_model
        flown = flown.inner
    if preset.family is not None and preset.task == "hover":
        assert isinstance(flown, NearTarget)
        assert float(flown.reach) == pytest.approx(0.5)
        flown = flown.inner
    assert isinstance(flown, PolicyController)
    if preset.family is None:
        assert flown.observation is made.flight_task.observation_in_flight
    else:  # with the belief about the vehicle
        assert flown.observation.inner is made.flight_task.observation.inner


def test_methods(built):
    _, made = built
    policy = made.new_policy(random.key(0))
    with pytest.raises(ValueError, match="needs a key"):
        made.pilot(policy, "full")
    full, low_rank = (made.pilot(policy, method, random.key(1)) for method in ("full", "lora"))
    jax.tree.map(np.testing.assert_array_equal, full.state.policy.policy, policy)
    delta = low_rank.state.policy.policy
    jax.tree.map(np.testing.assert_array_equal, delta.base, policy)
    assert [thin.down.shape[0] for thin in delta.delta] == [4, 10, 1]
    assert float(delta.scale) == 4.0
    jax.tree.map(np.testing.assert_array_equal, delta.merged(), policy)


# ---- the optimiser of pretraining


def moves(optimiser, gradients):
    """What the optimiser does to a parameter under these gradients."""

    def step(memory, gradient):
        change, memory = optimiser.update(gradient, memory, jnp.zeros(4))
        return memory, change[0]

    rows = np.tile(np.array(gradients)[:, None], 4)
    return np.asarray(jax.jit(lambda rows: jax.lax.scan(step, optimiser.init(jnp.zeros(4)), rows)[1])(rows))


def test_pretraining_falls_along_a_cosine(built):
    preset, made = built
    p = preset.pretrain
    steps = -moves(made.optimiser, np.full(p.num_updates, 0.1))
    wanted = 0.5 * p.learning_rate * (1.0 + np.cos(np.pi * np.arange(p.num_updates) / p.num_updates))
    np.testing.assert_allclose(steps, wanted, rtol=1e-4)


def test_pretraining_clips_if_the_preset_says_so(built):
    """Four entries of 0.5 have the norm 1: a larger gradient moves the parameter no farther where that is the limit."""
    preset, made = built
    limit = preset.pretrain.max_grad_norm
    assert limit in (None, 1.0)
    assert (limit is None) == (preset.name in UNCLIPPED)
    at_limit, beyond = (moves(made.optimiser, [0.01, 0.01, huge])[-1] for huge in (0.5, 5.0))
    assert (at_limit == pytest.approx(beyond)) == (limit is not None)


def test_pretraining_has_the_presets_second_decay(built):
    """After a large gradient and a zero one, Adam's second moment tells its decay."""
    preset, made = built
    b1, b2, rate = 0.9, preset.pretrain.adam_b2, preset.pretrain.learning_rate
    moved = moves(made.optimiser, [0.4, 0.0])[1]
    m, v = b1 * (1 - b1) * 0.4 / (1 - b1**2), b2 * (1 - b2) * 0.16 / (1 - b2**2)
    cosine = 0.5 * (1 + math.cos(math.pi / preset.pretrain.num_updates))
    assert float(moved) == pytest.approx(-rate * cosine * m / (math.sqrt(v) + 1e-8), rel=1e-6)


# ---- what a caller may get wrong


def test_what_does_not_fit_is_one_line():
    for wrong in (
        changed(load("vision/ideal"), dt=0.008),  # a frame is no whole number of ticks
        changed(load("vision/occluded"), plant_delay_ticks=9),
    ):
        with pytest.raises(ConfigError, match=r"preset 'vision/(ideal|occluded)': ") as error:
            Setup.from_preset(wrong)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("hidden", "message"), [((16, 16, 16), "3 ranks .* for 4 layers"), ((8, 16), "rank 10 for weights 16 x 8")]
)
def test_a_network_that_low_rank_cannot_take(hidden, message):
    made = Setup.from_preset(tiny_preset(pretrain={"hidden_sizes": hidden}))
    with pytest.raises(ConfigError, match=f"preset 'hover/fast': LoRA: {message}") as error:
        made.pilot(made.new_policy(random.key(0)), "lora", random.key(1))
    assert "\n" not in str(error.value)


# ---- starts


def test_flight_starts_follow_from_seed_and_home_alone():
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


def test_a_frame_is_refused_for_what_cannot_be_turned():
    """A goal that moves; and keypoints without occlusion, for there is no filter that feels."""

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


def test_training_follows_references_as_they_are_felt():
    """Every member of the family is a built-in reference, level or tilted and scaled; flight follows the plain one."""
    made = Setup.from_preset(changed(load("track/retrim"), track={"reference": "circle+star", "gravity_copies": 2}))
    trained, flown = made.env.task.reference, made.flight_task.reference
    assert trained.joins.shape[0] == 2 * (1 + 2)
    assert flown.joins.shape[0] == 2
    starts = trained.joins[:, 0]
    p = jax.vmap(jax.vmap(trained, (0,)))(starts[:, None] + jnp.linspace(3.0, 12.0, 200)[None]).p
    height = np.ptp(np.asarray(p)[:, :, 2], axis=1)
    assert (height[:2] < 1e-4).all()
    assert (height[2:] > 0.01).all()
    width = np.linalg.norm(np.ptp(np.asarray(p), axis=1), axis=1)
    assert len(set(np.round(width[[0, 2, 3]], 2))) == 3


# ---- at 100 Hz


def test_a_hundred_hertz_trains_flies_and_adapts():
    preset = changed(
        load("hover/100hz"),
        pretrain={"hidden_sizes": (32, 32), "num_updates": 150, "num_envs": 8, "horizon": 120},
        adapt={"fit_steps": 20, "num_updates": 3, "num_envs": 4, "window": 60}
        | {"fit_every": 0.5, "update_every": 0.8, "fit_latency": 0.1, "update_latency": 0.25},
    )
    made = Setup.from_preset(preset)
    chunks = list(made.pretraining(1))
    assert sum(losses.shape[0] for _, losses in chunks) == 150
    policy = chunks[-1][0]
    x0 = draw_starts(made.env.task, random.key(7), 16)
    fresh, trained = (policy_loss(p, made.env, x0) for p in (made.new_policy(random.key(1)), policy))
    assert float(trained) < 0.7 * float(fresh)
    plant = Scenario("small", "simple").make(preset.vehicle, dt=preset.dt)
    assert plant.dt == 0.01
    pilot = made.pilot(policy, "full", random.key(3))
    log = fly(plant, pilot, made.flight_starts(1)[0], ticks=130)
    assert len(log.t) == 131
    np.testing.assert_allclose(np.diff(log.t), 0.01)
    assert log.missed_ticks == 0
    assert log.events[0].kind == "residual"
    np.testing.assert_allclose([e.t for e in log.events if e.kind == "residual"], [0.6, 1.1])
    np.testing.assert_allclose([e.t for e in log.events if e.kind in ("policy", "rejected")], [1.05])
    before, after = np.linalg.norm(log.p[[0, -1]] - np.array(preset.goal), axis=1)
    assert after < 0.7 * before


def test_a_vehicle_whose_lag_is_known_is_modelled_with_it():
    spec = VehicleSpec("made_up", 1.0, (0.02, 0.02, 0.03), (0.2, 0.2), 20.0, (4.0, 4.0, 3.0), 0.05, (0.07, 0.08, 0.4))
    for name in ("hover/retrim", "track/retrim"):
        made = Setup.from_preset(changed(load(name), vehicle=spec))
        response = made.env.dynamics.response
        np.testing.assert_allclose([response.thrust_lag, *response.rate_lag], [0.05, 0.07, 0.08, 0.4])
        prior = made.learner.residual_model.init(jax.random.key(0))
        rates = prior.rates if name == "hover/retrim" else prior.first.rates
        np.testing.assert_allclose(rates.tau, [0.07, 0.08, 0.4])


@pytest.mark.parametrize(("delay", "ticks"), [(0.041, 2), (0.0, 0), (None, 1)])
def test_a_vehicle_whose_delay_is_known_is_trained_with_it(delay, ticks):
    body = ("made_up", 1.0, (0.02, 0.02, 0.03), (0.2, 0.2), 20.0, (4.0, 4.0, 3.0), 0.05)
    made = Setup.from_preset(changed(load("hover/retrim"), vehicle=VehicleSpec(*body, command_delay=delay)))
    assert made.learner.plant_delay_ticks == made.preset.plant_delay_ticks == ticks
    exact = 0.02 if delay is None else delay  # the model, and the observer in flight
    observer = made.controller(made.learner.init(made.new_policy(random.key(0)), random.key(2))).frame.observer
    assert [float(made.env.delay), float(observer.path.delay)] == pytest.approx([exact, exact])
    assert Setup.from_preset(made.preset).preset == made.preset


def test_a_delay_of_too_many_ticks_is_one_line_that_says_why():
    body = ("made_up", 1.0, (0.02, 0.02, 0.03), (0.2, 0.2), 20.0, (4.0, 4.0, 3.0), 0.05)
    preset = changed(load("hover/retrim"), dt=0.005, vehicle=VehicleSpec(*body, command_delay=0.15))
    with pytest.raises(ConfigError, match=r"'made_up': command_delay = 0.15 s is 30 ticks of dt = 0.005 s") as error:
        Setup.from_preset(preset)
    assert "\n" not in str(error.value)
