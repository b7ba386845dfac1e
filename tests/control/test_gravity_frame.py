"""The frame of effective gravity: Eq. (1) has exactly the same form in it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import GOAL, first_order, hover_env, hover_task, random_command, random_state, replace_fields
from retrim.adapt.views import GravityView, RestView, WorldView
from retrim.control import Policy
from retrim.control.controller import AbstractController, PolicyController
from retrim.control.gravity_frame import GravityFrame, StateDependentResidual
from retrim.control.pose_frame import PoseFrame
from retrim.estimation.disturbance_observer import DisturbanceObserver
from retrim.learn import Env, FittedResidual, rollout
from retrim.learn.residuals import RegressionModel
from retrim.physics import ActuatorState, Command, Hybrid, PointMass, State, small, so3
from retrim.physics.actuators import LaggedModel, RateBiasedModel
from retrim.physics.command_path import CommandPath
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.physics.path_family import Member, PathBelief
from retrim.tasks import (
    Keypoints,
    L2Track,
    OccludedKeypoints,
    Preview,
    RelativeObs,
    Start,
    StateAndErrorObs,
    StateObs,
    Track,
)  # fmt: skip
from retrim.tasks.shapes import circle, figure8, star

HOME = jnp.array(GOAL)
LIMIT = jnp.array(6.0)
PUSHES = [(0.0, 0.0, 0.0), (2.0, 2.0, 2.0), (-3.0, 1.0, -2.5), (0.0, 0.0, -6.0), (5.0, -3.0, 1.0)]


roll = eqx.filter_jit(rollout)


fresh = eqx.filter_jit(lambda size, key: Policy.of(size, small(), key=key, hidden=(8, 8)))
awake = eqx.filter_jit(lambda size, key: jax.tree.map(lambda leaf: leaf + 0.02, fresh(size, key)))


def always(d, x, u):
    """Return ``d``. ``eqx.Partial`` makes ``d`` a value, so that a different ``d`` needs no new compilation."""
    return d


def assert_close(a, b, atol=1e-12):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), a, b)


@pytest.mark.parametrize("d", PUSHES)
def test_effective_gravity_is_standard_gravity_in_frame(d):
    frame = EffectiveGravityFrame.of(jnp.array(d))
    np.testing.assert_allclose(frame.Q @ frame.Q.T, np.eye(3), atol=1e-12)
    assert float(jnp.linalg.det(frame.Q)) == pytest.approx(1.0)
    specific_force = jnp.array([0.0, 0.0, -9.81]) + jnp.array(d)
    np.testing.assert_allclose(frame.vector(specific_force), [0.0, 0.0, -9.81], atol=1e-12)
    axis = jnp.cross(specific_force, jnp.array([0.0, 0.0, 1.0]))  # the smallest rotation leaves this one alone
    np.testing.assert_allclose(frame.Q @ axis, axis, atol=1e-9)


@pytest.mark.parametrize(
    "model", [PointMass(0.02), LaggedModel(PointMass(0.02), first_order(0.03))], ids=["bare", "lagged"]
)
def test_step_commutes_with_frame(model, key):
    """For any state, command and residual, a step of Eq. (1) may be transformed before or after the step."""
    k_x, k_u = random.split(key)
    x, u = random_state(k_x), random_command(k_u)

    def ticks(d, drag):
        residual = lambda x, u: d - drag * x.v + drag * u.c * x.R[:, 0]  # noqa: E731
        frame = EffectiveGravityFrame.of(d)
        left = lambda x, u: frame.vector(residual(frame.world_state(x), frame.world_command(u)) - d)  # noqa: E731
        world, inside = Hybrid(model, residual), Hybrid(model, left)
        s, s_in_frame = world.init(x), inside.init(frame.state(x))
        if isinstance(model, LaggedModel):  # its actuators hover at first, in the world as in the frame
            s_in_frame = replace_fields(s_in_frame, actuators=ActuatorState.at(frame.command(s.actuators.command)))
        s, s_in_frame = world.step(s, u, jnp.zeros(3)), inside.step(s_in_frame, frame.command(u), jnp.zeros(3))
        return inside.state(s_in_frame), frame.state(world.state(s))

    all_pushes = jax.jit(jax.vmap(ticks, in_axes=(0, None)))
    for drag in (0.0, 0.3):  # without, and with a part that depends on the state
        assert_close(*all_pushes(jnp.array(PUSHES), jnp.array(drag)))


def test_frame_round_trip_is_identity(key):
    frame = EffectiveGravityFrame.of(jnp.array([1.0, -2.0, 3.0]))
    x, u = random_state(key), random_command(key)
    assert_close(frame.world_state(frame.state(x)), x)
    assert_close(frame.world_command(frame.command(u)), u)


@pytest.mark.parametrize("make", [circle, figure8, star])
def test_flat_command_in_frame_gives_reference_acceleration(make):
    """The command for the reference in the frame, transformed to the world, gives its acceleration under the push."""
    reference, times, away = make(), jnp.array([0.0, 0.8, 2.2, 4.3, 5.1]), HOME + jnp.array([0.1, 0.7, -0.2])

    @jax.jit
    @jax.vmap
    def observe(d):
        frame = EffectiveGravityFrame.of(d)
        here, in_frame = jax.vmap(reference)(times), reference.in_frame(frame)
        points = jax.vmap(in_frame)(times)
        close_to = (jax.vmap(frame.vector)(here.p), jax.vmap(frame.vector)(here.v))
        inside = in_frame.distance(frame.vector(away)) / frame.scale
        return here, points, close_to, frame.scale, in_frame.lap, (inside, reference.distance(away))

    here, points, (p, v), scale, lap, (inside, outside) = jax.tree.map(np.asarray, observe(jnp.array(PUSHES)))
    assert_close(points.p, p)
    assert_close(points.v, v)
    thrust = points.u[..., 0] / scale[:, None]
    needs = np.linalg.norm(here.a - np.array([0.0, 0.0, -9.81]) - np.array(PUSHES)[:, None], axis=-1)
    np.testing.assert_allclose(thrust, needs, rtol=1e-6)
    assert PUSHES[0] == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(points.u[0], here.u[0], atol=0.02)
    np.testing.assert_array_equal(lap, np.broadcast_to(reference.lap, lap.shape))
    np.testing.assert_allclose(inside, outside, rtol=1e-6)


def test_flat_rates_in_frame_follow_path():
    """From the state of the reference, its rates keep the thrust in the required direction for a second."""

    @jax.jit
    @jax.vmap
    def ends(d):
        reference = circle().in_frame(EffectiveGravityFrame.of(d))

        def attitude(t):
            here = reference(t)
            z = here.a + jnp.array([0.0, 0.0, 9.81])
            z = z / jnp.linalg.norm(z)
            y = jnp.cross(z, jnp.array([1.0, 0.0, 0.0]))
            y = y / jnp.linalg.norm(y)
            return jnp.stack([jnp.cross(y, z), y, z], axis=1)

        model = PointMass(0.005)

        def tick(k, x):
            return model.step(x, Command.of(reference(4.0025 + 0.005 * k).u), jnp.zeros(3))

        begin, end = jnp.array(4.0), jnp.array(5.0)
        x = State(reference(begin).p, attitude(begin), reference(begin).v)
        return lax.fori_loop(0, 200, tick, x).p, reference(end).p

    np.testing.assert_allclose(*ends(jnp.array([(2.0, -1.0, 1.5), (0.0, 3.0, -2.0)])), atol=0.002)


@pytest.mark.parametrize("kind", [Track, L2Track])
def test_task_in_frame_has_same_observation_and_reward(kind, key):
    """The state of the reference has the same reward, and the preview is rotated and scaled."""
    reference, frame = figure8(), EffectiveGravityFrame.of(jnp.array([1.0, 2.0, -1.0]))
    task = kind(reference, Preview(reference, small().omega_max), jnp.array(1.0), jnp.array(5.0), 0.02, 50)
    t, x = jnp.array(4.2), random_state(key)

    @eqx.filter_jit
    def both(task, frame):
        task_in_frame, memory = task.in_frame(frame), task.observation.init(x)
        outside, _ = task.observation(memory, t, x, Command.hover())
        inside, _ = task_in_frame.observation(memory, t, frame.state(x), Command.hover())
        vectors = [(inside[k : k + 3], frame.vector(outside[k : k + 3])) for k in (0, 3, 6, 9, 12, 15, 18, 30)]
        at = task_in_frame.reference(t)
        reward = task_in_frame.reward(t, State(at.p, jnp.eye(3), at.v), Command.of(at.u))
        return vectors, task_in_frame.error(t, frame.state(x)), frame.scale * task.error(t, x), at.heading, reward

    vectors, error, scaled_error, heading, reward = both(task, frame)
    for inside, outside in vectors:  # positions, velocities, and its own velocity
        np.testing.assert_allclose(inside, outside, atol=1e-9)
    np.testing.assert_allclose(error, scaled_error, rtol=1e-9)
    heads = 0.5 * (1.0 - np.cos(float(heading)))
    if kind is L2Track:
        np.testing.assert_allclose(reward, -heads, atol=1e-9)


@pytest.mark.parametrize("d", [(2.0, -1.0, 1.5), (-2.0, 2.0, 2.0)])
def test_known_constant_push_equals_calm_roll_out(d, key):
    """Roll-outs and rewards under a known push in the view equal those without a push in the frame."""
    env, d = hover_env(horizon=25), jnp.array(d)  # too short to be terminated
    frame, policy = EffectiveGravityFrame.of(d), fresh(15, key)
    start = Start(jnp.array(0.0), random_state(key))
    with_push = roll(GravityView(LIMIT)(env, eqx.Partial(always, d)), policy, start)
    calm_env, calm_start = Env(env.dynamics, env.task.in_frame(frame)), Start(start.t, frame.state(start.x))
    calm = roll(calm_env, policy, calm_start)
    assert_close(jax.vmap(frame.state)(with_push.x), calm.x, 1e-9)
    assert_close(jax.vmap(frame.command)(with_push.u), calm.u, 1e-9)
    np.testing.assert_allclose(with_push.reward, calm.reward, atol=1e-9)


def test_world_view_is_identity():
    env, residual = hover_env(), lambda x, u: x.v
    observation = WorldView()(env, residual)
    assert observation.frame_disturbance is None
    assert observation.dynamics.residual is residual


def test_frame_has_no_gradient(key):
    """As for the residual (paper, Sec. III-D), gradients flow through the analytical model only."""
    env = hover_env(horizon=5)
    view = GravityView(LIMIT)(env, lambda x, u: -0.5 * x.v)
    x = random_state(key)

    def tilt(v):
        return view.frame(replace_fields(x, v=v), Command.hover()).Q

    np.testing.assert_array_equal(jax.jit(jax.jacobian(tilt))(x.v), 0.0)


def test_observer_excludes_known_residual(key):
    """The observer estimates the part outside the known residual, and the frame compensates for each once."""
    d = jnp.array([1.0, 0.0, -2.0])
    residual = lambda x, u: d - 0.4 * x.v + 0.1 * (u.c - 9.81) * x.R[:, 2]  # noqa: E731
    x, u = random_state(key), random_command(key)
    observer = DisturbanceObserver(PointMass(0.02), jnp.array(1e-9), LIMIT, jnp.array(jnp.inf))
    in_frame = GravityFrame(PolicyController(hover_env().task.observation, fresh(15, key)), observer, residual)

    @jax.jit
    def observe():
        memory = in_frame.init(x)
        first = observer(memory.observer, jnp.array(-0.02), x)
        memory = replace_fields(memory, observer=observer.issue(first, u))  # no delay is declared: it acts at once
        after = Hybrid(PointMass(0.02), residual).step(x, u, jnp.zeros(3))
        _, memory = in_frame(memory, jnp.array(0.0), after)
        apart = StateDependentResidual(residual, jnp.array(1.0))(x, u) + d, residual(x, u)
        return apart, memory.observer.d_hat, (memory.frame.d, residual(after, u))

    apart, d_hat, both = observe()
    np.testing.assert_allclose(*apart, atol=1e-12)
    np.testing.assert_allclose(d_hat, d, atol=1e-6)
    np.testing.assert_allclose(*both, atol=1e-6)


def test_frame_is_limited_and_defined_near_free_fall():
    """An estimate beyond the limit rotates no farther, and a falling vehicle still has a frame."""
    observer = DisturbanceObserver(PointMass(0.02), jnp.array(0.2), LIMIT, jnp.array(2.0))
    s = observer.init(State.at(jnp.zeros(3)))
    falling = State(jnp.zeros(3), jnp.eye(3), jnp.array([0.0, 0.0, -1e4]))
    s = observer(replace_fields(s, t=jnp.array(0.0)), jnp.array(0.02), falling)
    assert float(jnp.linalg.norm(s.d_hat)) <= 6.0 + 1e-6
    frame = EffectiveGravityFrame.of(s.d_hat)
    assert np.isfinite(frame.Q).all()
    assert 0.0 < float(frame.scale) < 3.0


def test_pose_filter_estimate_rotates_image(key):
    """With a correct estimate, the command under a push equals that of the calm flight; the last command is kept."""
    d, x = jnp.array([1.5, -1.0, 2.0]), State(HOME + jnp.array([0.1, -0.1, 0.1]), jnp.eye(3), jnp.zeros(3))
    frame = EffectiveGravityFrame.of(d)
    full = Keypoints.of(HOME, small().omega_max, whitened=False)
    policy = awake(full.size, key)
    controller = PoseFrame(PolicyController(OccludedKeypoints(full, jnp.array(1.0)), policy), LIMIT)
    calm = PolicyController(full.in_frame(frame), policy)

    @jax.jit
    def decide():
        memory, last = controller.init(x)
        sure = replace_fields(memory.pose, x=replace_fields(x, v=-0.02 * d), d=d, P=1e-12 * jnp.eye(12))
        calmly = jnp.zeros((3, 4)).at[:, 0].set(1.0 / frame.scale - 1.0)  # what has been hover in the frame
        memory = memory._replace(
            commands=calmly, pose=sure, poses=jax.tree.map(lambda leaf: jnp.repeat(leaf[None], 13, axis=0), x)
        )
        u, after = controller((memory, last), jnp.array(0.0), x)
        start = calm.init(frame.state(x))
        expected, _ = calm((start[0], frame.command(last)), jnp.array(0.0), frame.state(x))
        commands = frame.command(u).vector(), expected.vector()
        return commands, (after[1], u), (controller.accept(after, last)[1], last)

    back = PointMass(0.02).step(State(x.p, x.R, -x.v), Command.hover(), jnp.zeros(3))
    assert_close(back.p, x.p)  # it hovers: a tick ago it was here
    commands, memory, accepted_command = decide()
    np.testing.assert_allclose(*commands, atol=1e-4)
    assert_close(*memory)
    assert_close(*accepted_command)


def test_roll_out_memory_of_images_is_in_frame(key):
    """A vehicle at rest at the goal under a known push sees a constant image from the first tick on."""
    d, full = jnp.array([1.5, -1.0, 2.0]), Keypoints.of(HOME, small().omega_max, whitened=False)
    task = dataclasses.replace(hover_task(horizon=14), observation=full)
    env = RestView(LIMIT)(Env(PointMass(0.02), task), lambda x, u: d)
    observation = []

    class RecordingKeypoints(type(full)):
        def stacked(self, frames):
            jax.debug.callback(lambda rows: observation.append(np.asarray(rows)), frames)
            return super().stacked(frames)

    looking = RecordingKeypoints(**{f.name: getattr(full, f.name) for f in dataclasses.fields(full)})
    env = eqx.tree_at(lambda e: e.task.observation, env, looking)
    frame = EffectiveGravityFrame.of(d)
    at_rest = State(HOME, frame.world_state(State.at(frame.vector(HOME))).R, jnp.zeros(3))
    policy = fresh(full.size, key)
    still = eqx.tree_at(lambda p: p.layers[-1].weight, policy, jnp.zeros_like(policy.layers[-1].weight))
    roll(env, still, Start(jnp.array(0.0), at_rest))
    jax.effects_barrier()
    first = observation[0]
    np.testing.assert_allclose(first, np.repeat(first[-1:], len(first), axis=0), atol=1e-9)


def test_keypoint_training_uses_one_frame(key):
    """The frame is that of the learned disturbance at rest, with a limited norm."""
    d, env = jnp.array([1.5, -1.0, 2.0]), hover_env(horizon=3)
    observation = RestView(LIMIT)(env, lambda x, u: d - 0.5 * x.v)
    assert_close(observation.frame(random_state(key), Command.hover()), EffectiveGravityFrame.of(d))
    far = RestView(LIMIT)(env, lambda x, u: 9.0 * d).frame(random_state(key), Command.hover())
    np.testing.assert_allclose(jnp.linalg.norm(far.d), LIMIT, rtol=1e-6)


@pytest.mark.parametrize("d", [(1.0, 0.5, -1.0), (-2.0, 2.0, 2.0)])
@pytest.mark.parametrize("tracking", [None, "preview", "relative", "both"])
def test_flight_under_known_push_is_rotated_calm_flight(d, tracking):
    """With a perfect estimate, a flight under a push equals the calm flight in the frame."""
    env, d = hover_env(horizon=40), jnp.array(d)
    frame, x0 = (
        EffectiveGravityFrame.of(d),
        State(HOME + jnp.array([0.2, -0.1, 0.3]), so3.exp(jnp.array([0.1, 0.2, 0.0])), jnp.zeros(3)),
    )
    if tracking is not None:
        reference, limits = circle(), small().omega_max
        observation = {
            "preview": Preview(reference, limits),
            "relative": RelativeObs(reference, limits, 2),
            "both": StateAndErrorObs(reference, StateObs(HOME, limits, 2)),
        }[tracking]
        task = Track(reference, observation, jnp.array(1.0), jnp.array(5.0), 0.02, 40)
        env = Env(PointMass(0.02), task)
    policy = fresh(env.task.observation.size, random.key(3))
    inner = PolicyController(env.task.observation, policy)
    exact = DisturbanceObserver(PointMass(0.02), jnp.array(1e-9), jnp.array(9.0), jnp.array(jnp.inf))
    in_frame = GravityFrame(inner, exact)
    start = Start(jnp.array(0.0), frame.state(x0))
    calm = roll(Env(PointMass(0.02), env.task.in_frame(frame)), policy, start)

    memory = in_frame.init(x0)
    memory = replace_fields(memory, observer=replace_fields(memory.observer, d_hat=d))
    positions = _positions(in_frame, d, memory, x0)
    np.testing.assert_allclose(jax.vmap(frame.vector)(positions), calm.x.p, atol=1e-6)


@eqx.filter_jit
def _positions(in_frame, d, memory, x):
    """Return the positions of 40 ticks under the push ``d``."""

    def tick(carry, k):
        memory, x = carry
        u, memory = in_frame(memory, 0.02 * k, x)
        return (memory, PointMass(0.02).step(x, u, d)), x.p

    return lax.scan(tick, (memory, x), jnp.arange(40.0))[1]


def test_known_rate_bias_is_subtracted_from_command(key):
    """A vehicle that turns too fast flies as one that does not; the policy's memory contains its intended command."""
    bias, policy = jnp.array([0.3, -0.2, 0.1]), awake(23, key)
    observer = DisturbanceObserver(PointMass(0.02), jnp.array(0.05), LIMIT, jnp.array(4.0))
    inner = PolicyController(hover_env(history=2).task.observation, policy)
    age = jnp.array(0.01)
    plain, naive = (GravityFrame(inner, observer, age=age, rate_bias=b) for b in (jnp.zeros(3), bias))

    @eqx.filter_jit
    def fly(controller, model):
        def tick(carry, i):
            x, memory = carry
            u, memory = controller(memory, 0.02 * i, x)
            x = model.step(x, u, jnp.zeros(3))
            return (x, controller.accept(memory, u)), x

        x = State.at(HOME + 0.1)
        return lax.scan(tick, (x, controller.init(x)), jnp.arange(10.0))[1]

    assert_close(fly(naive, RateBiasedModel(PointMass(0.02), bias)), fly(plain, PointMass(0.02)), 1e-9)


