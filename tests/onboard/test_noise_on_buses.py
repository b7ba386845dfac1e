"""On every bus, data that are not parameters of this controller are refused without a crash."""

import numpy as np
import pytest

from bus_ends import LOCAL, NETWORK, await_message, two_ends
from live_helpers import hover_source
from retrim.onboard.messages import Parameters
from retrim.onboard.parameter_receiver import ParameterReceiver
from retrim.onboard.pilot import LivePilot

EACH, FEWER = 1000, 200  # messages of a kind; the bus does not look into them, and a network is slower


@pytest.mark.parametrize("backend", [*LOCAL, *NETWORK])
def test_mutated_parameters_and_random_bytes_are_refused(backend):
    rng, source = np.random.default_rng(11), hover_source()
    count = 2 * (EACH if backend in LOCAL else FEWER)
    whole = Parameters("policy", 99, source.base, 0.0, {"gains": np.array([-9.0, -9.0])}).pack()
    room = {"parameters.policy": 10_000}
    for writer, reader in two_ends(backend, room):
        pilot = LivePilot(source)
        pilot.reset(np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)]))
        intake, version = ParameterReceiver(pilot, reader, source.base, 0.02), 0
        for i in range(count):
            data = _mutate(whole, rng) if i % 2 else rng.bytes(int(rng.integers(0, 2000)))
            writer.publish("parameters.policy", data)
            version = await_message(reader, "parameters.policy", version).version
            intake.poll(0.02 * i)
        assert pilot.versions == {"policy": 0}
        assert sum(intake.refusals.values()) == count
        writer.publish("parameters.policy", Parameters("policy", 1, source.base, 0.0, {"gains": np.ones(2)}).pack())
        await_message(reader, "parameters.policy", version)
        intake.poll(99.0)
        assert pilot.versions == {"policy": 1}


def _mutate(whole, rng):
    """Return the message with some changed bytes or without its end; it always differs from the original."""
    data = bytearray(whole)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(data)))
        data[at] = (data[at] + int(rng.integers(1, 256))) % 256
    return bytes(data[: int(rng.integers(len(data)))] if rng.random() < 0.3 else data)
