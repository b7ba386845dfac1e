"""The page of regimes: verdicts follow from the numbers, every row can be flown, and lost flights are shown."""

import importlib

import numpy as np
import pytest

from commands import results
from retrim.config.methods import find_method
from retrim.config.scenario import Scenario
from retrim.errors import ConfigError
from retrim.evaluation.study import refuse_misfits
from retrim.runkit import Run
from retrim.runkit.flights import Flight, FlightSpec
from retrim.runkit.reporter import Silent
from retrim.runtime.flight import Log, States
from retrim_paper.regimes import fastest_lap_error, height_error_above_table
from retrim_paper.tables.where_learning_pays import OPPONENTS, _cell, _methods, decide, regimes, where_learning_pays

NONE_LOST = dict.fromkeys((*OPPONENTS, "adapted"), 0.0)


def medians(**millimetres):
    names = {"geometric": "geometric + I", "mppi": "MPPI + L1"}
    return {names.get(name, name): value / 1000.0 for name, value in millimetres.items()}


@pytest.mark.parametrize(
    ("figures", "verdict"),
    [
        ({"observer": 20.0, "INDI": 9.0, "adapted": 3.0}, "learning pays: 3.0 times less error than INDI"),
        ({"observer": 0.4, "INDI": 0.1, "adapted": 0.2}, "a tie: INDI is as good and simpler"),
        ({"observer": 9.0, "INDI": 2.0, "adapted": 6.0}, "use INDI here"),
        ({"observer": 9.0, "geometric": 11.0, "adapted": 7.0}, "learning helps a little; observer is simpler"),
    ],
)
def test_verdict_follows_from_numbers(figures, verdict):
    assert decide(medians(**figures), NONE_LOST) == verdict


def test_lost_flights_decide_before_errors():
    figures = medians(observer=5.0, INDI=1.0, adapted=4.0)
    assert decide(figures, NONE_LOST | {"adapted": 0.04}) == "use INDI here: adapted flights are lost"
    losses = NONE_LOST | {"observer": 0.08, "INDI": 0.04}
    assert decide(figures, losses) == "learning pays: every opponent loses flights"
    assert "INDI" not in decide(figures, NONE_LOST | {"INDI": 0.04})


def test_cell_shows_lost_flights_and_millimetres():
    assert _cell(np.array([0.002, 0.002, 0.002])) == "2.0 (2.0 to 2.0)"
    text = _cell(np.array([0.002, 0.003, np.inf]))
    assert text.startswith("3.0 (2.0 to ∞)")
    assert text.endswith("1 of 3 lost")
    assert _cell(np.array([np.inf, np.inf])).startswith("∞")


@pytest.mark.parametrize(("lowest", "touches"), [(0.99, False), (0.97, True)])
def test_contact_with_table_counts_as_loss(lowest, touches):
    """The table is 2 cm below a vehicle at 1 m."""
    p = np.array([[1.5, 0.0, 1.0], [1.5, 0.0, lowest], [1.5, 0.0, 1.0]])
    states = States(p, np.stack([np.eye(3)] * 3), np.zeros((3, 3)))
    log = Log(0.02 * np.arange(3), states, states, np.zeros((3, 4)), 0.02, False)
    spec = FlightSpec(Scenario("table-edge"), "full", 0)
    flight = Flight(spec, "large", log, np.zeros(3), "error", 0.02, target=np.repeat(p[:1], 3, axis=0))
    assert np.isinf(height_error_above_table(flight)) == touches


@pytest.mark.parametrize(("pace", "error"), [(4.0, 0.05), (3.0, np.inf)])
def test_error_of_last_lap_counts_if_lap_is_fast(pace, error):
    """The figure-8 begins its laps of 5 s at 3 s; the first lap has a pace of 1."""
    t = 0.02 * np.arange(1001)
    phase = np.where(t < 10.0, t, 10.0 + pace * (t - 10.0))
    states = States(np.zeros((1001, 3)), np.stack([np.eye(3)] * 1001), np.zeros((1001, 3)))
    log = Log(t, states, states, np.zeros((1001, 4)), 0.02, False, phase=phase)
    spec = FlightSpec(Scenario(reference="figure8=max"), "full", 0)
    flight = Flight(spec, "large", log, np.where(t < 10.0, 0.2, 0.05), "error", 2.0)
    assert fastest_lap_error(flight) == pytest.approx(error)


def test_regimes_have_unique_names_and_registered_methods():
    names = [row.name for row in regimes()]
    assert len(set(names)) == len(names)
    for row in regimes():
        for method in _methods(row, tuple(OPPONENTS)):
            find_method(method)


@pytest.mark.parametrize("row", regimes(), ids=lambda row: row.name)
def test_every_regime_can_be_flown(row):
    refuse_misfits(row.preset, row.scenarios[:1], methods=("base", row.adapted), starts=1, seconds=row.seconds)


@pytest.mark.parametrize("options", [{"only": ("S99",)}, {"columns": ("PID",)}])
def test_wrong_names_are_refused_before_training(tmp_path, options):
    with pytest.raises(ConfigError, match="there are"):
        where_learning_pays(Run("reproduce", tmp_path), Silent(), **options)


def test_sampling_method_flies_at_most_two_starts_per_seed(tmp_path, imagine):
    page = importlib.import_module("retrim_paper.tables.where_learning_pays")
    done = imagine(page, lambda spec: 0.01)
    options = {"only": ("steady wind",), "columns": ("observer", "MPPI + L1"), "seeds": (0, 1), "starts": 5}
    where_learning_pays(Run("reproduce", tmp_path), Silent(), **options)
    requests = [(methods, starts) for *_, methods, starts, _ in done.flights]
    assert requests == [(("base-do", "full"), 5), (("l1-mpc",), 2)]
    rows = results(tmp_path, "where_learning_pays.json")["rows"]
    assert {row["method"]: len(row["score_m"]) for row in rows} == {"base-do": 10, "l1-mpc": 4, "full": 10}