def test_corrected_model_has_observed_rates(key):
    """In the world it has bias and lag; in the frame, whose controller compensates for the bias, only the lag."""
    model = RegressionModel.of(0.02)
    fresh = model.init(key)
    names = replace_fields(
        fresh, rates=replace_fields(fresh.rates, bias=jnp.array([0.3, 0.0, 0.0]), tau=jnp.full(3, 0.08))
    )
    env = hover_env(LaggedModel(PointMass(0.02), first_order(0.03)))
    world, in_frame = (view(env, FittedResidual(model, names)).dynamics for view in (WorldView(), GravityView(LIMIT)))
    true = LaggedModel(PointMass(0.02), first_order(0.08))
    for observation, expected in ((world, RateBiasedModel(true, names.rates.bias)), (in_frame, true)):
        x, u = random_state(key), random_command(key)
        assert_close(
            observation.step(observation.init(x), u, jnp.zeros(3)), expected.step(expected.init(x), u, jnp.zeros(3))
        )


class HoverInAnyFrame(AbstractController[None]):
    """A controller that commands hover in every frame."""

    def in_frame(self, frame):
        return self

    def init(self, x):
        return None

    def __call__(self, memory, t, x):
        return Command.hover(x.p.dtype), memory

    def accept(self, memory, u):
        return memory


