"""Descriptions of disturbances in words."""

import jax.numpy as jnp
import pytest

from retrim.runkit.disturbance_text import describe_disturbance

HOME = jnp.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("none", ""),
        ("large", "pushed by +2 m/s² per axis"),
        ("wind=6+payload=0.1", "wind of 6.0 m/s; 100 g of load"),
        ("gusts", "changes all the time"),
    ],
)
def test_text_states_effects(name, text):
    assert describe_disturbance(name, HOME, 30.0) == text


def test_text_states_times_of_changes():
    text = describe_disturbance("reversing", HOME, 60.0)
    assert text.startswith("pushed by +0.5 m/s² per axis, from 15.0 s pushed by -0.5 m/s² per axis")
    assert text.endswith(", and so on")
    assert "and so on" not in describe_disturbance("reversing", HOME, 20.0)


def test_text_states_later_start():
    assert describe_disturbance("step", HOME, 30.0).startswith("from ")
