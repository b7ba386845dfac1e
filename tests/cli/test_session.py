"""What a results file says of the command that made it."""

import pytest

from retrim.cli.session import said


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (["reproduce", "plants", "--out", "/somewhere/of/mine", "--starts", "2"], "reproduce plants --starts 2"),
        (["demo", "--out=/somewhere/of/mine", "--seed=3"], "demo --seed=3"),
        (["fly", "--policy", "/home/me/p", "--config=/home/me/a.toml"], "fly --policy p --config=a.toml"),
        (["fly", "--policy", "runs/h", "--reference", "circle"], "fly --policy runs/h --reference circle"),
        (["demo", "--out"], "demo"),
    ],
)
def test_no_place_on_this_machine_is_recorded(words, kept):
    assert said(words) == f"retrim {kept}"