def constant_map(force, p):
    """A map with one constant value."""
    return force


def local_map(height, p):
    """A map with a force near the origin of the plane."""
    return height * jnp.exp(-0.5 * jnp.sum(p[:2] ** 2) / 0.2**2)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0, 2.0])
def test_wrong_map_does_not_change_estimate_of_steady_disturbance(share):
    """The observer estimates the remainder, so the sum of the map and the remainder is the disturbance for any map."""
    d = jnp.array([1.0, -0.5, 2.0])
    observer = DisturbanceObserver(PointMass(0.02), jnp.array(0.02), LIMIT, jnp.array(jnp.inf))
    nothing = eqx.Partial(always, jnp.zeros(3))
    frame = GravityFrame(HoverInAnyFrame(), observer, nothing, place=eqx.Partial(constant_map, share * d))
    np.testing.assert_allclose(_estimate_after(60, frame, d), d, atol=2e-2)


@eqx.filter_jit
def _estimate_after(ticks, frame, d):
    """The disturbance of the frame after some ticks under the push ``d``."""

    def tick(carry, k):
        memory, x = carry
        u, memory = frame(memory, 0.02 * k, x)
        return (memory, PointMass(0.02).step(x, u, d)), None

    x = State.at(jnp.array([0.0, 0.0, 1.0]))
    return lax.scan(tick, (frame.init(x), x), jnp.arange(float(ticks)))[0][0].frame.d


