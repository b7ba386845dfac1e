"""Vision: the camera as published, whitened keypoints, points out of sight, learning to see."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import GOAL, random_command, replaced
from retrim.adapt import ControllerPilot, Measurement
from retrim.control import Policy, PolicyController
from retrim.estimation.camera import in_camera
from retrim.estimation.pose_filter import PoseFilter
from retrim.learn import rollout
from retrim.learn.encoder import represent
from retrim.physics import Command, PointMass, State, small, so3
from retrim.tasks import Camera, Hover, Keypoints, Start
from retrim.tasks.keypoints import STRANGE, random_motion

PUBLISHED = [
    (-0.427, -0.474), (0.402, -0.474), (0.402, 0.631), (-0.427, 0.631), (-0.012, 0.665), (-0.452, 0.078),
    (-0.012, -0.508),
]  # fmt: skip


def keypoints(**options):
    return Keypoints.of(jnp.array(GOAL), small().omega_max, **({"whitened": False} | options))


def near():
    """Sees everything for a while."""
    return State(jnp.array([0.05, -0.1, 1.1]), jnp.eye(3), jnp.array([0.1, 0.2, -0.05]))


@pytest.fixture(scope="module")
def merged():
    return keypoints()


@pytest.fixture(scope="module")
def white():
    return keypoints(whitened=True)


@pytest.fixture(scope="module")
def camera():
    return Camera.published()


project = eqx.filter_jit(lambda camera, P: jax.vmap(camera.project)(P))


# ---- camera


def test_published_projections_at_the_goal(plain):
    pixels, visible = plain.pixels(State.at(jnp.array(GOAL)))
    np.testing.assert_allclose(pixels, PUBLISHED, atol=6e-4)
    assert visible.all()


def test_centre_and_neighbourhood_by_hand(camera):
    """On the axis: the principal point. Close to it a pinhole with focal length f / (1 + xi), for d1 = d2 = z."""
    found = project(camera, jnp.array([[0.0, 0.0, 2.0], [0.002, 0.0, 2.0], [0.0, -0.002, 2.0]]))
    centre = 2.0 * np.array([632.1317557 / 1280.0, 388.2472267 / 720.0]) - 1.0
    np.testing.assert_allclose(found.pixel[0], centre, atol=1e-9)
    xi, f = -0.0074411489, (599.87676297, 449.29110372)
    slope = 1.0 / (0.6138265280850498 * (1.0 + xi) + (1.0 - 0.6138265280850498) * (1.0 + xi))
    np.testing.assert_allclose(found.pixel[1] - centre, [2.0 * f[0] * 1e-3 * slope / 1280.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(found.pixel[2] - centre, [0.0, -2.0 * f[1] * 1e-3 * slope / 720.0], atol=1e-8)


def test_looks_down_with_x_to_the_right(plain):
    """Camera x is body -y, camera y is body -x: what is ahead is up in the image, what is left is left."""
    x = State.at(jnp.array([0.0, 0.0, 3.0]))
    points = in_camera(x, jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(points, [[0.0, -1.0, 3.0], [-1.0, 0.0, 3.0], [0.0, 0.0, 3.0]], atol=1e-12)
    turned = in_camera(replaced(x, R=so3.rotz(jnp.array(0.5 * math.pi))), jnp.array([[0.0, 1.0, 0.0]]))
    np.testing.assert_allclose(turned, [[0.0, -1.0, 3.0]], atol=1e-12)


def test_bearing_is_the_inverse_of_project(camera):
    pixels = random.uniform(random.key(1), (200, 2), minval=-1.0, maxval=1.0)
    rays = eqx.filter_jit(lambda c, m: jax.vmap(c.bearing)(m))(camera, pixels)
    np.testing.assert_allclose(jnp.linalg.norm(rays, axis=1), 1.0, atol=1e-9)
    far = 0.3 + 5.0 * random.uniform(random.key(2), (200, 1))
    found = project(camera, rays * far)
    np.testing.assert_allclose(found.pixel, pixels, atol=1e-8)
    assert found.visible.all()


def test_about_120_degrees_across(camera):
    ends = jax.vmap(camera.bearing)(jnp.array([[-1.0, 0.0], [1.0, 0.0]]))
    assert math.degrees(math.acos(float(jnp.sum(ends[0] * ends[1])))) == pytest.approx(120.0, abs=5.0)


ODD = [
    [0.0, 0.0, -1.0], [1e-3, 0.0, -2.0], [3.0, 0.0, 0.0], [0.0, -4.0, 1e-9], [5.0, 5.0, 0.01], [1.0, 1.0, -1.0],
    [0.0, 0.0, 0.0], [0.0, 0.0, 1e-12], [1e6, 0.0, 1.0],
]  # fmt: skip


def test_finite_and_unseen_far_off_axis_and_behind(camera):
    points = jnp.array(ODD)
    found = project(camera, points)
    slopes = eqx.filter_jit(lambda c, P: jax.vmap(jax.jacobian(lambda q: c.project(q).pixel))(P))(camera, points)
    assert np.isfinite(found.pixel).all()
    assert np.isfinite(slopes).all()
    assert not found.visible[:6].any()
    assert not found.visible[8]


def test_the_border_decides(camera):
    """Just inside is seen, just outside is not; values and gradients are finite on the border itself."""
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            rays = jnp.stack([camera.bearing(jnp.zeros(2).at[axis].set(side * s)) for s in (0.999, 1.0, 1.001)])
            found = project(camera, rays)
            assert bool(found.visible[0])
            assert not bool(found.visible[2])
            assert np.isfinite(jax.jacobian(lambda q: camera.project(q).pixel)(rays[1])).all()


def test_the_projection_does_not_depend_on_distance(camera, key):
    rays = random.normal(key, (20, 3)).at[:, 2].set(1.0)
    np.testing.assert_allclose(project(camera, 7.0 * rays).pixel, project(camera, rays).pixel, atol=1e-9)


# ---- keypoints


begin = eqx.filter_jit(lambda o, x: o.init(x))
step = eqx.filter_jit(lambda x, u: PointMass(0.02).step(x, u, jnp.zeros(3)))
see = eqx.filter_jit(lambda o, memory, x, last: o(memory, jnp.array(0.0), x, last))


def watched(observation, x, us):
    """Observations of a point mass under the commands ``us``, as a policy would get them; and the last state."""
    memory, last, shown = begin(observation, x), Command.hover(), []
    for u in us:
        o, memory = see(observation, memory, x, last)
        x, last = step(x, u), u
        shown.append(np.asarray(o))
    return np.array(shown), memory, x


def gentle(key, n):
    return [Command(9.81 + 0.5 * random.normal(k, ()), 0.3 * random.normal(k, (3,))) for k in random.split(key, n)]


def test_no_silent_broadcast(plain):
    plain(plain.init(near()), jnp.array(0.0), near(), Command.hover())


def test_layout(plain, key):
    us = gentle(key, 6)
    shown, _, _ = watched(plain, near(), us)
    assert shown.shape == (6, plain.size) == (6, 89)
    assert plain.size == 89
    pixels, _ = plain.pixels(near())
    np.testing.assert_allclose(np.clip(shown[0, :14], -5, 5), np.reshape(pixels, 14), atol=1e-9)  # newest first
    np.testing.assert_allclose(shown[3, 14:28], shown[0, :14], atol=1e-12)  # 60 ms later it is one frame back
    np.testing.assert_array_equal(shown[:, 70:77], 1.0)
    issued = [[float(u.c) / 9.81 - 1.0, *(np.asarray(u.omega) / [6.0, 6.0, 4.0])] for u in us[2:5]]
    np.testing.assert_allclose(shown[5, 77:], np.reshape(issued, 12), atol=1e-12)


def test_the_same_start_sees_the_same(key):
    noisy, us = keypoints(noise=2.0, dropout=0.2), gentle(key, 4)
    first, again = watched(noisy, near(), us)[0], watched(noisy, near(), us)[0]
    np.testing.assert_array_equal(first, again)
    elsewhere = replaced(near(), v=near().v + 0.01)
    quiet = watched(keypoints(noise=0.0), elsewhere, us)[0] - watched(keypoints(noise=0.0), near(), us)[0]
    assert not np.allclose(watched(noisy, elsewhere, us)[0] - first, quiet, atol=1e-4)  # other noise


def test_without_noise_it_shows_the_projection_and_with_noise_its_deviation(plain):
    """In pixels: of 1280 and 720 across an image that is 2 wide and high."""
    exact = np.asarray(plain.pixels(near())[0])
    noisy = keypoints(noise=3.0, honest=False)
    starts = jax.vmap(lambda k: State(near().p, near().R, 0.1 * random.normal(k, (3,))))(
        random.split(random.key(4), 600)
    )

    @eqx.filter_jit
    def first(o, xs):
        return jax.vmap(lambda x: o(o.init(x), jnp.array(0.0), x, Command.hover())[0][:14])(xs)

    np.testing.assert_allclose(first(keypoints(honest=False), starts)[0].reshape(7, 2), exact, atol=1e-12)
    off = (np.asarray(first(noisy, starts)).reshape(-1, 7, 2) - exact) * np.array([640.0, 360.0])
    np.testing.assert_allclose(off.reshape(-1, 2).std(axis=0), 3.0, rtol=0.05)
    np.testing.assert_allclose(off.reshape(-1, 2).mean(axis=0), 0.0, atol=0.15)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_honesty_costs_nothing_while_everything_is_seen(noise, key):
    us = gentle(key, 8)
    open_, honest = (watched(keypoints(noise=noise, honest=h), near(), us)[0] for h in (False, True))
    np.testing.assert_array_equal(honest[:, 70:77], 1.0)
    np.testing.assert_allclose(honest, open_, atol=1e-12)


def test_what_is_out_of_sight_is_not_observed(plain):
    """Its flag is down, and what is shown is the filter's, not the truth; without honesty it is the truth."""
    aside = State(jnp.array([0.9, 0.0, 1.0]), jnp.eye(3), jnp.zeros(3))
    pixels, visible = (np.asarray(a) for a in plain.pixels(aside))
    assert 0 < visible.sum() < 7
    (o,), _, _ = watched(plain, aside, [Command.hover()])
    np.testing.assert_array_equal(o[70:77], visible)
    wrong = np.abs(o[:14].reshape(7, 2) - pixels).max(axis=1)
    np.testing.assert_allclose(wrong[visible], 0.0, atol=1e-12)
    assert (wrong[~visible] > 1e-6).all()
    (o,), _, _ = watched(keypoints(honest=False), aside, [Command.hover()])
    np.testing.assert_allclose(o[:14].reshape(7, 2), pixels, atol=1e-12)


