"""Scores of flights: their intervals, and the effect of a termination."""

import dataclasses
import sys

import numpy as np
import pytest

from fake_flights import DT, flight, log
from retrim import Scenario
from retrim.evaluation import rows
from retrim.evaluation.metrics import cell, interval, mean_and_deviation, metres
from retrim.runkit import FlightSpec
from retrim.runtime.flight import States
from retrim_paper.tables.further_figures import figures_table


def test_error_is_mean_over_last_seconds():
    error = np.concatenate([np.full(401, 7.0), np.full(100, 0.25)])  # 10 s: rows 401 ... 500 are the last 2 s
    assert flight(error).steady == pytest.approx(0.25)
    assert flight(error[::-1]).steady == pytest.approx(7.0)
    assert flight(error, steady_seconds=4.0).steady == pytest.approx((7.0 + 0.25) / 2)
    # shorter flights: over the whole flight
    assert flight(np.arange(501.0), steady_seconds=60.0).steady == pytest.approx(250.0)


def test_last_seconds_are_by_time_despite_missed_ticks():
    t = np.delete(DT * np.arange(501), np.arange(410, 460))  # a second without measurements
    error = np.where(t > 8.0 + 1e-6, 1.0, 100.0)
    assert flight(error, flight=log(t=t)).steady == pytest.approx(1.0)


def test_peak_is_largest_error_after_five_seconds():
    error = np.zeros(501)
    error[[100, 300, 400]] = 9.0, 3.0, 2.0  # at 2, 6 and 8 s
    assert flight(error).peak == 3.0
    short = np.zeros(151)
    short[[50, 100]] = 9.0, 1.0  # of 3 s: after half of the flight
    assert flight(short, seconds=3.0).peak == 1.0


def test_settling_time_is_start_of_small_error():
    error = np.full(501, 0.01)
    error[:50] = 1.0
    error[200] = 0.2
    assert flight(error).settle_s == pytest.approx(201 * DT)
    assert flight(np.full(501, 0.01)).settle_s == 0.0
    assert flight(np.full(501, 0.3)).settle_s == np.inf


def test_terminated_flight_has_no_score():
    crashes = flight(0.001, terminated=True)
    assert np.isnan(crashes.steady)
    assert crashes.peak == np.inf
    assert crashes.settle_s == np.inf


def test_mean_excludes_and_median_includes_terminated_flights():
    result = [flight(0.1), flight(0.3), flight(0.01, terminated=True)]
    (row,) = rows(result)
    assert (row["n"], row["crashes"]) == (3, 1)
    assert row["mean"] == pytest.approx(0.2)
    assert row["std"] == pytest.approx(np.std([0.1, 0.3], ddof=1))
    assert row["median"] == pytest.approx(0.3)  # of 0.1, 0.3, infinity
    assert row["errors"] == [pytest.approx(0.1), pytest.approx(0.3), None]
    assert cell(row) == "0.200 ± 0.141, 1 of 3 crashed"
    (row,) = rows([result[0], result[2], result[2]])
    assert row["median"] is None
    assert row["peak_after_5s"] is None
    (row,) = rows(result[2:])
    assert (row["mean"], row["std"], cell(row)) == (None, None, "crashed, 1 of 1")
    (row,) = rows(result[:1])
    assert (row["std"], cell(row)) == (None, "0.100")


def test_rows_per_scenario_method_and_optionally_seed():
    specs = [
        FlightSpec(Scenario(name), method, 0, seed)
        for name in ("none", "wind=3")
        for method in ("base", "full")
        for seed in (4, 5)
    ]
    result = [flight(float(i), spec=spec) for i, spec in enumerate(specs)]
    assert [(row["disturbance"], row["method"], row["mean"]) for row in rows(result)] == [
        ("none", "base", 0.5), ("none", "full", 2.5), ("wind=3", "base", 4.5), ("wind=3", "full", 6.5)
    ]  # fmt: skip
    by_seed = rows(result, by_seed=True)
    assert [(row["seed"], row["mean"]) for row in by_seed] == [(4 + i % 2, float(i)) for i in range(8)]


def test_cross_track_error_is_mean_over_last_seconds():
    cross = np.concatenate([np.full(401, 5.0), np.full(100, 0.5)])
    (row,) = rows([flight(1.0, cross=cross)])
    assert row["cross_track_m"] == pytest.approx(0.5)
    assert "cross_track_m" not in rows([flight(1.0)])[0]


def test_rows_become_data_frame_with_pandas(monkeypatch):
    result = rows([flight(0.1), flight(0.3)])
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pandas"):
        result.to_pandas()
    monkeypatch.undo()
    pytest.importorskip("pandas")
    table = result.to_pandas()
    assert list(table["mean"]) == [pytest.approx(0.2)]
    assert list(table.columns) == list(result[0])


