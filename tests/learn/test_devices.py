"""Pretraining, flights and learning on eight devices equal those on one device, up to rounding."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from retrim.learn.devices import LEAST_WORK, num_shards, shard, suitable_device

HERE = Path(__file__).parent
WORK = """
import sys

import jax
import numpy as np

sys.path.insert(0, "{tests}")
from helpers import tiny_preset
from retrim import Fleet, Scenario, Setup
from retrim.adapt.buffer import RollingBuffer
from retrim.adapt.batched_workers import learn_base, learn_together, shared_base
from retrim.adapt.workers import PolicyWorker
from retrim.physics import Command, State

jax.config.update("jax_enable_x64", True)
assert jax.device_count() == {devices}
soon = {{"window": 20, "fit_every": 0.2, "update_every": 0.3, "fit_latency": 0.1, "update_latency": 0.1}}
small = {{"hidden_sizes": (16, 16), "num_updates": 4, "num_envs": 8, "horizon": 10}}
preset = tiny_preset(pretrain=small, adapt={{"fit_steps": 3, **soon}})
setup, losses = Setup.from_preset(preset), []
for policy, some in setup.pretraining(0):
    losses += [float(loss) for loss in some]
pushed = Scenario("small", plant="simple", sensors="mocap")
fleet = Fleet(preset, policy, [pushed], methods=("full",), starts=8, seconds=1.0)
fleet.make_batches(fleet.specs)
flights = fleet.run().flights
low_rank = setup.low_rank(policy, jax.random.key(0))
state = setup.learner.init(low_rank, jax.random.key(1))
window = RollingBuffer(preset.adapt.window)
window.push(0.0, State.at(setup.flight_task.home()), Command.hover(float))
workers = [PolicyWorker(setup.learner, state, jax.random.key(i)) for i in range(4)]
base = learn_base(workers, [window.window()] * 4, shared_base(workers[0]), jax.random.key(4))
if {devices} > 1:
    learn_together(workers[:3], [window.window()] * 3, base)  # another number of vehicles, other devices
learnt = [jax.tree.leaves(flight.learner_state)[0] for flight in flights]
np.savez(
    "{out}",
    losses=losses,
    weights=policy.layers[0].weight,
    flown=np.stack([flight.log.p for flight in flights]),
    commands=np.stack([flight.log.u for flight in flights]),
    base=base.policy.layers[0].weight,
    learnt=np.stack([np.asarray(leaf) for leaf in learnt]),
    swaps=[len(flight.swaps) for flight in flights],
)
"""


@pytest.fixture(scope="module")
def devices(tmp_path_factory):
    """Return the results of one and of eight devices, computed in parallel in a process each."""
    folder = tmp_path_factory.mktemp("devices")

    def start(devices):
        flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
        code = WORK.format(tests=HERE.parent, devices=devices, out=folder / f"{devices}.npz")
        environment = {**os.environ, "XLA_FLAGS": flags, "JAX_NUMPY_DTYPE_PROMOTION": "standard"}
        return subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE, text=True)

    processes = [start(1), start(8)]
    text = [process.communicate(timeout=400)[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], text
    return [dict(np.load(folder / f"{devices}.npz")) for devices in (1, 8)]


@pytest.mark.slow
def test_pretraining_equals_one_device(devices):
    one, eight = devices
    assert len(one["losses"]) == 4
    np.testing.assert_allclose(eight["losses"], one["losses"], rtol=1e-9)
    np.testing.assert_allclose(eight["weights"], one["weights"], rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_batch_of_flights_equals_one_device(devices):
    one, eight = devices
    assert one["flown"].shape == (8, 51, 3)
    np.testing.assert_allclose(eight["flown"], one["flown"], atol=1e-7)
    np.testing.assert_allclose(eight["commands"], one["commands"], atol=1e-6)


@pytest.mark.slow
def test_fleet_learning_equals_one_device(devices):
    one, eight = devices
    np.testing.assert_array_equal(eight["swaps"], one["swaps"])
    assert one["swaps"].sum() > 0
    np.testing.assert_allclose(eight["learnt"], one["learnt"], atol=1e-6)


@pytest.mark.slow
def test_shared_base_equals_one_device(devices):
    one, eight = devices
    np.testing.assert_allclose(eight["base"], one["base"], atol=1e-7)


@pytest.mark.parametrize(
    ("n", "devices", "count"), [(24, 8, 8), (10, 8, 5), (7, 8, 7), (11, 8, 1), (64, 3, 2), (5, 1, 1)]
)
def test_number_of_devices_divides_work(n, devices, count):
    assert num_shards(n, devices) == count


def test_one_device_moves_no_data():
    tree = {"x": np.ones((4, 2)), "name": "kept"}
    assert shard(tree) is tree
    assert jax.device_count() == 1


def test_small_training_stays_on_cpu(monkeypatch):
    """The CPU itself represents a single accelerator."""
    weights = np.zeros(1000)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "device_count", lambda: 1)
    for starts, device in ((10, jax.devices("cpu")[0]), (LEAST_WORK // 1000, None)):
        with suitable_device({"w": weights, "name": "a policy"}, starts):
            assert jax.config.jax_default_device == device
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    with suitable_device(weights, 10):
        assert jax.config.jax_default_device is None
