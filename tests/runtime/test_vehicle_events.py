"""The identified vehicle is reported in the first second, equally in a batch of flights and by a single pilot."""

import re

import pytest
from jax import random

from retrim.config import Scenario, Setup, changed, load
from retrim.evaluation.fleet import Fleet
from retrim.runtime.flight import fly

pytestmark = pytest.mark.usefixtures("as_a_user")

VEHICLE = {
    "name": "slow", "mass": 0.32, "inertia": [4e-4, 5e-4, 8e-4], "arm": [0.06, 0.07], "thrust_max": 11.0,
    "rates_max": [10.0, 10.0, 4.0], "motor_tau": 0.03, "rate_lag": [0.1, 0.1, 0.1], "rate_damping": [1.0, 1.0, 1.0],
    "command_delay": 0.05,
}  # fmt: skip
SHORT = {"num_updates": 10, "num_envs": 4, "horizon": 50, "hidden_sizes": (32, 32)}
SECONDS = 1.2


@pytest.fixture(scope="module")
def preset(as_a_user):
    """Return a preset whose vehicle file states twice the true lag and no delay."""
    declaration = {**VEHICLE, "rate_lag": [0.2, 0.2, 0.2], "command_delay": 0.02}
    return changed(load("hover/any"), pretrain=SHORT, vehicle=declaration)


@pytest.fixture(scope="module")
def scenario():
    return Scenario("none", plant="second-order", vehicle=changed(load("hover/any"), vehicle=VEHICLE).vehicle)


def notes(log):
    return [(event.t, event.note) for event in log.events if event.kind == "vehicle"]


def test_batch_and_pilot_report_same_vehicle(preset, scenario):
    setup = Setup.from_preset(preset)
    policy = setup.new_policy(random.key(0))
    (flight,) = Fleet(preset, {0: policy}, [scenario], methods=["base-id"], starts=1, seconds=SECONDS).run().flights
    ((t, note),) = notes(flight.log)
    assert t == pytest.approx(1.0)
    assert re.fullmatch(r"thrust gain .*; rate delay .*(vehicle file: 20 ms, 200 ms\)|not excited)", note), note
    pilot = setup.pilot(policy, "base-id")
    log = fly(scenario.make(), pilot, setup.flight_starts(1, 0)[0], ticks=60)
    assert [when for when, _ in notes(log)] == [pytest.approx(1.0)]
