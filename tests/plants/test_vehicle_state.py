"""A state that is carried on to the present: exact where what drives it is constant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from retrim.plants.bridges.vehicle_state import LONGEST_S, VehicleState

ages = st.floats(0.0, LONGEST_S)


def state(age, omega=(0.0, 0.0, 0.0), turned=(0.3, -0.2, 1.0), v=(1.0, -2.0, 0.5)):
    R = Rotation.from_rotvec(turned).as_matrix()
    return VehicleState(np.array([0.1, 0.2, 1.5]), R, np.array(v), np.array(omega), age)


def test_what_is_new_stays_as_it_is():
    x = state(0.0, omega=(1.0, 2.0, 3.0))
    for found, told in zip(x.carried_on(12.0)[:4], x[:4], strict=True):
        np.testing.assert_allclose(found, told, atol=1e-12)


@given(ages, st.lists(st.floats(-8.0, 8.0), min_size=3, max_size=3))
def test_it_turns_by_its_body_rates(age, omega):
    x = state(age, omega)
    turned = x.carried_on(9.81).R
    np.testing.assert_allclose(turned, x.R @ Rotation.from_rotvec(age * np.array(omega)).as_matrix(), atol=1e-9)


@given(ages)
def test_it_falls_without_thrust_and_hovers_with_it(age):
    x = state(age, turned=(0.0, 0.0, 0.4))
    fallen, hovered = x.carried_on(0.0), x.carried_on(9.81)
    np.testing.assert_allclose(hovered.p, x.p + age * x.v, atol=1e-9)
    np.testing.assert_allclose(hovered.v, x.v, atol=1e-9)
    np.testing.assert_allclose(hovered.p - fallen.p, [0.0, 0.0, 0.5 * 9.81 * age**2], atol=1e-9)
    np.testing.assert_allclose(hovered.v - fallen.v, [0.0, 0.0, 9.81 * age], atol=1e-9)


def test_the_age_of_the_news_is_kept_and_a_truth_is_carried_on_by_its_own():
    x = state(0.02)._replace(truth=state(0.01))
    found = x.carried_on(9.81)
    assert (found.age, found.truth.age) == (0.02, 0.01)
    assert np.linalg.norm(found.p - found.truth.p) == pytest.approx(0.01 * np.linalg.norm(x.v), rel=0.1)


def test_what_is_old_is_not_carried_on_for_long():
    old, older = state(LONGEST_S).carried_on(9.81), state(5.0).carried_on(9.81)
    np.testing.assert_allclose(older.p, old.p)
    assert older.age == 5.0
