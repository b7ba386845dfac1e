"""One process learns for many vehicles: each gets the result of a separate learner and delays no other one."""

import pickle
import subprocess
import time
from dataclasses import replace
from functools import partial
from operator import ne

import jax
import numpy as np
import pytest
from jax import random

from live.test_live_learner import LearnerRig, start  # noqa: F401
from retrim.adapt.batched_workers import room_for
from retrim.config.setup import Setup
from retrim.io.policies import load_learner_state, save_learner_state
from retrim.live.processes import fleet as fleet_process
from retrim.live.processes import fleet_learner
from retrim.live.processes.fleet import FleetProcess
from retrim.live.processes.fleet_learner import FleetLearner
from retrim.live.processes.learner import LearnerPlan
from retrim.onboard.messages import pack_note

pytestmark = pytest.mark.usefixtures("optax_promotion")
SEEDS = {"a": 1, "b": 2, "c": 3, "d": 4, "e": 5, "f": 6}


def plan_of(start, layer, seed):  # noqa: F811
    path, controller, _ = start
    return LearnerPlan(path.parent, layer, path, None, seed, controller.base, 0)


@pytest.fixture
def vehicles(start):  # noqa: F811
    return {name: LearnerRig(start) for name in "abc"}


def fleet_for(vehicles, start, layer):  # noqa: F811
    clock = vehicles["a"]
    fleet = FleetLearner(lambda: clock.now)
    for name, vehicle in vehicles.items():
        fleet.add(name, plan_of(start, layer, SEEDS[name]), vehicle.bus)
    return fleet


def read_parameters(vehicle, layer):
    return jax.tree.leaves(vehicle.parameters(layer).arrays)


@pytest.mark.parametrize("layer", ["residual", "policy"])
def test_batched_updates_equal_separate_updates(start, vehicles, layer):  # noqa: F811
    """The results are equal up to rounding; a batch of three uses the program for four."""
    for i, vehicle in enumerate(vehicles.values()):
        vehicle.fly(60 + 10 * i)
    assert fleet_for(vehicles, start, layer).step() == 3
    for name, vehicle in vehicles.items():
        together = read_parameters(vehicle, layer) if vehicle.bus.latest(f"parameters.{layer}") else None
        single = LearnerRig(start)
        single.fly(60 + 10 * list(SEEDS).index(name))
        loop = type(single).learner(single, layer)
        loop.plan = plan_of(start, layer, SEEDS[name])
        loop.worker = loop.new_worker()
        assert loop.step()
        separate = read_parameters(single, layer) if single.bus.latest(f"parameters.{layer}") else None
        assert (together is None) == (separate is None)
        for one, other in zip(together or (), separate or (), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-8)
    assert any(vehicle.bus.latest(f"parameters.{layer}") for vehicle in vehicles.values())


def test_late_vehicles_do_not_delay_others(start, vehicles):  # noqa: F811
    vehicles |= {name: LearnerRig(start) for name in "def"}
    fleet = fleet_for(vehicles, start, "residual")
    for name in "acd":
        vehicles[name].fly()
    assert fleet.step() == 3
    for name in "bef":
        assert vehicles[name].bus.latest("parameters.residual") is None
        vehicles[name].fly()
    assert fleet.step() == 3
    for name in "bef":
        assert vehicles[name].parameters("residual").version == 1
    assert fleet.step() == 0


def test_learning_continues_after_vehicle_leaves(start, vehicles):  # noqa: F811
    vehicles["d"] = LearnerRig(start)
    fleet = fleet_for(vehicles, start, "residual")
    fleet.drop("b")
    fleet.drop("unknown")
    for vehicle in vehicles.values():
        vehicle.fly()
    assert fleet.step() == 3
    assert vehicles["b"].bus.latest("parameters.residual") is None


def test_updates_of_departed_vehicles_are_not_published(start, vehicles):  # noqa: F811
    fleet = FleetLearner(lambda: vehicles["a"].now)
    for name, vehicle in vehicles.items():
        fleet.add(name, plan_of(start, "residual", SEEDS[name]), vehicle.bus, partial(ne, name, "a"))
        vehicle.fly()
    assert fleet.step() == 3
    assert [vehicle.bus.latest("parameters.residual") is not None for vehicle in vehicles.values()] == [
        False,
        True,
        True,
    ]


