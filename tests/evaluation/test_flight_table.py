"""Tables of flights: the final error, the worst moment and the settling time, in millimetres."""

import numpy as np
import pytest

from fake_flights import flight
from retrim.evaluation import rows
from retrim.evaluation.flight_table import figure_cells, figure_columns, millimetres


@pytest.mark.parametrize(
    ("metres", "text"),
    [
        (0.52, "520"),
        (0.0123, "12.3"),
        (0.001, "1.0"),
        (1e-5, "0.010"),
        (1e-7, "< 0.001"),
        (0.0, "< 0.001"),
        (None, "-"),
    ],
)
def test_errors_are_in_millimetres(metres, text):
    assert millimetres(metres) == text


def test_two_methods_with_small_errors_differ():
    """Errors of 5 and 10 micrometres are not one figure."""
    small, smaller = (figure_cells(rows([flight(error)])[0])[0] for error in (1e-5, 5e-6))
    assert (small, smaller) == ("0.010", "0.005")


def test_table_has_worst_moment_and_settling_time():
    error = np.full(501, 0.001)
    error[:100], error[300] = 0.5, 0.03  # 2 s to the goal, and a push at 6 s
    assert figure_cells(rows([flight(error)])[0]) == ("1.0", "30.0", "2.0")
    assert figure_cells(rows([flight(0.2)])[0]) == ("200", "200", "never")
    crashes = figure_cells(rows([flight(0.2, terminated=True)])[0])
    assert crashes == ("crashed, 1 of 1", "-", "-")


def test_columns_state_time_of_worst_moment():
    assert figure_columns()[1] == figure_columns(30.0)[1] == "worst after 5 s [mm]"
    assert figure_columns(3.0)[1] == "worst after 1.5 s [mm]"
    assert figure_columns()[2] == "below 50 mm from [s]"
