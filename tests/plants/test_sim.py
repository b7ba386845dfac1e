"""The simulated plant: command delay, disturbances, and measurements in addition to the state."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import CheapModel
from retrim.config.sensors import SENSORS
from retrim.physics import BemQuadrotor, Command, Constant, LinearDragQuadrotor, Push, State, small, so3
from retrim.plants import SensorModel, SimPlant

START = State.at(jnp.array([0.3, -0.2, 1.5]))
CALM = Constant(jnp.zeros(3))
MODELS = {"bem": BemQuadrotor, "simple": LinearDragQuadrotor}
WILD = Command(jnp.array(12.0), jnp.array([1.0, -0.5, 0.3]))


def simulate(model="simple", **options):
    return SimPlant(MODELS[model].of(small(), 0.02), CALM, **options)


def fly_once(delay_s, ticks=40):
    plant = simulate(delay_s=delay_s)
    plant.reset(START)
    return [plant.step(Command(jnp.array(9.81), jnp.array([1.0, 0.0, 0.0])))[0].x.R for _ in range(ticks)]


def test_delay_shifts_response():
    now, late, later = fly_once(0.0), fly_once(0.02), fly_once(0.04)
    np.testing.assert_allclose(late[1:], now[:-1], atol=1e-12)
    np.testing.assert_allclose(later[2:], now[:-2], atol=1e-12)
    between = fly_once(0.025)  # not a whole tick: between one and two
    angle = lambda Rs: float(Rs[4][2, 1])  # noqa: E731
    assert angle(later) < angle(between) < angle(late)


@pytest.mark.parametrize("delay_s", [-0.01, float("nan"), float("inf")])
def test_invalid_delays_are_refused(delay_s):
    with pytest.raises(ValueError, match="finite, non-negative number of seconds"):
        simulate(delay_s=delay_s)


@pytest.mark.parametrize("delay_s", [0.0, 0.001, 0.02, 0.0213, 0.035, 0.0996, 0.2, 0.25])
@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_delay_is_exact_in_each_millisecond(dt, delay_s):
    """The commands in the model equal those of a clock that counts microseconds."""
    plant = SimPlant(CheapModel(dt), CALM, delay_s=delay_s)
    ticks, per_tick = round(0.3 / dt), round(1e3 * dt)
    commands = 9.81 + np.arange(1.0, ticks + 1)
    queue, result = plant.simulation.launch(START).queue, []
    arriving = eqx.filter_jit(lambda queue, delay: queue.substeps(delay, dt, per_tick))
    for c in commands:
        queue = queue.push(Command(jnp.array(c), jnp.zeros(3)))
        result.append(np.asarray(arriving(queue, plant.simulation.delay).c))
    edges = np.arange(ticks * per_tick * 1000)  # [us]
    acting = np.concatenate([np.full(round(1e6 * delay_s), 9.81), np.repeat(commands, round(1e6 * dt))])[: len(edges)]
    np.testing.assert_allclose(np.concatenate(result), acting.reshape(-1, 1000).mean(axis=1), rtol=1e-9)


def test_new_delay_needs_no_compilation():
    traces = []

    def calm(t, x):
        traces.append(t)
        return jnp.zeros(3)

    disturbance, counts = Push(calm), []
    for delay_s in (0.0, 0.02, 0.0374, 0.2):
        plant = SimPlant(CheapModel(0.02), disturbance, delay_s=delay_s)
        plant.reset(START)
        plant.step(Command.hover())
        counts.append(len(traces))
    assert counts[0] > 0
    assert len(set(counts)) == 1


def test_disturbance_accelerates():
    push = jnp.array([0.5, 0.0, 0.0])
    plant = SimPlant(LinearDragQuadrotor.of(small(), 0.02), Constant(push))
    plant.reset(START)
    for _ in range(5):
        measurement, _ = plant.step(Command.hover())
    assert float(measurement.x.v[0]) == pytest.approx(0.05, rel=0.05)


def test_function_of_time_and_state_is_a_disturbance():
    plant = SimPlant(
        LinearDragQuadrotor.of(small(), 0.02), Push(lambda t, x: -10.0 * x.v + jnp.where(t < 0.1, 1.0, 0.0))
    )
    plant.reset(START)
    for _ in range(100):
        measurement, _ = plant.step(Command.hover())
    assert np.isfinite(measurement.x.vector()).all()


# ---- measurements


@pytest.mark.parametrize("name", MODELS)
def test_rates_acceleration_and_rotor_speeds_are_consistent(name):
    """Rates rotate the attitude, the acceleration changes the velocity, and the rotors balance the weight at hover."""
    plant = simulate(name)
    first = plant.reset(START)
    np.testing.assert_array_equal(first.omega, 0.0)
    np.testing.assert_array_equal(first.a, 0.0)
    model = MODELS[name].of(small(), 0.02)
    np.testing.assert_allclose(first.motor_speeds, model.rotor_state(model.init(START)).motors)
    before = first
    for _ in range(10):
        measurement, _ = plant.step(WILD)
        np.testing.assert_allclose(measurement.a, (measurement.v - before.v) / 0.02, atol=1e-9)
        omega = so3.log(before.R.T @ measurement.R) / 0.02  # the mean over the tick
        low, high = jnp.minimum(before.omega, measurement.omega), jnp.maximum(before.omega, measurement.omega)
        assert bool(jnp.all((omega > low - 0.1) & (omega < high + 0.1)))
        before = measurement
    np.testing.assert_allclose(measurement.omega, WILD.omega, atol=0.35)
    assert bool(jnp.all(measurement.motor_speeds > first.motor_speeds))


def test_rotor_speeds_give_thrust():
    """For the simple model, 4 c_T Omega^2 (1 + thrust error) = m c after the motors have settled."""
    vehicle, plant = small(), simulate()
    plant.reset(START)
    for _ in range(25):
        measurement, _ = plant.step(Command(jnp.array(11.0), jnp.zeros(3)))
    thrust = float(jnp.sum(vehicle.thrust_coefficient * measurement.motor_speeds**2))
    assert thrust == pytest.approx(11.0 * float(vehicle.mass), rel=1e-3)


def test_first_sample_has_same_noise_as_others():
    sensors = SensorModel.of(position=0.01, gyro=0.1, accelerometer=0.5)
    firsts = [simulate(sensors=sensors, seed=seed).reset(START) for seed in range(60)]
    errors = np.stack([m.x.p for m in firsts]) - np.asarray(START.p)
    np.testing.assert_allclose(errors.std(), 0.01, rtol=0.25)
    for m in firsts:
        jax.tree.map(np.testing.assert_array_equal, m.truth, START)
    np.testing.assert_allclose(np.stack([m.omega for m in firsts]).std(), 0.1, rtol=0.25)
    np.testing.assert_allclose(np.stack([m.a for m in firsts]).std(), 0.5, rtol=0.25)


def test_inertial_noise_has_stated_deviation():
    """The noise is new at every tick, and does not affect the state or the motion."""
    sensors = SensorModel.of(gyro=0.05, accelerometer=0.4)
    noisy, exact = simulate(sensors=sensors), simulate()
    pairs = [(noisy.reset(START), exact.reset(START))]
    pairs += [(noisy.step(Command.hover())[0], exact.step(Command.hover())[0]) for _ in range(400)]
    for name, sigma in (("omega", 0.05), ("a", 0.4)):
        error = np.stack([np.asarray(getattr(m, name)) - np.asarray(getattr(true, name)) for m, true in pairs])
        np.testing.assert_allclose(error.std(axis=0), sigma, rtol=0.15)
        np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=4 * sigma / 20)
        assert np.abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 0.2
    for m, true in pairs:
        jax.tree.map(np.testing.assert_array_equal, (m.x, m.motor_speeds), (true.x, true.motor_speeds))


@pytest.mark.parametrize(("name", "age"), [("mocap", 0.0), ("rough", 0.01)])
def test_measurement_has_its_age(name, age):
    plant = simulate(sensors=SENSORS.find(name)())
    assert plant.reset(START).age == age
    assert plant.step(WILD)[0].age == age


def test_clock_of_long_flight_is_exact_in_single_precision():
    """A sum of ticks would drift by milliseconds in a minute, and so would the tracking error."""
    model = CheapModel(0.02)
    specific_force = Push(lambda t, x: t * jnp.ones(3, jnp.float32))
    simulation = SimPlant(model, specific_force, delay_s=0.0).simulation
    x0 = State.at(jnp.array([0.0, 0.0, 1.0], jnp.float32))
    launch = simulation.launch(x0)
    advance = eqx.filter_jit(simulation.advance)
    for tick in (0, 2999, 89_999):
        after = advance(launch, Command.hover(jnp.float32), tick)
        now = simulation.time(tick + 1, jnp.float32)
        assert now.dtype == jnp.float32
        np.testing.assert_allclose(now, 0.02 * (tick + 1), rtol=2e-7)
        np.testing.assert_allclose(after.a, 0.02 * (tick + 0.475), rtol=1e-5, atol=1e-4)  # mean time of 20 substeps