def test_low_rank_vehicles_share_base_until_rollback(start, tmp_path):  # noqa: F811
    path, controller, _ = start
    _, preset = load_learner_state(path)
    setup = Setup.from_preset(preset)
    state = setup.learner.init(setup.low_rank(setup.new_policy(random.key(0)), random.key(1)), random.key(2))
    save_learner_state(tmp_path / "start.safetensors", state, preset)
    vehicles = {name: LearnerRig((tmp_path / "start.safetensors", controller, state)) for name in "ab"}
    fleet = fleet_for(vehicles, (tmp_path / "start.safetensors", controller, state), "policy")
    for vehicle in vehicles.values():
        vehicle.fly()
    assert fleet.step() == 2
    (base,) = fleet._bases.values()
    admitted = [vehicle for vehicle in vehicles.values() if vehicle.bus.latest("parameters.policy") is not None]
    shift = np.abs(np.asarray(base.policy.layers[0].weight - state.policy.policy.base.layers[0].weight)).max() > 0
    assert shift == bool(admitted)  # a step without an accepted update is undone
    fleet.loops["a"].rolled_back += 1
    before = id(base)
    for vehicle in vehicles.values():
        vehicle.fly()
        fleet.loops["a"]._pending = fleet.loops["b"]._pending = None
    vehicles["a"].now += 100.0
    fleet.step()
    assert id(next(iter(fleet._bases.values()))) != before


def test_warm_up_compiles_program_for_each_batch_size(start, vehicles, monkeypatch):  # noqa: F811
    sizes = []
    monkeypatch.setattr(fleet_learner, "learn_together", lambda workers, windows: sizes.append(len(workers)))
    fleet = fleet_for(vehicles, start, "residual")
    fleet.warm_up()
    assert sizes == [1, 2, 4]
    fleet.warm_up()
    assert sizes == [1, 2, 4]
    assert [room_for(n) for n in (1, 2, 3, 4, 5, 16, 17)] == [1, 2, 4, 4, 8, 16, 32]


def test_fleet_process_follows_added_and_removed_plans(start, vehicles, tmp_path, monkeypatch):  # noqa: F811
    buses = {f"{i:06d}-residual": vehicle.bus for i, vehicle in enumerate(vehicles.values(), start=1)}
    monkeypatch.setattr(fleet_process, "SharedMemoryBus", lambda folder: buses[folder.name])
    monkeypatch.setattr(fleet_learner, "learn_together", lambda workers, windows: [])
    process = FleetProcess(tmp_path)
    monkeypatch.setattr(fleet_process, "launch", lambda *_: subprocess.Popen(["sleep", "60"]))
    plan, seats = plan_of(start, "residual", 1), []
    for name in buses:
        seats.append(
            process.start("residual", LearnerPlan(tmp_path / name, *list(vars(plan).values())[1:]), tmp_path / name)
        )
    assert {path.stem for path in tmp_path.glob("*.plan")} == set(buses)
    assert pickle.loads(seats[0].path.read_bytes()).folder == tmp_path / "000001-residual"
    fleet, done = FleetLearner(), set()
    fleet_process._look(fleet, tmp_path, done)
    assert set(fleet.loops) == set(buses)
    seats[0].kill()
    buses["000002-residual"].publish("ended", pack_note("ended", reason="landed"))
    (tmp_path / "noise.plan").write_bytes(b"")
    fleet_process._look(fleet, tmp_path, done)
    assert set(fleet.loops) == {"000003-residual"}
    assert done == {"000002-residual"}
    assert [seat.poll() for seat in seats] == [None] * 3
    bad = process.start("residual", replace(plan, start=tmp_path / "nothing"), tmp_path / "bad")
    monkeypatch.setattr(fleet_process, "SharedMemoryBus", lambda folder: buses["000003-residual"])
    fleet_process._look(fleet, tmp_path, done)
    assert bad.poll() == 1  # the ground station is informed of a failed process
    assert set(fleet.loops) == {"000003-residual"}
    process.close()
    assert [seat.poll() for seat in seats] == [-9] * 3


def test_fleet_uses_monotonic_clock():
    assert FleetLearner()._clock is time.monotonic
