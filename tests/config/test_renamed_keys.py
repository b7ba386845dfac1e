"""Old names of preset keys keep their meaning in files and JSON."""

import json

import pytest

from retrim.config import changed, load
from retrim.config.loading import dump, missing_defaults, parse
from retrim.config.presets import Preset
from retrim.config.renamed_keys import RENAMED
from retrim.errors import ConfigError

PRESET = changed(load("track/retrim"), track={"gravity_copies": 3, "gravity_push": 2.5})


def with_old_keys(preset: Preset) -> str:
    tables = json.loads(dump(preset))
    for table, names in RENAMED.items():
        for old, new in names.items():
            tables[table][old] = tables[table].pop(new)
    return json.dumps(tables)


@pytest.mark.parametrize("form", [str, str.encode])
def test_json_with_old_keys_gives_same_preset(form):
    text = form(with_old_keys(PRESET))
    assert parse(text, source="header") == PRESET
    assert missing_defaults(PRESET, text) == {}


def test_overlay_with_old_keys_gives_same_preset(tmp_path):
    path = tmp_path / "old.toml"
    path.write_text("[track]\nfelt_copies = 3\nfelt_push = 2.5\n")
    assert load("track/retrim", path) == PRESET


def test_old_and_new_name_together_are_refused(tmp_path):
    path = tmp_path / "both.toml"
    path.write_text("[track]\nfelt_copies = 3\ngravity_copies = 3\n")
    with pytest.raises(ConfigError, match=r"both.toml: track\.felt_copies is now track\.gravity_copies; remove"):
        load("track/retrim", path)