@pytest.mark.parametrize("place", [(0.05, -0.1, 1.1), (0.9, 0.0, 1.0), (4.0, 0.0, 0.3)])
@pytest.mark.parametrize("honest", [True, False])
def test_gradient_of_the_observation_is_finite(place, honest, white):
    observation = replaced(white, honest=honest)
    x = State(jnp.array(place), so3.exp(jnp.array([0.1, 0.5, 0.0])), jnp.array([0.3, 0.0, 0.0]))

    @eqx.filter_jit
    def slope(o, x):
        memory = o.init(x)
        return jax.jacobian(lambda x: o(memory, jnp.array(0.0), x, Command.hover())[0])(x)

    leaves = jax.tree.leaves(slope(observation, x))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    if place[0] < 1.0:
        assert float(jnp.abs(leaves[0]).max()) > 0.01


def test_history_is_a_steady_motion(plain):
    """Position by velocity, attitude by body rates, step by step, oldest first."""
    omega, x = jnp.array([0.5, -0.3, 0.8]), near()
    frames = []
    for _ in range(13):
        frames.append(np.asarray(plain.pixels(x)[0]).reshape(14))
        last = x
        x = State(x.p + 0.02 * x.v, x.R @ so3.exp(0.02 * omega), x.v)
    np.testing.assert_allclose(plain.history(last, omega), frames, atol=1e-10)
    np.testing.assert_array_equal(plain.stacked(jnp.array(frames)).reshape(5, 14), np.array(frames)[[12, 9, 6, 3, 0]])