def test_map_is_evaluated_at_predicted_position():
    observer = DisturbanceObserver(PointMass(0.02), jnp.array(0.02), LIMIT, jnp.array(jnp.inf))
    force = eqx.Partial(local_map, jnp.array([0.0, 0.0, 2.0]))
    frame = GravityFrame(
        HoverInAnyFrame(), observer, eqx.Partial(always, jnp.zeros(3)), place=force, lead=jnp.array(0.06)
    ).with_age(0.02)
    x = State(jnp.array([-0.2, 0.0, 1.0]), jnp.eye(3), jnp.array([2.0, 0.0, 0.0]))
    _, memory = frame(frame.init(x), jnp.array(0.0), x)
    there = x.p + 0.08 * x.v
    np.testing.assert_allclose(memory.frame.d - memory.observer.d_hat, force(there), atol=1e-6)


def test_frame_leads_a_smooth_disturbance():
    """The frame is that of the disturbance at the end of the horizon, which the observer has not seen."""
    h, dt = 0.1, 0.02
    observer = DisturbanceObserver(PointMass(dt), jnp.array(0.005), LIMIT, jnp.array(jnp.inf))
    frame = GravityFrame(HoverInAnyFrame(), observer)
    leads = dataclasses.replace(frame, horizon=jnp.full(3, h), certainty=jnp.array(1.0))
    t = dt * np.arange(500)
    late, early = (_frames_under_sinusoid(each, t) for each in (frame, leads))
    true = np.asarray(jax.vmap(_sinusoid)(jnp.asarray(t + h)))
    error = [np.sqrt(np.mean((each - true)[250:] ** 2)) for each in (late, early)]
    assert error[1] < 0.5 * error[0]


