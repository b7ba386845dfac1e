"""A note is accepted completely, with fields of the right types and ranges, or refused."""

import math

import numpy as np
import pytest

from retrim.control.condition import Cause, Stage
from retrim.errors import MessageError
from retrim.onboard.messages import last_note, pack_note, unpack_note
from retrim.onboard.note_fields import FIELDS, format_value, plain, read_fields
from retrim.transport.in_process import InProcessBus

ODD = (None, True, 1, -1, 2**70, -(2**70), 0.5, 1e308, -1e308, math.nan, math.inf, "", "x", "\x1b[2J", "*" * 5000, [],
       [1], [None, True, "x"], [[[]]], [math.nan] * 3, {}, {"a": 1}, {"a": {"b": []}}, {"\x07": None})  # fmt: skip
GOOD = {
    "ended": {"reason": "landed"},
    "ground": {"base": "b", "alive": {"policy": True}, "failed": "", "over": False},
    "knobs": {"push": [0.0, 1, 0.0], "wind": [0.0] * 3, "kick": [0.0] * 3, "load": 0, "rotor": 1.0, "kicks": 2},
    "learner.policy": {"learnt": 3, "took": 0.2, "until": 1.5},
    "learning": {"paused": True, "flown": False},
    "order": {"epoch": 12.5, "order": "land"},
    "ready": {"base": "b", "device": "cpu", "refused": ["memory"], "stands": True, "port": 8080, "failed": None},
    "stalls": {"count": 1, "longest": 0.01, "newest": [[1.0, 1.01]]},
    "status": {
        "mode": "policy", "reason": "", "error": math.nan, "missed": 0, "versions": {"policy": 1},
        "newest": {"policy": 2}, "given_up": [1],
        "refused": {"policy": 1}, "swaps": [[1.0, "policy", 1, 0.5]], "gaps": [[1.0, 1.1, 2]],
        "late_samples": 0, "disturbance": [0.0, 0.0, math.inf], "estimate": [0.0] * 3,
        "target": [0.0] * 3, "learning": True,
    },
    "wish": {"method": "lora", "reference": "circle", "paused": False, "land": True},
    "world": {"late": 0, "held": 1, "lost": 0.5, "knobs_refused": ""},
}  # fmt: skip


@pytest.mark.parametrize("kind", GOOD)
def test_valid_note_is_unchanged(kind):
    result = unpack_note(pack_note(kind, **GOOD[kind]), kind)
    np.testing.assert_equal(result, GOOD[kind])


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind in FIELDS for name in FIELDS[kind]])
def test_field_of_any_type_is_read_or_refused_in_one_line(kind, name):
    extract, refusals = [], []
    for value in ODD:
        try:
            extract.append(read_fields(kind, {name: value})[name])
        except MessageError as error:
            refusals.append(str(error))
    assert all(each.startswith(f"{kind}: {name} = ") and len(each) < 250 and each.isprintable() for each in refusals)
    assert refusals
    kinds = {type(value) for value in extract if value is not None}
    assert len(kinds) <= 1
    assert all(value.isprintable() and len(value) <= 1000 for value in extract if isinstance(value, str))


@pytest.mark.parametrize(
    ("kind", "field", "must_be"),
    [
        ("wish", {"method": 1}, "method = 1 must be a text"),
        ("wish", {"paused": 1}, "paused = 1 must be true or false"),
        ("wish", {"land": "yes"}, "land = 'yes' must be true or false"),
        ("knobs", {"push": [0.0, 0.0]}, "push = list must be a list of 3"),
        ("knobs", {"push": [0.0, True, 0.0]}, "push = list must be a number"),
        ("knobs", {"kicks": True}, "kicks = True must be a whole number from 0 to 9007199254740992"),
        ("knobs", {"load": math.nan}, "load = nan must be a number from -inf to inf"),
        ("learner.policy", {"took": "x"}, "took = 'x' must be a number"),
        ("status", {"newest": []}, "newest = list must be a table"),
        ("ready", {"port": 70000}, "port = 70000 must be a whole number from 1 to 65535"),
        ("order", {"epoch": -1}, "epoch = -1 must be a number from 0 to inf"),
    ],
)
def test_refusal_states_requirement_of_field(kind, field, must_be):
    data = pack_note(kind, **field)
    with pytest.raises(MessageError) as error:
        unpack_note(data, kind)
    assert str(error.value) == f"{kind}: {must_be}"
    bus = InProcessBus({kind: 4096})
    bus.publish(kind, data)
    assert last_note(bus, kind) == {}


@pytest.mark.parametrize("fields", [[], "x", 1, None])
def test_fields_without_table_are_refused(fields):
    with pytest.raises(MessageError, match="wish: no fields"):
        read_fields("wish", fields)


def test_quoted_text_is_short_and_without_control_characters():
    assert format_value("\x1b]0;x\x07") == r"'\x1b]0;x\x07'"
    assert len(format_value("x" * 10_000)) == 80
    assert plain("a\x1b[2J\nb") == r"a\x1b[2J\nb"
    assert len(plain("\x00" * 10_000)) == 1000


def test_every_stage_and_cause_is_valid():
    stages = [[1.0, int(stage), int(cause)] for stage in Stage for cause in Cause]
    assert read_fields("status", {"stages": stages})["stages"] == stages
    for beyond in ([1.0, max(Stage) + 1, 0], [1.0, 0, max(Cause) + 1]):
        with pytest.raises(MessageError):
            read_fields("status", {"stages": [beyond]})