@pytest.fixture(scope="module")
def motions(white):
    """Whitened, before the cut: the motions of the whitening itself, and others."""

    @jax.jit
    def whitened(key):
        stack = jax.vmap(lambda k: white.stacked(white.history(*random_motion(k, white.goal))))
        return (stack(random.split(key, 20000)) - white.mean[None]) @ white.whiten.T

    return np.asarray(whitened(random.key(0))), np.asarray(whitened(random.key(5)))


def test_whitening(white, motions):
    """Symmetric; unit covariance of the motions it was made from, less where a pixel's noise is all there is."""
    own, other = motions
    np.testing.assert_allclose(white.whiten, white.whiten.T, atol=1e-10)
    np.testing.assert_allclose(own.mean(axis=0), 0.0, atol=1e-9)
    C = own.T @ own / len(own)
    spectrum = np.linalg.eigvalsh(C)
    assert spectrum.max() <= 1.0 + 1e-6
    assert np.median(spectrum) > 0.95
    assert spectrum.min() > 0.3
    variance = other.var(axis=0)  # rare frames, with points far outside, weigh much
    assert 0.8 < np.median(variance) < 1.5
    np.testing.assert_allclose(other.mean(axis=0), 0.0, atol=0.1)


def test_features_of_other_motions_are_white(white, motions):
    """What a policy is shown of motions that the whitening was not made from: the cut takes what rare frames leave."""
    own, other = (np.clip(whitened, -STRANGE, STRANGE) for whitened in motions)
    spectrum = np.linalg.eigvalsh(np.cov(other.T))
    assert spectrum.max() < 1.5
    np.testing.assert_allclose(np.sort(spectrum), np.linalg.eigvalsh(np.cov(own.T)), rtol=0.15, atol=0.02)
    assert np.mean(np.abs(motions[1]) > STRANGE) < 0.01


