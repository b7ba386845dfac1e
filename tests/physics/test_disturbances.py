"""Disturbances are finite in every dtype, additive and repeatable, and have their stated statistics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from helpers import call, random_state
from retrim.config.disturbances import DISTURBANCES
from retrim.physics import (
    BatterySag,
    BemQuadrotor,
    Command,
    Constant,
    Disturbance,
    Dryden,
    ExternalEffects,
    Fan,
    LinearDragQuadrotor,
    Payload,
    Push,
    RandomWalk,
    RotorState,
    State,
    SteadyWind,
    SumOfDisturbances,
    Turbulence,
    WeakRotor,
    small,
)
from retrim.physics.propeller import Inflow
from retrim.physics.vehicle import payload_inertia
from retrim.physics.wind import FEET

SHAPES = {"push": (3,), "wind": (3,), "gain": (4,), "mass": (), "inertia": (3,), "moment": (3,)}


def at(*p):
    return State.at(jnp.array(p, dtype=float))


def over(disturbance, times, x=None):
    """Return the effects at many times."""
    x = at(0.0, 0.0, 1.0) if x is None else x
    return jax.jit(jax.vmap(lambda t: disturbance(t, x)))(jnp.asarray(times, dtype=x.p.dtype))


def assert_equal(a, b, **tolerance):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **tolerance), a, b)


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("name", DISTURBANCES)
def test_every_disturbance_is_finite(name, double):
    """Effects have the right shapes and the dtype of the state, with jit and vmap, in flight and after an hour."""
    with jax.enable_x64(double):
        disturbance = DISTURBANCES[name](random.key(1), None)
        assert isinstance(disturbance, Disturbance)
        times = [*np.arange(0.0, 12.0, 0.05), 100.0, 3600.0]  # a kick lasts 0.1 s
        result = over(disturbance, times, at(1.9 if name == "downwash" else 0.3, -0.2, 1.0))
        for field, shape in SHAPES.items():
            value = getattr(result, field)
            assert value.shape == (len(times), *shape)
            assert value.dtype == (jnp.float64 if double else jnp.float32)
            assert np.isfinite(value).all()
        calm = ExternalEffects.calm(result.push.dtype)
        quiet = jax.tree.map(lambda leaf, calm: np.array_equal(leaf, np.broadcast_to(calm, leaf.shape)), result, calm)
        assert all(jax.tree.leaves(quiet)) == (name == "none")


def test_sum_adds_forces_and_multiplies_gains(key):
    t, x = jnp.array(1.0), random_state(key)
    parts = (
        Constant(jnp.array([1.0, 2.0, 3.0])),
        SteadyWind(jnp.array([3.0, 0.0, 0.0])),
        Payload.of(0.07),
        WeakRotor.of(0, 0.9),
        WeakRotor.of(0, 0.5),
        Constant(jnp.array([1.0, 0.0, 0.0])),
    )
    both = SumOfDisturbances(parts)(t, x)
    np.testing.assert_allclose(both.push, [2.0, 2.0, 3.0])
    np.testing.assert_allclose(both.wind, [3.0, 0.0, 0.0])
    np.testing.assert_allclose(both.gain, [0.45, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(both.inertia, payload_inertia(0.07))
    assert_equal(SumOfDisturbances(parts[::-1])(t, x), both)
    assert_equal(SumOfDisturbances(())(t, x), ExternalEffects.calm(x.p.dtype))


def test_push_from_function(key):
    x = random_state(key)
    result = Push(lambda t, x: t * x.v)(jnp.array(2.0), x)
    assert_equal(result, ExternalEffects.of(x.p.dtype, push=2.0 * x.v))


# ---- random walk


def test_random_walk_stays_within_bounds_and_is_continuous(key):
    walk = RandomWalk.of(2.0, 1.0, key=key, n=600)
    push = over(walk, np.arange(0.0, 59.9, 0.01)).push
    np.testing.assert_array_equal(push[0], 0.0)
    assert 0.95 < jnp.abs(push).max() <= 1.0  # it is reflected at the bounds
    per_step = jnp.abs(jnp.diff(walk.points, axis=0)).max()
    assert jnp.abs(jnp.diff(push, axis=0)).max() <= 0.1 * per_step * (1 + 1e-9)
    np.testing.assert_allclose(push[::10], walk.points[:599], atol=1e-9)


def test_random_walk_has_stated_variance(key):
    ends = jax.vmap(lambda k: RandomWalk.of(0.5, 100.0, key=k, n=41).points)(random.split(key, 2000))
    np.testing.assert_allclose(jnp.std(ends[:, 10], axis=0), 0.5, rtol=0.06)  # after one second
    np.testing.assert_allclose(jnp.std(ends[:, 40], axis=0), 1.0, rtol=0.06)  # after four seconds


def test_random_walk_is_periodic_and_symmetric(key):
    walk = RandomWalk.of(0.5, 1.0, key=key, n=101)  # 10 s
    assert_equal(walk, RandomWalk.of(0.5, 1.0, key=key, n=101))
    assert not np.allclose(walk.points, RandomWalk.of(0.5, 1.0, key=random.key(1), n=101).points)
    t = np.linspace(0.0, 10.0, 50)
    assert_equal(over(walk, 20.0 - t), over(walk, t), atol=1e-9)
    assert_equal(over(walk, 20.0 + t), over(walk, t), atol=1e-9)


@pytest.mark.parametrize("bad", [{"bound": 0.0}, {"rate": -1.0}, {"every": 0.0}, {"n": 1}])
def test_invalid_walks_are_refused(bad, key):
    with pytest.raises(ValueError, match=r"RandomWalk: bound and every must be positive.*, got bound"):
        RandomWalk.of(**{"rate": 0.5, "bound": 1.0, "key": key, **bad})


# ---- wind

AXES = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])  # along (3, 4, 0), across, up
V, L, SIGMA = 5.0, np.array([20.0, 10.0, 5.0]), np.array([1.0, 2.0, 0.5])


@pytest.fixture
def turbulence(key):
    return Turbulence.of(jnp.array(V), jnp.asarray(L), jnp.asarray(SIGMA), key=key)


def test_turbulence_has_stated_variance_and_zero_mean(turbulence, key):
    gusts = jax.jit(jax.vmap(turbulence))(random.uniform(key, (40_000,), maxval=1e6))
    np.testing.assert_allclose(jnp.std(gusts, axis=0), SIGMA, rtol=0.02)
    np.testing.assert_allclose(jnp.mean(gusts, axis=0) / SIGMA, 0.0, atol=0.02)
    assert np.abs(np.corrcoef(np.asarray(gusts).T) - np.eye(3)).max() < 0.03


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_turbulence_has_dryden_spectra(turbulence, axis):
    """The energy below a frequency equals that of the integrated spectrum (MIL-F-8785C)."""
    l, result = L[axis] / V, np.asarray(turbulence.rate[:, axis])
    for limit in (0.3 / l, 1.0 / l, 3.0 / l, 10.0 / l):
        w = np.linspace(0.0, limit, 20_001)
        along = 2.0 * l / np.pi / (1.0 + (l * w) ** 2)
        across = l / np.pi * (1.0 + 3.0 * (l * w) ** 2) / (1.0 + (l * w) ** 2) ** 2
        assert np.mean(result < limit) == pytest.approx(np.trapezoid(across if axis else along, w), abs=1.1 / 64)


def test_dryden_wind_is_along_its_mean(key):
    dryden = Dryden.of(jnp.array([3.0, 4.0, 0.0]), key=key)
    times = random.uniform(key, (40_000,), maxval=1e6)
    gusts = over(dryden, times).wind @ AXES.T - np.array([[5.0, 0.0, 0.0]])
    level = 0.5 / (0.177 + 0.00823) ** 0.4
    np.testing.assert_allclose(jnp.std(gusts, axis=0), [level, level, 0.5], rtol=0.02)
    np.testing.assert_allclose(jnp.mean(gusts, axis=0), 0.0, atol=0.03)
    np.testing.assert_allclose(gusts[0], dryden.turbulence(times[0]), atol=1e-9)  # along, across, up


@pytest.mark.parametrize(
    ("mean", "altitude"), [((0, 0, 0), 10.0), ((0, 0, 5), 10.0), ((3, 0, 1), 10.0), ((3, 0, 0), 9.0 * FEET)]
)
def test_invalid_dryden_parameters_are_refused(mean, altitude, key):
    with pytest.raises(ValueError, match=r"Dryden: mean = .* must be horizontal and not zero"):
        Dryden.of(jnp.array(mean, dtype=float), key=key, altitude=altitude)


def fan(key, **changes):
    options = {"speed": 6.0, "width": 0.3, "intensity": 0.0, **changes}
    return Fan.of(jnp.array([1.0, 2.0, 1.0]), jnp.array(options.pop("direction", (3.0, 4.0, 0.0))), key=key, **options)


def jet(fan, along, off=0.0):
    """Return the wind without gusts, in the axes of the jet, at points relative to the outlet."""
    p = np.stack(np.broadcast_arrays(np.atleast_1d(along), off, 0.0), axis=1) @ AXES
    return jax.jit(jax.vmap(lambda p: fan(jnp.array(0.0), State.at(fan.outlet + p)).wind))(jnp.asarray(p)) @ AXES.T


def test_jet_decays_and_is_zero_behind_fan(key):
    along = np.array([0.5, 1.0, 2.0, 4.0])
    wind = jet(fan(key), along)
    np.testing.assert_allclose(wind[:, 0], 6.0 * 0.3 / (0.3 + 0.1 * along), rtol=1e-3)
    np.testing.assert_allclose(wind[:, 1:], 0.0, atol=1e-12)
    np.testing.assert_allclose(jet(fan(key), [-0.9, -3.0]), 0.0, atol=1e-3)
    assert float(jet(fan(key), 1.0, 2.0)[0, 0]) < 1e-3


def test_speed_at_outlet(key):
    assert float(jet(fan(key), 0.0)[0, 0]) == pytest.approx(6.0, rel=0.05)


def test_jet_conserves_momentum(key):
    off = np.linspace(0.0, 5.0, 2001)
    flux = [np.trapezoid(jet(fan(key), along, off)[:, 0] ** 2 * off, off) for along in (1.0, 2.0, 4.0)]
    np.testing.assert_allclose(flux, flux[0], rtol=1e-3)


def test_jet_has_stated_turbulence(key):
    jet, times, two_metres = fan(key, intensity=0.2), random.uniform(key, (40_000,), maxval=1e6), at(2.2, 3.6, 1.0)
    wind = over(jet, times, two_metres).wind @ AXES.T / (6.0 * 0.3 / 0.5)
    np.testing.assert_allclose(jnp.mean(wind, axis=0), [1.0, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(jnp.std(wind, axis=0), 0.2, rtol=0.05)
    np.testing.assert_allclose(wind[0] - np.array([1.0, 0.0, 0.0]), jet.turbulence(times[0]), atol=1e-4)


@pytest.mark.parametrize("bad", [{"speed": 0.0}, {"width": -1.0}, {"intensity": 1.0}, {"direction": (0.0, 0.0, 1.0)}])
def test_invalid_fans_are_refused(bad, key):
    with pytest.raises(ValueError, match=r"Fan: speed and width must be positive.*, got speed"):
        fan(key, **bad)


@jax.jit
def acceleration(model, effects):
    """Return the acceleration of a hovering vehicle after the inflow has settled."""
    x, zero = at(0.0, 0.0, 1.0), jnp.zeros(3)
    motors = jnp.sqrt(model.vehicle.mass * 9.81 / (4.0 * model.loop.thrust_map)) * jnp.ones(4)
    body = RotorState(x, zero, motors, zero, zero)
    inflow = jax.tree.map(lambda leaf: jnp.full(4, leaf), Inflow.above(motors.dtype))
    inflow = lax.fori_loop(0, 8, lambda _, inflow: model.rotors(body, motors, inflow, effects.wind)[1], inflow)
    blades, _ = model.rotors(body, motors, inflow, effects.wind)
    return model.loads(body, motors, blades, effects).force / model.vehicle.mass


def test_wind_acts_through_aerodynamics():
    """The acceleration is downwind, 0.3 to 1 m/s^2 for every m/s; the wind has no other effect on the model."""
    effects = SteadyWind(jnp.array([2.0, -1.0, 0.0]))(jnp.array(0.0), at(0.0, 0.0, 1.0))
    np.testing.assert_array_equal(effects.push, 0.0)
    rate = np.asarray(acceleration(BemQuadrotor.of(small(), 0.02), effects)[:2]) / np.array([2.0, -1.0])
    assert (rate > 0.3).all()
    assert (rate < 1.0).all()


# ---- loads and failures


def test_payload_is_picked_up_and_dropped():
    mass = over(Payload.of(0.07, picked=8.0, dropped=20.0), [0.0, 7.99, 8.0, 19.99, 20.0]).mass
    np.testing.assert_allclose(mass, [0.0, 0.0, 0.07, 0.07, 0.0])
    assert float(over(Payload.of(0.07), [1e6]).mass[0]) == pytest.approx(0.07)  # never dropped
    for mass, pick_time, drop_time in ((0.0, 0.0, 1.0), (0.1, 2.0, 2.0), (0.1, 3.0, 1.0)):
        with pytest.raises(ValueError, match="Payload: mass = "):
            Payload.of(mass, picked=pick_time, dropped=drop_time)


def step_from_rest(model, x, u, effects):
    return model.rotor_state(model.substep(model.init(x), u, effects))


@pytest.mark.parametrize("ahead", [0.05, -0.08])
@pytest.mark.parametrize("kind", [LinearDragQuadrotor, BemQuadrotor])
def test_off_centre_load_shifts_centre_of_mass(kind, ahead):
    """The torque about the common centre of mass is that of the thrusts with shifted arms."""
    model, place = kind.of(small(), 0.02, thrust_error=0.0), at(0.0, 0.0, 1.0)
    off, under = (Payload.of(0.07, ahead=a)(jnp.array(0.0), place) for a in (ahead, 0.0))
    under = dataclasses.replace(under, inertia=off.inertia)
    u = Command(jnp.array(9.81), jnp.zeros(3))
    after = [call(step_from_rest, model, place, u, effects) for effects in (off, under)]
    torque = np.asarray((small().inertia + off.inertia) * (after[0].omega - after[1].omega)) / 1e-3
    lift = float(small().mass + 0.07) * (float(after[1].x.v[2]) / 1e-3 + 9.80665)
    shift = 0.07 * ahead / float(small().mass + 0.07)
    np.testing.assert_allclose(torque, [0.0, shift * lift, 0.0], atol=1e-3 * abs(shift * lift))  # nose down


def test_battery_sags_to_minimum():
    gain = over(BatterySag(jnp.array(0.01), jnp.array(0.8)), [0.0, 10.0, 20.0, 1e4]).gain
    np.testing.assert_allclose(gain, np.tile([[1.0], [0.9], [0.8], [0.8]], 4))
    for rate, floor in ((-0.1, 0.8), (0.1, 0.0), (0.1, 1.1)):
        with pytest.raises(ValueError, match="BatterySag: rate = "):
            BatterySag(jnp.array(rate), jnp.array(floor))


@pytest.mark.parametrize(("rotor", "share"), [(4, 0.9), (-1, 0.9), (0, 0.0), (0, 1.1)])
def test_invalid_rotors_are_refused(rotor, share):
    with pytest.raises(ValueError, match="WeakRotor: rotor = "):
        WeakRotor.of(rotor, share)