def _sinusoid(t):
    return jnp.sin(2.0 * jnp.pi * t / 3.0 + jnp.array([0.0, 1.0, 2.0]))


@eqx.filter_jit
def _frames_under_sinusoid(frame, times):
    """The disturbance of the frame at each time under a sinusoidal push."""

    def tick(carry, t):
        memory, x = carry
        u, memory = frame(memory, t, x)
        return (memory, PointMass(0.02).step(x, u, _sinusoid(t))), memory.frame.d

    x = State.at(jnp.array([0.0, 0.0, 1.0]))
    return lax.scan(tick, (frame.init(x), x), jnp.asarray(times))[1]


def test_horizon_follows_the_identified_vehicle():
    """Without a certainty, as in training, the frame is that of the present estimate."""
    path = CommandPath.of(0.03, first_order(0.05))
    belief = PathBelief(jnp.zeros(4), jnp.zeros(4))
    observer = DisturbanceObserver(PointMass(0.02), jnp.array(0.02), LIMIT, jnp.array(1.0))
    frame = GravityFrame(HoverInAnyFrame(), observer)
    assert frame.with_vehicle(Member(path, belief)).certainty == 0.0
    known = frame.with_vehicle(Member(path, belief, jnp.array(0.08), jnp.array(0.7)))
    tilt, thrust = 2.5 * (0.03 + 0.05), 0.03 + 0.05 + 0.01
    np.testing.assert_allclose(known.horizon, [tilt, tilt, thrust], atol=1e-6)
    np.testing.assert_allclose(known.certainty, 0.7, atol=1e-6)


def test_contradictory_measurements_predict_no_change():
    """While velocities contradict positions, the estimate decays, and this decay is not a trend of the disturbance."""
    observer = DisturbanceObserver(PointMass(0.02), jnp.array(0.005), LIMIT, jnp.array(jnp.inf))
    frame = GravityFrame(HoverInAnyFrame(), observer, horizon=jnp.full(3, 0.1), certainty=jnp.array(1.0))
    x = State.at(jnp.array([0.0, 0.0, 1.0]))
    memory, step = frame.init(x), eqx.filter_jit(frame)
    for k in range(100):
        u, memory = step(memory, jnp.array(0.02 * k), x)
        x = PointMass(0.02).step(x, u, _sinusoid(0.02 * k))
    assert jnp.abs(memory.frame.d - memory.observer.d_hat).max() > 0.05
    before = memory.trend
    for k in range(100, 110):
        wrong = State(x.p + 50.0 * (1 + k % 2), x.R, x.v)
        u, memory = step(memory, jnp.array(0.02 * k), wrong)
        np.testing.assert_allclose(memory.frame.d, memory.observer.d_hat, atol=1e-9)
    np.testing.assert_array_equal(memory.trend.square, before.square)