def test_features_are_cut_off(white):
    wild = 2.5 * random.normal(random.key(3), (13, 14))
    features = white.features(wild)
    raw = white.whiten @ (white.stacked(wild) - white.mean)
    assert float(jnp.abs(raw).max()) > 10.0
    np.testing.assert_array_equal(features, jnp.clip(raw, -5.0, 5.0))


# ---- sight


@eqx.filter_jit
def tracked(sight, x, us, visible, shown_by):
    """The filter beside a point mass; ``visible`` (ticks x 7) says what it is shown."""
    camera, ground = shown_by.camera, shown_by.ground()
    noise = 2.0 * 0.5 / camera.size

    def tick(carry, step):
        sight, x = carry
        u, seen = step
        x = PointMass(0.02).step(x, u, jnp.zeros(3))
        pixels = jax.vmap(camera.project)(in_camera(x, ground)).pixel
        sight = sight.predicted(u).corrected(camera, ground, pixels, seen, noise)
        gap = sight.x.p - x.p, so3.log(x.R.T @ sight.x.R), sight.x.v - x.v
        return (sight, x), (jnp.stack([jnp.sqrt(jnp.sum(g**2)) for g in gap]), sight.P)

    (sight, x), (gaps, covariances) = lax.scan(tick, (sight, x), (us, visible))
    return sight, x, gaps, covariances


@eqx.filter_jit
def corrected(sight, shown_by, pixels, visible):
    camera = shown_by.camera
    return sight.corrected(camera, shown_by.ground(), pixels, visible, 1.0 / camera.size)


def hovering(n):
    return [Command.hover()] * n


def stacked_commands(us):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *us)


@pytest.mark.parametrize("seed", range(3))
def test_converges_from_its_hand_over(seed, plain):
    x = State.at(jnp.array(GOAL))
    start = PoseFilter.near(x, random.key(seed))
    assert float(jnp.linalg.norm(start.x.p - x.p)) > 0.01
    _, _, gaps, _ = tracked(start, x, stacked_commands(hovering(40)), jnp.ones((40, 7), dtype=bool), plain)
    assert float(gaps[15:, 0].max()) < 2e-3  # m
    assert float(gaps[15:, 1].max()) < 2e-3  # rad
    assert float(gaps[25:, 2].max()) < 0.02  # m/s


def test_hand_over_is_as_uncertain_as_it_says():
    x = State.at(jnp.array(GOAL))
    starts = jax.jit(jax.vmap(lambda k: PoseFilter.near(x, k)))(random.split(random.key(8), 2000))
    np.testing.assert_allclose((starts.x.p - x.p[None]).std(axis=0), 0.1, rtol=0.08)
    np.testing.assert_allclose(jax.vmap(so3.log)(starts.x.R).std(axis=0), 0.05, rtol=0.08)
    np.testing.assert_allclose(starts.x.v.std(axis=0), 0.2, rtol=0.08)
    np.testing.assert_allclose(np.diag(starts.P[0]), np.repeat([0.01, 0.0025, 0.04], 3))


def test_predicts_through_the_dark(plain, key):
    """15 ticks without any point, under commands that it knows: the error stays, the doubt grows."""
    us = stacked_commands(hovering(25) + [random_command(k) for k in random.split(key, 15)])
    dark = jnp.arange(40)[:, None] < jnp.full((1, 7), 25)
    x0 = State.at(jnp.array(GOAL))
    _, x, gaps, P = tracked(PoseFilter.near(x0, key), x0, us, dark, plain)
    assert float(jnp.linalg.norm(x.v)) > 0.1  # it has moved
    assert float(gaps[-1, 0]) < 5e-3
    assert float(gaps[-1, 1]) < 5e-3
    doubt = jnp.trace(P[:, :3, :3], axis1=1, axis2=2)
    assert (np.diff(doubt[24:]) > 0.0).all()
    assert float(doubt[-1]) > 10.0 * float(doubt[24])


