"""Memory between flights: the next flight starts with the map, and a wrong or damaged memory is harmless."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.config.vehicle_file import VehicleSpec
from retrim.errors import CheckpointError, ConfigError
from retrim.runkit.flight_memory import FlightMemory, recall_flight
from retrim.runkit.flights import Flight, FlightSpec
from retrim.runtime.flight import Log, States
from retrim.transport import wire

GOAL = (0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def setup():
    return Setup.from_preset(tiny_preset(adapt={"residual": "place"}))


@pytest.fixture(scope="module")
def policy(setup):
    return setup.new_policy(random.key(0))


@pytest.fixture(scope="module")
def state(setup, policy):
    """Return a learner state whose map has one bump at the goal."""
    fresh = setup.learner.init(policy, random.key(1))
    place_map, dtype = fresh.residual.map, fresh.residual.agreement.dtype
    weight, information = jnp.array([0.0, 0.0, -2.0]), 1000.0
    learned = dataclasses.replace(
        place_map,
        centres=place_map.centres.at[0].set(jnp.array(GOAL)),
        visited=place_map.visited.at[0].set(3),
        precision=place_map.precision.at[0, 0].set(information),
        moment=place_map.moment.at[0].set(information * weight / setup.learner.residual_model.prior),
        weights=place_map.weights.at[0].set(weight),
    )
    evidence = jnp.array(15.0, dtype=dtype)
    residual = dataclasses.replace(fresh.residual, map=learned, agreement=evidence, prediction=evidence)
    return dataclasses.replace(fresh, residual=residual)


def flight(learner_state, terminated=False):
    """Return a flight of two rows with a learner state at its end."""
    states = States(np.zeros((2, 3)), np.stack([np.eye(3)] * 2), np.zeros((2, 3)))
    log = Log(np.array([0.0, 0.02]), states, states, np.zeros((2, 4)), 0.02, terminated)
    return Flight(
        FlightSpec(Scenario(), "full", 0), "small", log, np.zeros(2), "error", 0.02, learner_state=learner_state
    )


def at_goal(setup, state):
    return np.asarray(setup.learner.residual_model.at_place(state.residual, jnp.array(GOAL)))


def test_next_flight_starts_with_map(tmp_path, setup, policy, state):
    memory = FlightMemory(tmp_path / "hall", "small")
    assert memory.state(setup, policy, "full", 0) is None
    assert "no earlier flight" in memory.describe(setup)
    (file,) = memory.write([flight(state)], setup, [])
    assert file.parent == tmp_path / "hall"
    assert "0.0 h ago" in memory.describe(setup)
    start = memory.state(setup, policy, "full", 0)
    before, after = at_goal(setup, state)[2], at_goal(setup, start)[2]
    assert before < after < 0.5 * before  # a part of the force, until rows of the new flight agree
    np.testing.assert_allclose(start.residual.map.weights, state.residual.map.weights, rtol=0.02)


@pytest.mark.parametrize("method", ["full", "lora"])
def test_restored_state_has_shapes_of_fresh_state(tmp_path, setup, policy, state, method):
    memory = FlightMemory(tmp_path, "small")
    memory.write([flight(state)], setup, [])
    recalled = memory.state(setup, policy, method, 0)
    pilot = setup.pilot(policy, method, random.key(1))
    assert jax.tree.map(jnp.shape, recalled) == jax.tree.map(jnp.shape, pilot.state)


def test_each_vehicle_has_its_own_memory(tmp_path, setup, policy, state):
    FlightMemory(tmp_path, "small").write([flight(state)], setup, [])
    assert FlightMemory(tmp_path, "large").state(setup, policy, "full", 0) is None


def test_map_without_evidence_is_unused(setup, state):
    model = setup.learner.residual_model
    doubtful = dataclasses.replace(state.residual, agreement=jnp.zeros_like(state.residual.agreement))
    assert float(model.recall(doubtful).share) == 0.0


def test_lost_flights_leave_no_memory(tmp_path, setup, state):
    memory, faults = FlightMemory(tmp_path, "small"), []
    assert memory.write([flight(state, terminated=True), flight(None)], setup, faults) == []
    assert list(tmp_path.iterdir()) == []
    assert "unchanged" in faults[0]


def test_unwritable_folder_is_reported_after_flight(tmp_path, setup, state):
    (tmp_path / "hall").touch()
    faults = []
    assert FlightMemory(tmp_path / "hall", "small").write([flight(state)], setup, faults) == []
    assert "cannot be written" in faults[0]


def test_file_instead_of_folder_is_refused_before_flight(tmp_path, setup, policy):
    (tmp_path / "hall").touch()
    with pytest.raises(ConfigError, match="must be a folder"):
        recall_flight(tmp_path / "hall", setup, Scenario(), policy, None, "full", 0, print)


@pytest.mark.parametrize("factor", [100.0, -1e3])
def test_map_with_impossible_accelerations_is_refused(tmp_path, setup, policy, state, factor):
    """The numbers are finite and the checksum is right."""
    place_map = state.residual.map
    changes = {"moment": 1e3 * place_map.moment} if factor > 0 else {"precision": factor * place_map.precision}
    residual = dataclasses.replace(state.residual, map=dataclasses.replace(place_map, **changes))
    memory = FlightMemory(tmp_path, "small")
    memory.write([flight(dataclasses.replace(state, residual=residual))], setup, [])
    with pytest.raises(CheckpointError, match="remove the file"):
        memory.state(setup, policy, "full", 0)


@pytest.mark.parametrize("damage", [lambda data: data[:-9], lambda data: b"MZ" + data[2:], lambda data: b""])
def test_damaged_memory_is_refused_in_one_line(tmp_path, setup, policy, state, damage):
    memory = FlightMemory(tmp_path, "small")
    (file,) = memory.write([flight(state)], setup, [])
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(CheckpointError) as error:
        memory.state(setup, policy, "full", 0)
    assert "\n" not in str(error.value)


def test_model_with_short_memory_is_refused(tmp_path, policy):
    setup = Setup.from_preset(tiny_preset(adapt={"residual": "regression"}))
    with pytest.raises(ConfigError, match="--residual place"):
        FlightMemory(tmp_path, "small").state(setup, policy, "full", 0)


def test_method_without_learning_is_refused(tmp_path, setup, policy):
    with pytest.raises(ConfigError, match="'base' does not"):
        FlightMemory(tmp_path, "small").state(setup, policy, "base", 0)


def test_vehicles_with_equal_file_names_do_not_share_map(tmp_path, setup, policy, state):
    FlightMemory(tmp_path, "my quad").write([flight(state)], setup, [])
    with pytest.raises(CheckpointError, match="'my quad', expected 'my-quad'"):
        FlightMemory(tmp_path, "my-quad").state(setup, policy, "full", 0)


QUAD = VehicleSpec(
    name="quad", mass=0.6, inertia=(0.003, 0.003, 0.005), arm=(0.09, 0.09), thrust_max=24.0, rates_max=(6.0, 6.0, 3.0),
    motor_tau=0.03,
)  # fmt: skip


def test_vehicle_files_with_equal_names_do_not_share_map(tmp_path, setup, policy, state):
    """Two vehicle files may contain the same name; the map of the other vehicle is neither recalled nor replaced."""
    (file,) = FlightMemory(tmp_path, QUAD).write([flight(state)], setup, [])
    before = file.read_bytes()
    assert FlightMemory(tmp_path, dataclasses.replace(QUAD)).state(setup, policy, "full", 0) is not None
    heavy = Scenario(vehicle=dataclasses.replace(QUAD, mass=0.9))
    with pytest.raises(CheckpointError, match=r"must be the memory of this vehicle 'quad', .* remove the file"):
        recall_flight(tmp_path, setup, heavy, policy, None, "full", 0, print)
    assert file.read_bytes() == before


def test_memory_without_digest_is_refused(tmp_path, setup, policy, state):
    """Earlier releases wrote only the name."""
    memory = FlightMemory(tmp_path, "small")
    about = {"vehicle": "small", "residual": "place"}
    memory.path(setup).write_bytes(wire.pack(state.residual, kind="memory", about=about))
    with pytest.raises(CheckpointError, match="remove the file"):
        memory.state(setup, policy, "full", 0)


def test_unwritable_folder_is_refused_before_flight(setup, policy):
    with pytest.raises(ConfigError, match=r"/proc/hall: results cannot be written there .* different --memory"):
        recall_flight(Path("/proc/hall"), setup, Scenario(), policy, None, "full", 0, print)


def test_vehicle_names_cannot_leave_folder(tmp_path, setup):
    assert FlightMemory(tmp_path, "../../other").path(setup).parent == tmp_path
