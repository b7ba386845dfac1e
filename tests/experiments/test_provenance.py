"""What a results file says of the command that made it, and of its time."""

import pytest

from retrim.experiments.provenance import Stopwatch, said


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        ("reproduce plants --out {here}/results --starts 2", "reproduce plants --starts 2"),
        ("demo --out={here}/d --seed=3", "demo --seed=3"),
        ("fly --policy {here}/p --config={here}/a.toml", "fly --policy p --config=a.toml"),
        ("fly --policy runs/h --reference circle", "fly --policy runs/h --reference circle"),
        ("demo --out", "demo"),
    ],
)
def test_no_place_on_this_machine_is_recorded(words, kept, tmp_path):
    assert said(words.format(here=tmp_path).split()) == f"retrim {kept}"


def test_programs_traced_inside_others_count_once():
    watch = Stopwatch()
    for start, end in ((1.0, 2.0), (1.5, 2.5), (4.0, 4.5), (3.5, 5.0), (7.0, 8.0)):  # by their ends, as they come
        watch.compiled(start, end)
    assert watch.compile_s == pytest.approx(1.5 + 1.5 + 1.0)
