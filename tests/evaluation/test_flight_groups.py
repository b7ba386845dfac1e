"""Flights of an interrupted table are stored bit for bit until the table is complete."""

import jax
import numpy as np
import pytest

from fake_flights import Watching
from helpers import brief_preset
from retrim import CheckpointError, Scenario, Setup
from retrim.evaluation import batches
from retrim.evaluation.flight_groups import FLIGHTS, clear_flights
from retrim.evaluation.study import Study, fly_all
from retrim.runkit import Run, provenance
from retrim.runkit.flight_codec import flight_codec
from retrim.runkit.reporter import Silent

pytestmark = pytest.mark.usefixtures("as_a_user")

CALM, PUSH = Scenario(plant="simple"), Scenario("large", plant="simple")


@pytest.fixture(scope="module")
def study():
    preset = brief_preset()
    policies = {seed: Setup.from_preset(preset).new_policy(jax.random.key(seed)) for seed in (0, 1)}
    return Study(preset, policies, ())


def fly_once(study, folder, *, methods=("base", "indi"), reporter=None, starts=2):
    """Fly in a folder as a new run; return the flights, and the number of stored groups before."""
    run = Run("test", folder)
    message = Silent() if reporter is None else reporter
    flights = fly_all(study, [CALM, PUSH], run, message, methods=methods, starts=starts, seconds=1.0)
    return flights, run.reused


def bits(flights):
    """Return all data of flights except the learner states, with arrays as bytes."""
    parts = [(f.spec, f.vehicle, f.metric, f.steady_seconds, f.log, f.error, f.cross, f.target) for f in flights]
    return [leaf.tobytes() if isinstance(leaf, np.ndarray) else leaf for leaf in jax.tree.leaves(parts)]


@pytest.fixture(scope="module")
def whole(study, tmp_path_factory):
    return fly_once(study, tmp_path_factory.mktemp("whole"))[0].flights


def test_flights_survive_file(whole, tmp_path):
    specs, path = [flight.spec for flight in whole], tmp_path / "flights.npz"
    flight_codec(specs).write(path, whole)
    assert bits(flight_codec(specs).read(path)) == bits(whole)
    with pytest.raises(CheckpointError, match="other specifications"):
        flight_codec(specs[1:]).read(path)


def test_interrupted_table_is_completed_and_equal(study, whole, tmp_path):
    stop = Run("test", tmp_path)
    watching = Watching(lambda share: share >= 0.5 and stop.stop.set())
    some = fly_all(study, [CALM, PUSH], stop, watching, methods=("base", "indi"), starts=2, seconds=1.0)
    files = list((tmp_path / FLIGHTS).iterdir())
    assert some.interrupted
    assert 0 < len(files) < 4
    watching = Watching()
    flights, earlier = fly_once(study, tmp_path, reporter=watching)
    assert earlier == len(files)
    assert not flights.interrupted
    assert bits(flights.flights) == bits(whole)
    watching = Watching()
    flights, earlier = fly_once(study, tmp_path, reporter=watching)
    assert (earlier, watching.messages) == (4, [])
    assert bits(flights.flights) == bits(whole)


def test_stored_flights_are_reused_only_for_same_study(study, tmp_path, monkeypatch):
    monkeypatch.setattr(batches, "CPU_LIMIT", 2)  # one program for any number of starts
    extract = lambda study=study, **how: fly_once(study, tmp_path, **how)[1]  # noqa: E731
    assert extract(methods=("base",)) == 0
    assert extract(methods=("indi", "base")) == 2
    assert extract(methods=("base", "base")) == 2
    assert extract(starts=3) == 0
    assert extract(Study(study.preset, {0: study.policies[0], 1: study.policies[0]}, ())) == 0
    assert extract(Study(brief_preset(adapt={"update_every": 0.4}), study.policies, ())) == 0
    for path in (tmp_path / FLIGHTS).iterdir():
        path.write_bytes(path.read_bytes()[:1000])
    assert extract() == 0
    assert extract() == 4
    monkeypatch.setattr(provenance, "code", lambda: "changed")
    assert extract() == 0
    clear_flights(Run("test", tmp_path))
    assert not (tmp_path / FLIGHTS).exists()
    assert extract() == 0