def test_one_point_corrects(plain, key):
    """Of whichever point: less doubt than without it; a hidden one changes nothing."""
    x = State.at(jnp.array(GOAL))
    sight = PoseFilter.near(x, key)
    pixels, _ = plain.pixels(x)
    for i in range(7):
        after = corrected(sight, plain, pixels, jnp.arange(7) == i)
        shrunk = np.linalg.eigvalsh(sight.P - after.P)
        assert shrunk.min() > -1e-12
        assert (shrunk > 1e-4).sum() == 2  # two numbers, two directions
        assert float(jnp.trace(after.P)) < float(jnp.trace(sight.P))
    none = corrected(sight, plain, pixels, jnp.zeros(7, dtype=bool))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), none, sight)


def test_covariance_stays_one(plain, key):
    """Symmetric and positive, whatever comes into sight and goes."""
    kv, ku, ks = random.split(key, 3)
    us = stacked_commands(gentle(ku, 40))
    seen = random.uniform(kv, (40, 7)) < 0.3
    x0 = State.at(jnp.array(GOAL))
    _, _, gaps, P = tracked(PoseFilter.near(x0, ks), x0, us, seen, plain)
    np.testing.assert_allclose(P, np.swapaxes(P, 1, 2), atol=1e-15)
    assert np.linalg.eigvalsh(P).min() > 0.0
    assert float(gaps[20:, 0].max()) < 0.02


def test_a_stray_point_does_not_throw_it(plain, key):
    x = State.at(jnp.array(GOAL))
    sight, *_ = tracked(
        PoseFilter.near(x, key), x, stacked_commands(hovering(40)), jnp.ones((40, 7), dtype=bool), plain
    )
    pixels = plain.pixels(x)[0].at[2].set(jnp.array([-0.9, -0.9]))
    after = corrected(sight, plain, pixels, jnp.ones(7, dtype=bool))
    assert float(jnp.linalg.norm(after.x.p - x.p)) < 0.02


# ---- learning, and flying


@pytest.mark.usefixtures("optax_promotion")
def test_learns_to_see(white, key):
    """A hundred small steps: the error falls; the output layer and the limits are as they were."""
    policy = Policy.of(white.size, small(), key=key, hidden=(16,))
    learnt, errors = represent(policy, white, key, steps=100, batch=32)
    assert errors.shape == (100,)
    assert float(errors[-10:].mean()) < 0.75 * float(errors[:5].mean())
    jax.tree.map(np.testing.assert_array_equal, learnt.layers[-1], policy.layers[-1])
    jax.tree.map(
        np.testing.assert_array_equal,
        (learnt.u_hover, learnt.u_min, learnt.u_max),
        (policy.u_hover, policy.u_min, policy.u_max),
    )
    assert [l.weight.shape for l in learnt.layers] == [l.weight.shape for l in policy.layers]
    for before, after in zip(policy.layers[:-1], learnt.layers[:-1], strict=True):
        assert float(jnp.abs(after.weight - before.weight).max()) > 0.01


@pytest.mark.parametrize("honest", [True, False])
def test_simulation_and_flight_see_the_same(honest, white, key):
    """Noise and lost points included: the pilot, given the states of a roll-out, issues its very commands."""
    seen = replaced(white, honest=honest, noise=jnp.array(1.0), dropout=jnp.array(0.1))
    task = Hover(jnp.array(GOAL), seen, jnp.array(5.0), jnp.array(0.3), 0.02, 12)
    policy = Policy.of(seen.size, small(), key=key, hidden=(8,))
    policy = jax.tree.map(lambda leaf: leaf + 0.02, policy)
    x0 = Start(jnp.array(0.0), State(jnp.array([0.6, 0.2, 1.2]), jnp.eye(3), jnp.array([0.5, 0.0, 0.0])))
    simulated = eqx.filter_jit(rollout)(PointMass(0.02), task, policy, x0)
    pilot = ControllerPilot(PolicyController(seen, policy))
    for k in range(task.horizon):
        x = jax.tree.map(lambda leaf, k=k: leaf[k], simulated.x)
        u = pilot(Measurement(k * 0.02, x, Command.hover()))
        np.testing.assert_allclose(u.vector(), Command(simulated.u.c[k], simulated.u.omega[k]).vector(), rtol=1e-7)
    assert np.ptp(np.asarray(simulated.u.c)) > 1e-3