@pytest.mark.parametrize(
    ("late_s", "lap", "result"), [(0.1, 6.0, 0.1), (2.2, 6.0, 2.2), (-0.4, 6.0, -0.4), (1.9, 2.0, -0.1)]
)
def test_lag_of_flight_is_recovered(late_s, lap, result):
    """On a circle flown late, only the lag remains of the error; of shifts one lap apart, the smallest is returned."""
    t = DT * np.arange(1001)

    def path(t):
        angle = 2.0 * np.pi * t / lap
        return np.stack([np.cos(angle), np.sin(angle), np.ones_like(t)], axis=1)

    trajectory = log(20.0)
    true = States(path(t - late_s), *trajectory.true[1:])
    late = flight(1.0, flight=trajectory._replace(true=true), cross=np.zeros(1001), steady_seconds=10.0)
    late = dataclasses.replace(late, target=path(t))
    behind, error = late.behind
    assert behind == pytest.approx(result)
    assert error == pytest.approx(0.0, abs=1e-9)
    assert dataclasses.replace(late, cross=None).behind is None  # no reference


def test_smallest_lag_is_returned_despite_repeating_error():
    """For a flight without lag whose error repeats each lap, a shift by one lap is not better."""
    t, trajectory = DT * np.arange(1001), log(20.0)
    angle = 2.0 * np.pi * t / 3.0
    path = np.stack([np.cos(angle), np.sin(angle), np.ones_like(t)], axis=1)
    off = np.stack([np.zeros_like(t), np.zeros_like(t), 0.2 + 0.1 * np.sin(angle + 0.4)], axis=1)
    true = States(path + off, *trajectory.true[1:])
    setup = flight(1.0, flight=trajectory._replace(true=true), cross=np.zeros(1001), steady_seconds=10.0)
    behind, error = dataclasses.replace(setup, target=path).behind
    assert behind == 0.0
    assert error == setup.steady  # over all of the last seconds, not only the comparable ones


def test_effort_follows_from_commands():
    trajectory = log(10.0)
    u = np.array(trajectory.u)
    u[::2, 1], u[1::2, 1] = 0.3, -0.3
    rates, change = flight(0.0, flight=trajectory._replace(u=u)).effort
    assert (rates, change) == pytest.approx((0.3, 0.6))


def test_interval_accounts_for_correlation_within_seed():
    """The same twelve errors belong to twelve seeds, or to three seeds with four similar flights each."""

    def records(seeds):
        return [
            {"seed": seed, "error": error} for seed, error in zip(seeds, np.repeat([0.1, 0.2, 0.3], 4), strict=True)
        ]

    low, high = interval(records(range(12)))
    wide_low, wide_high = interval(records(np.repeat([0, 1, 2], 4).tolist()))
    assert 0.1 < low < 0.2 < high < 0.3
    assert wide_low < low
    assert high < wide_high
    assert interval([{"seed": 0, "error": None}]) is None
    assert interval([{"seed": 0, "error": 0.5}]) == [0.5, 0.5]


def test_errors_below_a_millimetre_have_one_more_digit():
    (row,) = rows([flight(0.0004), flight(0.0002)])
    assert cell(row) == "0.0003 ± 0.0001"
    assert cell(row, digits=5) == "0.00030 ± 0.00014"
    assert [metres(value) for value in (0.00096, 0.001, 0.0123, np.inf)] == ["0.0010", "0.001", "0.012", "inf"]


def test_small_error_is_not_shown_as_zero():
    (row,) = rows([flight(0.00001), flight(0.00002)])
    assert cell(row) == "< 0.0001"
    assert [metres(value) for value in (0.0, 4.9e-5, 5.1e-5)] == ["< 0.0001", "< 0.0001", "0.0001"]
    (row,) = rows([flight(0.00001), flight(0.0, terminated=True)])
    assert cell(row) == "< 0.0001, 1 of 2 crashed"
    (row,) = rows([flight(0.004)])
    assert cell(row, digits=2) == "< 0.01"


def test_mean_with_deviation_is_not_shown_as_zero():
    assert mean_and_deviation(np.array([0.1, 0.3])) == "0.200 ± 0.141"
    assert mean_and_deviation(np.array([2e-4, 4e-4])) == "0.0003 ± 0.0001"
    assert mean_and_deviation(np.array([0.25])) == "0.250 ± 0.000"
    assert mean_and_deviation(np.array([1e-5, 2e-5])) == "< 0.0001"


def test_other_lengths_are_not_shown_as_zero():
    row = {"method": "indi", "disturbance": "large", "interval": [1e-6, 2e-6], "settle_s": 1.52, "peak_after_5s": 1e-5,
           "rates_rms": 0.0, "rates_change_rms": 0.0}  # fmt: skip
    wide = row | {"method": "full", "interval": [1e-6, 0.0123], "peak_after_5s": 0.0123}
    table = figures_table([row, wide, row | {"interval": None, "peak_after_5s": None}], "Hover", {"large": "large"})
    assert [line[1:4] for line in table.rows] == [
        ("< 0.0001", "1.5", "< 0.0001"), ("< 0.0001 to 0.0123", "1.5", "0.012"), ("-", "1.5", "-"),
    ]  # fmt: skip
