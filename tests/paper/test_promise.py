"""The promise table: pairs of flights, bounds by the better of base policy and observer, and no credit for chance."""

import pytest

from fake_flights import flight
from retrim import Scenario
from retrim.runkit import FlightSpec
from retrim_paper.tables.promise import promise_rows, promise_section


def flights(**errors):
    """Return flights by method and start: steady-state errors [m], None for a crash."""
    result = []
    for method, by_start in errors.items():
        for start, error in enumerate(by_start):
            spec = FlightSpec(Scenario("small"), method.replace("_", "-"), start)
            result.append(flight(3.0 if error is None else error, spec=spec, terminated=error is None))
    return result


def row(**errors):
    (result,) = promise_rows({"late": flights(**errors)})
    return result


def test_bound_uses_better_of_base_and_observer():
    result = row(base=[0.10, 0.20], base_do=[0.02, 0.04], full=[0.03, 0.04])
    assert result["bound"] == pytest.approx(1.2 * 0.03 + 0.005)
    assert result["steady"] == pytest.approx(0.035)
    assert result["holds"]
    assert not row(base=[0.10], base_do=[0.02], full=[0.03])["holds"]
    assert row(base=[0.02], base_do=[None], full=[0.0289])["holds"]
    assert not row(base=[0.02], base_do=[None], full=[0.0291])["holds"]


def test_crash_counts_if_base_policy_survives_same_start():
    result = row(base=[None, 0.1], base_do=[0.1, 0.1], full=[0.05, None])
    assert (result["crashes"], result["crashes_base"], result["crashed_although_base_survived"]) == (1, 1, 1)
    assert not result["holds"]
    assert row(base=[None, 0.1], base_do=[0.1, 0.1], full=[None, 0.1])["holds"]


def test_all_adaptive_methods_and_conditions_have_row_and_text():
    group = flights(base=[0.1], base_do=[0.1], full=[0.05], lora=[None])
    rows = promise_rows({"late": group, "gaps": group})
    assert [(r["scenario"], r["method"]) for r in rows] == [
        ("late", "full"), ("late", "lora"), ("gaps", "full"), ("gaps", "lora"),
    ]  # fmt: skip
    text = "\n".join(promise_section(rows).markdown())
    assert text.count("**no**") == 2
    assert "| 1 of 1 | 0 of 1 | 1 | – |" in text
