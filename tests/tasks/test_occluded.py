"""Keypoints with occlusion: hidden points are not observed, and corrections of the filter are not motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import GOAL, replace_fields, stack_trees
from keypoint_steps import begin, near_state, pixels_of, rotation, see, small_commands, step
from retrim.physics import Command, State, small, so3
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.tasks import Keypoints, L2Hover, OccludedKeypoints
from retrim.tasks.view import ViewHover

SURE = 1e-12 * np.eye(12)


def full(noise=0.0):
    return Keypoints.of(jnp.array(GOAL), small().omega_max, whitened=False, noise=noise)


def observe(noise=0.0, dropout=0.0, **options):
    return OccludedKeypoints(full(noise), jnp.array(dropout), **options)


def partly_visible_state():
    """Return a state with some points visible."""
    return State(jnp.array([0.9, 0.0, 1.0]), jnp.eye(3), jnp.zeros(3))


def exact_memory(observation, x):
    """Return the memory of a filter that starts from the true state, so that only its prediction has an error."""
    memory = begin(observation, x)
    ago = 0.02 * np.arange(12.0, -1.0, -1.0)
    poses = stack_trees([replace_fields(x, p=jnp.asarray(np.asarray(x.p) - s * np.asarray(x.v))) for s in ago])
    return memory._replace(pose=replace_fields(memory.pose, x=x, P=jnp.asarray(SURE)), poses=poses)


def test_observation_without_occlusion_equals_training(key):
    """All five frames, the flags and the commands are compared, for a vehicle that follows Eq. (1)."""
    x, last, hidden, plain = near_state(), Command.hover(), observe(), full()
    memory, model = begin(plain, x), exact_memory(hidden, x)
    a_tick_ago = jnp.asarray(np.asarray(x.p) - 0.02 * np.asarray(x.v))
    model = model._replace(pose=replace_fields(model.pose, x=replace_fields(x, p=a_tick_ago)))
    model = model._replace(poses=jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[[0, *range(12)]]), model.poses))
    for u in small_commands(key, 14):
        expected, memory = see(plain, memory, x, last)
        result, model = see(hidden, model, x, last)
        x, last = step(x, u), u
    np.testing.assert_array_equal(result[70:77], 1.0)
    np.testing.assert_allclose(result, expected, atol=2e-4)


def test_only_points_in_image_are_observed():
    """The estimate uses the points inside the image; those outside may have any position."""
    hidden, x = observe(), partly_visible_state()
    pixels, inside = map(np.asarray, pixels_of(hidden.full, x))
    np.testing.assert_array_equal(inside, ~(np.abs(pixels) > 1.0).any(axis=1))
    assert 0 < int(inside.sum()) < 7
    memory = begin(hidden, x)
    _, after = see(hidden, memory, x, Command.hover())

    @eqx.filter_jit
    def correct(full, pose, display, inside):
        prior = pose.predict(Command.hover(), 0.02)
        return prior.correct(full.camera, full.ground(), display, inside, 1.0 / full.camera.size)

    for stray in (0.0, 0.7):
        display = np.where(inside[:, None], pixels, pixels + stray)
        by_hand = correct(hidden.full, memory.pose, jnp.asarray(display), jnp.asarray(inside))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), after.pose, by_hand)


def test_missed_points_are_not_observed(key):
    """If all points are missed, the position has no effect; if half are missed, the uncertainty grows."""
    never, memory = observe(dropout=1.0), begin(observe(dropout=1.0), near_state())
    here, _ = see(never, memory, near_state(), Command.hover())
    there, _ = see(never, memory, partly_visible_state(), Command.hover())
    np.testing.assert_array_equal(here, there)
    doubt = {}
    for dropout in (0.0, 0.5):
        memory = begin(observe(), near_state())
        for _ in range(4):
            _, memory = see(observe(dropout=dropout), memory, near_state(), Command.hover())
        doubt[dropout] = float(jnp.trace(memory.pose.P[:3, :3]))
    assert doubt[0.5] > 1.1 * doubt[0.0]


def test_correction_is_not_motion():
    """An initial error of 20 cm and 6 degrees is corrected at the first observation, in all five frames."""
    x, hidden = State.at(jnp.array([0.1, 0.1, 1.2])), observe()
    off = State(jnp.array([0.25, 0.0, 1.3]), rotation(jnp.array([0.05, -0.05, 0.08])), x.v)
    memory = begin(hidden, off)
    memory = memory._replace(pose=replace_fields(memory.pose, x=off, d=jnp.zeros(3)), poses=stack_trees([off] * 13))
    o, _ = see(hidden, memory, x, Command.hover())
    frames = np.asarray(o[:70]).reshape(5, 14)
    np.testing.assert_allclose(frames, np.repeat(np.reshape(pixels_of(full(), x)[0], (1, 14)), 5, axis=0), atol=0.02)
    assert np.ptp(frames, axis=0).max() < 0.02


def blind_velocity_error(observation, us, delay):
    """Fly a point mass whose commands act ``delay`` ticks late, for the last half without visible points.

    Returns the error of the filter's velocity after each tick [m/s].
    """
    x, last, errors = State.at(jnp.array(GOAL)), Command.hover(), []
    memory, acting = exact_memory(observation, x), [Command.hover()] * delay
    for u in us:
        _, memory = see(observation, memory, x, last)
        errors.append(np.linalg.norm(np.asarray(memory.pose.x.v) - np.asarray(x.v)))
        acting.append(u)
        x, last = step(x, acting.pop(0)), u
    return np.array(errors)


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_filter_predicts_with_delayed_command(delay):
    """No point is visible: the filter follows the true velocity exactly only with the declared delay.

    After a step of thrust and roll, the wrong command acts for the difference of the delays.
    """
    us = [Command.hover()] * 6 + [Command(jnp.array(13.0), jnp.array([1.5, 0.0, 0.0]))] * 6
    declaration = {max(delay - 1, 0), delay, min(delay + 1, 3)}
    result = {d: blind_velocity_error(observe(dropout=1.0, delay_ticks=d), us, delay) for d in declaration}
    assert result[delay].max() < 1e-9
    for d, errors in result.items():
        assert errors[:6].max() < 1e-9  # in hover every delay is equivalent
        if d != delay:
            assert errors[-1] > 0.05


def test_wrong_delay_degrades_filter_with_visible_points():
    """With visible points the filter is corrected, and still follows a step of commands less accurately."""
    us = [Command.hover()] * 6 + [Command(jnp.array(14.0), jnp.zeros(3)), Command(jnp.array(6.0), jnp.zeros(3))] * 5
    right, wrong = (blind_velocity_error(observe(delay_ticks=d), us, delay=1).max() for d in (1, 0))
    assert right < 1e-3
    assert wrong > 20.0 * right


def test_invalid_delays_are_refused():
    for delay in (-1, 4):
        with pytest.raises(ValueError, match=rf"delay_ticks = {delay} must be 0 to 3"):
            observe(delay_ticks=delay)


@eqx.filter_jit
def observed_and_slope(observation, memory, x):
    def show(p):
        return observation(memory, jnp.array(0.0), replace_fields(x, p=p), Command.hover())[0]

    return show(x.p), jax.jacobian(show)(x.p)


@pytest.mark.parametrize("place", [(0.05, -0.1, 1.1), (4.0, 0.0, 0.3)])
def test_occlusion_is_finite_without_gradient(place):
    """The observation is finite at every position of the vehicle, and has no gradient."""
    x = State(jnp.array(place), rotation(jnp.array([0.1, 0.5, 0.0])), jnp.array([0.3, 0.0, 0.0]))
    hidden = observe(noise=1.0, dropout=0.1)
    o, slope = observed_and_slope(hidden, begin(hidden, x), x)
    assert np.isfinite(o).all()
    np.testing.assert_array_equal(slope, 0.0)


@pytest.mark.parametrize("d", [(0.0, 0.0, 0.0), (1.0, -0.5, 1.5)])
def test_camera_in_frame_sees_level_ground(d):
    """With a correct pose estimate, a camera in the world shows the image of a camera in the frame, in all frames."""
    frame, before = EffectiveGravityFrame.of(jnp.array(d)), near_state()
    x = step(before, Command.hover())
    inside = full().in_frame(frame)
    hovering = frame.command(Command.hover())
    soon = replace_fields(before, p=before.p + 0.02 * before.v)  # a memory is one tick old
    expected, _ = see(inside, begin(inside, frame.state(soon)), frame.state(x), hovering)
    hidden = observe()
    result, after = see(hidden.in_frame(frame), exact_memory(hidden, before), frame.state(x), hovering)
    np.testing.assert_allclose(result[:77], expected[:77], atol=1e-5)
    np.testing.assert_allclose(result[85:], expected[85:], atol=1e-9)  # the last command, as issued by the policy
    np.testing.assert_allclose(after.pose.x.p, x.p, atol=1e-5)  # the filter is in the world frame


def test_visible_points_are_rewarded():
    """There is no penalty while every point is well inside; farther outside it grows, with a gradient."""
    plain, task = (
        kind(jnp.array(GOAL), full(), jnp.array(5.0), jnp.array(0.3), 0.02, 10) for kind in (L2Hover, ViewHover)
    )

    @jax.jit
    def penalty(x):
        return plain.reward(jnp.array(0.0), x, Command.hover()) - task.reward(jnp.array(0.0), x, Command.hover())

    tilts = [
        replace_fields(State.at(jnp.array([0.0, 0.0, 1.3])), R=rotation(jnp.array([a, 0.0, 0.0])))
        for a in (0.0, 0.8, 1.1)
    ]
    level, some, more = (float(penalty(x)) for x in tilts)
    assert level == 0.0
    assert 0.0 < some < more
    slope = jax.jit(jax.grad(lambda a: penalty(replace_fields(tilts[0], R=so3.exp(a * jnp.array([1.0, 0.0, 0.0]))))))(
        0.8
    )
    assert 0.0 < float(slope) < np.inf
