"""RAPTOR as an onboard method: its network equals that of its package, and its motors are those of the plant."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from commands import results, retrim
from helpers import GOAL, hover_task, tiny_preset
from retrim import ConfigError, Scenario, Setup
from retrim.evaluation import Fleet
from retrim.evaluation.metrics import record
from retrim.physics import Command, ExternalEffects, State, kingfisher, so3
from retrim.physics.bem import BemQuadrotor
from retrim_paper.raptor.plant import RaptorNet, RaptorQuadrotor

foundation_policy = pytest.importorskip("foundation_policy")


@pytest.fixture(scope="module")
def net():
    return RaptorNet.load()


@pytest.fixture(scope="module")
def policies():
    return Setup.from_preset(tiny_preset()).new_policy(random.key(0))


def test_network_equals_package(net, key):
    theirs, hidden = foundation_policy.Raptor(), net.start
    theirs.reset()
    step = jax.jit(lambda hidden, o: net(hidden, o))
    for o in np.asarray(random.normal(key, (30, 22)), dtype=np.float32):
        action, hidden = step(hidden, jnp.asarray(o, dtype=float))
        np.testing.assert_allclose(action, theirs.evaluate_step(o[None])[0], atol=2e-5)


@pytest.fixture(scope="module")
def sample_flight(net):
    """Return states after some seconds of hover, by the heading of the goal and the external command."""

    def fly(x0, heading, outside):
        here = hover_task().setpoint(jnp.array(0.0))
        model = RaptorQuadrotor(BemQuadrotor.of(kingfisher(), 0.02), net, lambda t: here._replace(heading=heading))
        calm = ExternalEffects.calm(x0.p.dtype)

        def tick(s, _):
            s, _ = lax.scan(lambda s, _: (model.substep(s, outside, calm), None), s, length=20)
            return s, model.state(s)

        return lax.scan(tick, model.init(x0), length=200)[1]

    return jax.jit(fly)


def test_hovers_with_goal_heading_and_ignores_external_commands(sample_flight):
    x0 = State.at(jnp.array(GOAL) + jnp.array([0.6, -0.4, 0.3]))
    path = sample_flight(x0, jnp.array(0.5), Command.hover(float))
    assert float(jnp.max(jnp.linalg.norm(path.p[-50:] - jnp.array([GOAL]), axis=1))) < 0.15
    heading = jnp.arctan2(path.R[-1, 1, 0], path.R[-1, 0, 0])
    assert abs(float(heading) - 0.5) < 0.2
    other = sample_flight(x0, jnp.array(0.5), Command(jnp.array(3.0), jnp.array([2.0, -2.0, 1.0])))
    np.testing.assert_array_equal(other.p, path.p)


def test_flight_is_equivariant_to_heading(sample_flight):
    """If goal, vehicle and heading are rotated about the vertical, the path is rotated by the same angle."""
    turn, offset = 1.1, jnp.array([0.5, 0.2, -0.2])
    Q = so3.rotz(jnp.array(turn))
    at = jnp.array(GOAL)
    path = sample_flight(State.at(at + offset), jnp.array(0.0), Command.hover(float))
    x0 = State(at + Q @ offset, Q, jnp.zeros(3))
    turned_flight = sample_flight(x0, jnp.array(turn), Command.hover(float))
    np.testing.assert_allclose(turned_flight.p - at[None], (path.p - at[None]) @ Q.T, atol=1e-5)


def test_flies_as_method_without_rate_commands(policies):
    preset = tiny_preset(vehicle="kingfisher")
    fleet = Fleet(preset, policies, [Scenario()], methods=["raptor"], starts=2, seconds=4.0)
    flights = fleet.run().flights
    assert [flight.log.terminated for flight in flights] == [False, False]
    assert all(flight.error[-1] < 0.3 for flight in flights)
    assert record(flights[0])["rates_rms"] is None


@pytest.mark.parametrize(
    ("scenario", "text"), [(Scenario(plant="simple"), "only plant 'bem'"), (Scenario(sensors="rough"), "'ideal'")]
)
def test_unsupported_scenario_is_refused_before_flight(scenario, text, policies):
    with pytest.raises(ConfigError, match=text):
        Fleet(tiny_preset(), policies, [scenario], methods=["raptor"])


def test_flies_with_other_methods_by_its_command(tmp_path, monkeypatch, as_a_user):
    table = importlib.import_module("retrim_paper.tables.raptor")  # the package exports a function of that name
    monkeypatch.setattr(table, "DISTURBANCES", {"none": "calm"})
    words = "--methods", "raptor", "--vehicles", "kingfisher", "--seeds", "0", "--starts", "1"
    retrim("reproduce", "raptor", *words, "--seconds", "2", "--out", "t", cwd=tmp_path)
    rows = results(tmp_path / "t", "raptor.json")["rows"]
    assert [(row["vehicle"], row["method"], row["n"]) for row in rows] == [("kingfisher", "raptor", 1)] * 2
    assert "| RAPTOR |" in (tmp_path / "t" / "raptor.md").read_text()
