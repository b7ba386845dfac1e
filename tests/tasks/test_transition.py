"""Transition between references: it is continuous, its ends are the references, and the vehicle can fly it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import at
from retrim.physics import small
from retrim.tasks import Reference, smooth_start
from retrim.tasks.shapes import circle, figure8, figure8_at, star
from retrim.tasks.transition import DURATIONS, LEAD_TIME, splice, transition_between

AT = 7.3


@pytest.fixture(scope="module")
def references():
    return {"circle": circle(), "figure8": figure8(), "star": star()}


@pytest.fixture(scope="module")
def table(references):
    return transition_between(references["circle"], references["figure8"], AT, small())


def rows(reference):
    return np.asarray(reference.rows)


def end_of_transition(table):
    """Return the time at which the old reference is left [s]."""
    return float(table.lap[0])


def test_equals_old_reference_before_and_new_one_after(references, table):
    before = np.linspace(AT - LEAD_TIME, AT - 0.02, 40)
    for leaf, other in zip(at(table, before), at(references["circle"], before), strict=True):
        np.testing.assert_allclose(leaf, other, atol=0.02)  # both are linear between their own rows
    after = end_of_transition(table) + np.linspace(0.0, 20.0, 200)
    np.testing.assert_allclose(at(table, after).p, at(references["figure8"], after - AT).p, atol=1e-3)
    np.testing.assert_allclose(at(table, after).heading, at(references["figure8"], after - AT).heading, atol=1e-9)


@pytest.mark.parametrize("pair", [("circle", "figure8"), ("figure8", "star"), ("star", "circle")])
def test_rates_are_derivatives(references, pair):
    """Velocity, acceleration and jerk equal differences of the lower derivative where both shapes are smooth."""
    table = transition_between(references[pair[0]], references[pair[1]], AT, small())
    t = float(table.since) + float(table.every) * np.arange(rows(table).shape[0])
    flat = rows(table)
    smooth = np.flatnonzero((t > AT + 0.1) & (t < AT + 2.4) & (np.abs(flat[:, 14:17]).max(1) < 60.0))
    smooth = smooth[(smooth > 0) & (smooth < len(t) - 1)]
    for value, rate in ((slice(0, 3), slice(3, 6)), (slice(3, 6), slice(11, 14))):
        result = (flat[smooth + 1, value] - flat[smooth - 1, value]) / (t[smooth + 1] - t[smooth - 1])[:, None]
        assert np.median(np.abs(result - flat[smooth, rate])) < 5e-3
    np.testing.assert_allclose(
        flat[smooth, 6], np.linalg.norm(flat[smooth, 11:14] + np.array([0.0, 0.0, 9.81]), axis=1), rtol=1e-9
    )


def test_sufficient_duration_makes_transition_feasible(references):
    """From rest to the opposite end of a large figure is infeasible in two seconds."""
    far = figure8_at(8.0)
    vehicle = small()
    table = transition_between(references["circle"], far, AT, vehicle)
    assert rows(table)[:, 6].max() <= float(vehicle.command_max.c)
    assert (np.abs(rows(table)[:, 7:10]) <= np.asarray(vehicle.omega_max)).all()
    assert end_of_transition(table) - AT >= DURATIONS[0]


def test_transition_replaces_old_reference_without_compilation(references, table):
    for reference in (table, transition_between(table, references["star"], 20.0, small())):
        for leaf, other in zip(jax.tree.leaves(reference), jax.tree.leaves(references["circle"]), strict=True):
            assert (leaf.shape, leaf.dtype, leaf.weak_type) == (other.shape, other.dtype, other.weak_type)
        assert jax.tree.structure(reference) == jax.tree.structure(references["circle"])


def test_heading_takes_shortest_rotation(references):
    """The old reference has turned by 6 rad and the new one heads along x: the heading turns to 2 pi, not back to 0."""
    turning = Reference.of(lambda t: [0.0, 0.0, 1.0, min(t, 6.0)], seconds=20.0)
    table = transition_between(turning, circle(), 12.0, small())
    late = at(table, end_of_transition(table) + np.array([0.0, 1.0]))
    np.testing.assert_allclose(late.heading, 2.0 * np.pi, rtol=1e-9)


def heading_along_path(fold):
    """Return a circle of 3 s with the heading along the path, wrapped or not."""

    def path(t):
        phi = 2.0 * np.pi * smooth_start(t) / 3.0
        heading = phi - 0.5 * np.pi
        return [1.0 - np.cos(phi), -np.sin(phi), 1.0, np.arctan2(np.sin(heading), np.cos(heading)) if fold else heading]

    return Reference.of(path, seconds=6.0, lap=3.0)


@pytest.mark.parametrize("begins", [7.3, 8.0, 9.1])
@pytest.mark.parametrize("fold", [False, True])
@pytest.mark.parametrize("winds", ["old", "new", "both"])
def test_heading_turns_steadily(references, winds, fold, begins):
    """The rate of the heading is its derivative except for whole turns, also if laps end in the transition."""
    old, new = (
        heading_along_path(fold) if winds in (which, "both") else references["figure8"] for which in ("old", "new")
    )
    table = transition_between(old, new, begins, small())
    t = np.arange(begins - LEAD_TIME, end_of_transition(table) + 7.0, 1e-3)
    result = at(table, t)
    turns = np.remainder(np.diff(result.heading) + np.pi, 2.0 * np.pi) - np.pi
    np.testing.assert_allclose(turns / 1e-3, 0.5 * (result.heading_rate[1:] + result.heading_rate[:-1]), atol=0.1)


def test_roll_outs_start_on_new_lap(references, table):
    np.testing.assert_allclose(table.joins, np.tile(table.lap, (3, 1)))
    once = transition_between(
        references["circle"], Reference.of(lambda t: [0.1 * np.sin(t) ** 4, 0.0, 1.0], seconds=np.pi), 5.0, small()
    )
    assert float(once.lap[0]) == float(once.lap[1]) >= 5.0 + DURATIONS[0]
    np.testing.assert_allclose(at(once, [30.0]).v, 0.0, atol=1e-12)


def test_segments_form_one_reference(references, table):
    whole = splice([(0.0, references["circle"]), (AT - 0.5, table)])
    t = np.linspace(0.0, 30.0, 400)
    early = t < AT - 0.5
    result = at(whole, t)
    np.testing.assert_allclose(result.p[early], at(references["circle"], t[early]).p, rtol=0, atol=1e-12)
    np.testing.assert_allclose(result.p[~early], at(table, t[~early]).p, rtol=0, atol=1e-12)
    for place in (at(references["circle"], [5.0]).p[0], at(references["figure8"], [9.0]).p[0]):
        assert float(whole.distance(jnp.asarray(place))) < 1e-3
