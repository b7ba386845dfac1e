"""A load on a cable: conservation, pendulum periods, a cable that only pulls, and the Lagrange equations."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import CheapModel
from retrim.config.disturbances import disturbance
from retrim.physics import (
    BemQuadrotor,
    Command,
    Constant,
    Disturbance,
    LinearDragQuadrotor,
    LoadState,
    Payload,
    SlungLoad,
    State,
    SumOfDisturbances,
    small,
    so3,
)
from retrim.physics.disturbance import StatefulDisturbance, advance, start, stateful_parts
from retrim.physics.slung_load import STIFFNESS, swing_angle
from retrim.plants import SimPlant

H, G = 1e-3, 9.81
MODEL = CheapModel()


def at(*p):
    return State.at(jnp.array(p, dtype=float))


def motion(load, s, x, u, times):
    """Return paths of vehicle and load under a constant command, and the tension, as NumPy arrays."""
    return jax.tree.map(np.asarray, paths(load, s, x, u, times))


@jax.jit
def paths(load, s, x, u, times):

    def substep(carry, t):
        x, s = carry
        effects, s = load.advance(s, t, x, H)
        x = MODEL.substep(x, u, effects)
        return (x, s), (x, s, load.tension(s, x))

    return lax.scan(substep, (x, s), times)[1]


def times(seconds, begin=0.0):
    return begin + H * np.arange(round(seconds / H))


def displaced_load(load, angle, x=None, heading=0.0):
    """Return a load at rest relative to the vehicle, on a cable with its static stretch, at an angle."""
    x = at(0.0, 0.0, 2.0) if x is None else x
    length = load.length + G * (1.0 + load.share) / STIFFNESS**2
    q = jnp.array([math.sin(angle) * math.cos(heading), math.sin(angle) * math.sin(heading), -math.cos(angle)])
    return LoadState(x.p + length * q, x.v)


def thrust(c):
    return Command(jnp.array(c), jnp.zeros(3))


def energy(load, x, s):
    """Return the energy of vehicle and load, per mass of the vehicle, including the elastic energy of the cable."""
    share = float(load.share)
    stretch = np.maximum(np.linalg.norm(s.p - x.p, axis=-1) - float(load.length), 0.0)
    elastic = 0.5 * share / (1.0 + share) * (STIFFNESS * stretch) ** 2
    kinetic = 0.5 * np.sum(x.v**2, axis=-1) + 0.5 * share * np.sum(s.v**2, axis=-1)
    return kinetic + G * (x.p[..., 2] + share * s.p[..., 2]) + elastic


def period(signal, seconds):
    """Return the mean distance between zero crossings of the same sign [s]."""
    t = H * np.arange(len(signal))
    at = np.flatnonzero((signal[:-1] < 0.0) & (signal[1:] >= 0.0))
    crossings = t[at] - signal[at] / (signal[at + 1] - signal[at]) * H
    assert len(crossings) > seconds / 3.0
    return float(np.mean(np.diff(crossings)))


# ---- conservation


@pytest.mark.parametrize("share", [0.2, 0.4, 1.0])
def test_free_fall_conserves_momentum_and_energy(share):
    """The pair spins about its centre of mass, which follows a parabola."""
    load = SlungLoad.of(share)
    x = dataclasses.replace(at(0.0, 0.0, 50.0), v=jnp.array([0.3, -0.2, 0.5]))
    s = displaced_load(load, 0.7, x)
    s = dataclasses.replace(s, v=x.v + jnp.array([1.5, 2.0, 0.9]))
    t = times(2.0)
    xs, ss, _ = motion(load, s, x, thrust(0.0), t)
    v0, p0 = (np.asarray(a + share * b) / (1.0 + share) for a, b in ((x.v, s.v), (x.p, s.p)))
    elapsed = (t + H)[:, None]
    fall = np.array([[0.0, 0.0, -G]])
    np.testing.assert_allclose((xs.v + share * ss.v) / (1.0 + share), v0 + fall * elapsed, rtol=0, atol=1e-11)
    centre = p0 + v0 * elapsed + 0.5 * fall * elapsed**2
    np.testing.assert_allclose((xs.p + share * ss.p) / (1.0 + share), centre, rtol=0, atol=1e-10)
    # The radial oscillation from the first stretch is damped; afterwards the energy is constant.
    energies = energy(load, xs, ss)[300:]
    np.testing.assert_allclose(energies, energies[0], rtol=0, atol=1e-4)
    r = ss.p - xs.p
    spin = np.cross(r, ss.v - xs.v)
    first = np.cross(s.p - x.p, s.v - x.v)
    np.testing.assert_allclose(spin, np.tile(first, (len(t), 1)), rtol=2e-3)


def test_energy_of_swinging_load_changes_by_work_of_thrust():
    load, c = SlungLoad.of(0.3), G * 1.3
    x = at(0.0, 0.0, 2.0)
    xs, ss, tension = motion(load, displaced_load(load, 0.5, x), x, thrust(c), times(5.0))
    assert float(tension.min()) > 0.0
    energies = energy(load, xs, ss) - c * xs.p[:, 2]
    np.testing.assert_allclose(energies, energies[0], rtol=0, atol=2e-3)
    assert float(np.ptp(0.5 * np.sum(ss.v**2, axis=1))) > 0.4  # while kinetic energy oscillates


# ---- the pendulum


@pytest.mark.parametrize("length", [0.3, 0.5, 1.0])
@pytest.mark.parametrize("share", [0.2, 0.4])
def test_period_of_small_swing(share, length):
    """For a free vehicle in hover, omega^2 = (1 + share) g / length; for a fixed vehicle, g / length."""
    load, x = SlungLoad.of(share, length=length), at(0.0, 0.0, 2.0)
    s = displaced_load(load, 0.02, x)
    xs, ss, _ = motion(load, s, x, thrust(G * (1.0 + share)), times(8.0))
    expected = 2.0 * math.pi * math.sqrt(length / (G * (1.0 + share)))
    assert period(np.asarray(ss.p - xs.p)[:, 0], 8.0) == pytest.approx(expected, rel=1e-3)

    def hold(s, t):  # the vehicle does not move
        _, s = load.advance(s, t, x, H)
        return s, s.p[0]

    held = np.asarray(lax.scan(hold, s, times(8.0))[1])
    assert period(held, 8.0) == pytest.approx(2.0 * math.pi * math.sqrt(length / G), rel=1e-3)


def test_equilibrium_tension_is_weight():
    load, x = SlungLoad.of(0.3), at(0.0, 0.0, 1.0)
    xs, ss, tension = motion(load, load.init(x), x, thrust(G * 1.3), times(2.0))
    np.testing.assert_allclose(tension, G, rtol=1e-6)
    np.testing.assert_allclose(xs.p[-1], x.p, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(swing_angle)(ss, xs), 0.0, atol=1e-5)
    effects, _ = load.advance(load.init(x), jnp.array(0.0), x, H)
    np.testing.assert_allclose(effects.push, load(jnp.array(0.0), x).push, atol=1e-6)


@pytest.mark.parametrize("angle", [0.1, 0.8])
def test_taut_cable_satisfies_lagrange_equations(angle, key):
    """Compare accelerations with those of two points at a fixed distance, by finite differences of velocities.

    With q the direction of the cable and a_u the acceleration of the vehicle without it, the tension per mass of the
    load is (q . (g - a_u) + length |q'|^2) / (1 + share).
    """
    share, length = 0.35, 0.5
    load = SlungLoad.of(share, length=length)
    x = dataclasses.replace(random_tilt(key), p=jnp.array([0.0, 0.0, 2.0]))
    u = thrust(14.0)
    xs, ss, _ = motion(load, displaced_load(load, angle, x), x, u, times(0.6))
    g = np.array([0.0, 0.0, -G])
    for k in (300, 450, 560):  # after the radial oscillation
        q = np.asarray(ss.p - xs.p)[k]
        r, q = np.linalg.norm(q), q / np.linalg.norm(q)
        q_dot = np.asarray(ss.v - xs.v)[k] / r
        q_dot = q_dot - q * (q @ q_dot)
        a_u = g + 14.0 * np.asarray(xs.R)[k][:, 2]
        pull = (q @ (g - a_u) + length * q_dot @ q_dot) / (1.0 + share)
        for path, expected in ((xs.v, a_u + share * pull * q), (ss.v, g - pull * q)):
            slope = np.asarray(path[k + 1] - path[k - 1]) / (2.0 * H)
            np.testing.assert_allclose(slope, expected, atol=0.03)


def random_tilt(key):
    return State(jnp.zeros(3), so3.exp(0.2 * random.normal(key, (3,))), jnp.array([0.4, -0.3, 0.2]))


def test_motion_is_equivariant_to_heading(key):
    turn = so3.exp(jnp.array([0.0, 0.0, 1.1]))
    load, x = SlungLoad.of(0.3), dataclasses.replace(random_tilt(key), p=jnp.array([0.1, 0.2, 2.0]))
    s = displaced_load(load, 0.4, x, heading=0.5)
    x_turned = State(turn @ x.p, turn @ x.R, turn @ x.v)
    s_turned = LoadState(turn @ s.p, turn @ s.v)
    one, other = (motion(load, s, x, thrust(13.0), times(1.0)) for s, x in ((s, x), (s_turned, x_turned)))
    np.testing.assert_allclose(other[0].p, one[0].p @ np.asarray(turn).T, atol=1e-9)
    np.testing.assert_allclose(other[1].p, one[1].p @ np.asarray(turn).T, atol=1e-9)


# ---- slack


def test_slack_cable_has_no_tension():
    """Vehicle and load fall together until the load, thrown away from the vehicle, tightens the cable."""
    load, x = SlungLoad.of(0.3), at(0.0, 0.0, 20.0)
    s = LoadState(x.p + jnp.array([0.1, 0.0, -0.2]), jnp.array([0.0, 0.0, -1.0]))
    xs, ss, tension = motion(load, s, x, thrust(0.0), times(0.6))
    distance = np.linalg.norm(ss.p - xs.p, axis=1)
    slack = distance < float(load.length)
    begin = int(np.argmin(slack))
    assert 200 < begin < 400  # taut for the first time after about 0.28 s
    np.testing.assert_array_equal(tension[slack], 0.0)
    np.testing.assert_allclose(ss.v[: begin - 1, 2], -1.0 - G * (times(0.6)[: begin - 1] + H), rtol=1e-12)
    np.testing.assert_allclose(xs.p[: begin - 1, 2], 20.0 - 0.5 * G * (times(0.6)[: begin - 1] + H) ** 2, rtol=1e-12)
    assert float(tension.max()) > 10.0  # the jerk
    assert float(tension.min()) == 0.0  # a cable does not push
    assert float(distance.max()) < load.length + 0.01


# ---- pick-up and release


def test_load_is_fixed_before_pick_up_and_falls_after_release():
    load, x = SlungLoad.of(0.3, picked=1.0, dropped=2.0), at(0.0, 0.0, 3.0)
    t = times(3.0)
    xs, ss, _ = motion(load, load.init(x), x, thrust(G), t)
    before, after = t + H < 1.0, t > 2.0
    np.testing.assert_allclose(xs.v[before], 0.0, atol=1e-12)
    np.testing.assert_allclose((ss.p - xs.p)[before], np.tile([[0.0, 0.0, -0.5]], (before.sum(), 1)), atol=1e-12)
    assert float(xs.v[1999, 2]) == pytest.approx(-G * 0.3 / 1.3, rel=0.01)  # the load accelerates the pair
    slopes = np.diff(np.asarray(ss.v)[after][:, 2]) / H
    np.testing.assert_allclose(slopes, -G, rtol=1e-9)
    np.testing.assert_allclose(np.diff(np.asarray(xs.v)[after], axis=0), 0.0, atol=1e-12)
    push = [float(load(jnp.array(t), x).push[2]) for t in (0.5, 1.5, 2.5)]
    np.testing.assert_allclose(push, [0.0, -0.3 * G, 0.0], atol=1e-12)


def test_invalid_loads_are_refused():
    for values in ({"share": 0.0}, {"share": 0.3, "length": 0.0}, {"share": 0.3, "picked": 2.0, "dropped": 2.0}):
        with pytest.raises(ValueError, match="SlungLoad: share = "):
            SlungLoad.of(**values)


# ---- disturbances with a state


def test_sum_contains_states_of_parts():
    load, x = SlungLoad.of(0.3), at(0.0, 0.0, 1.0)
    assert isinstance(load, Disturbance)
    assert isinstance(load, StatefulDisturbance)
    other = SlungLoad.of(0.1, length=0.3)
    total = SumOfDisturbances((Payload.of(0.1), SumOfDisturbances((load, Constant(jnp.ones(3)))), other))
    assert stateful_parts(total) == (load, other)
    states = start(total, x)
    effects, after = advance(total, states, jnp.array(0.0), x, H)
    np.testing.assert_allclose(effects.push, jnp.array([1.0, 1.0, 1.0 - 0.4 * G]), atol=1e-6)
    assert float(effects.mass) == pytest.approx(0.1)
    assert jax.tree.structure(after) == jax.tree.structure(states)
    plain = Constant(jnp.ones(3))
    assert start(plain, x) == ()
    np.testing.assert_array_equal(advance(plain, (), jnp.array(0.0), x, H)[0].push, 1.0)


@pytest.mark.parametrize("kind", [LinearDragQuadrotor, BemQuadrotor])
def test_parts_of_disturbance_change_in_flight(kind):
    """The load of the plant equals that of a flight of its parts, and a push added in flight does not change it."""
    model, x = kind.of(small(), 0.02), at(0.0, 0.0, 1.0)
    plant = SimPlant(model, disturbance("slung-load=0.3"))
    plant.reset(x)
    u = Command(jnp.array(1.3 * G / 1.035), jnp.zeros(3))
    for _ in range(10):
        plant.step(u)
    (before,) = plant._state.disturbance
    plant.disturb(SumOfDisturbances((disturbance("slung-load=0.3"), Constant(jnp.array([2.0, 0.0, 0.0])))))
    assert plant._state.disturbance == (before,)
    for _ in range(10):
        plant.step(u)
    (after,) = plant._state.disturbance
    true = plant.simulation.true(plant._state)
    assert float(swing_angle(after, true)) > 0.03  # the load lags behind the vehicle
    assert float(after.p[0]) < float(true.p[0])
    plant.disturb(Constant(jnp.zeros(3)))
    plant.step(u)
    assert plant._state.disturbance == ()
    plant.disturb(disturbance("slung-load=0.3"))
    plant.step(u)
    assert len(plant._state.disturbance) == 1


def test_loads_support_vmap_and_keep_precision():
    with jax.enable_x64(False):
        loads = jax.vmap(SlungLoad)(jnp.array([0.2, 0.4]), jnp.array([0.5, 0.3]), jnp.zeros(2), jnp.full(2, jnp.inf))
        x = at(0.0, 0.0, 1.0)
        effects, states = jax.vmap(lambda load: load.advance(load.init(x), jnp.array(0.0), x, H))(loads)
        assert {leaf.dtype for leaf in jax.tree.leaves((effects, states))} == {jnp.dtype(jnp.float32)}
        np.testing.assert_allclose(effects.push[:, 2], [-0.2 * G, -0.4 * G], rtol=2e-3)
