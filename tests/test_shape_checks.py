"""The check of a nested function is generated once and applies to all its definitions."""

import jaxtyping
import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float

GENERATED: list[str] = []


def count_checks(function):
    GENERATED.append(function.__qualname__)
    return beartype(function)


def make_scale(size, result_size=None, kind=float):
    @jaxtyping.jaxtyped(typechecker=count_checks)
    def scale(x: Float[np.ndarray, " n"], by: kind) -> Float[np.ndarray, " n"]:
        return size * by * np.ones(len(x) if result_size is None else result_size)

    return scale


def test_arguments_and_results_of_every_definition_are_checked():
    for size in (2.0, 3.0, 4.0):
        scale = make_scale(size)
        np.testing.assert_array_equal(scale(np.zeros(5), 2.0), 2.0 * size)  # with the values of this definition
        with pytest.raises(jaxtyping.TypeCheckError, match="parameters"):
            scale(np.zeros((5, 1)), 2.0)
        with pytest.raises(jaxtyping.TypeCheckError, match="parameters"):
            scale(np.zeros(5), "2")
        with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
            make_scale(size, result_size=4)(np.zeros(5), 2.0)


def test_check_is_generated_once_for_equal_annotations():
    for kind, value in ((int, 2), (str, "x"), (int, 2)):
        scale = make_scale(1 if kind is int else "", kind=kind)
        with pytest.raises(jaxtyping.TypeCheckError, match="parameters"):
            scale(np.zeros(5), 2.0)  # the annotation of this definition applies, not that of an earlier one
        if kind is int:
            assert scale(np.zeros(5), value).shape == (5,)
    before = len(GENERATED)
    assert before > 0
    for kind in (int, str):
        make_scale(1, kind=kind)
    assert len(GENERATED) == before
