"""Presets from TOML files: overlays, and one line with the path for every mistake."""

from pathlib import Path

import pytest

from retrim import ConfigError
from retrim.config import PRESETS, changed, load, overlaid
from retrim.config.loading import parse
from retrim.config.validation import MAX_TOML_BYTES


@pytest.fixture
def overlay(tmp_path):
    """Return a function that writes an overlay and returns its path."""

    def write(text, name="overlay.toml"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def check_refusal(path, message):
    with pytest.raises(ConfigError, match=message) as error:
        load("hover/fast", path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_overlay(overlay):
    result = load("hover/fast", overlay("delay_ticks = 2\n[adapt]\nnum_updates = 7\n"))
    fast = PRESETS["hover/fast"]
    assert result == changed(fast, delay_ticks=2, adapt={"num_updates": 7})
    assert result.adapt.num_updates == 7
    assert result.adapt.max_grad_norm == fast.adapt.max_grad_norm == 1.0
    assert overlaid(result, overlay("[adapt]\nnum_envs = 3\n")).adapt.num_updates == 7


def test_byte_order_mark_of_an_editor_is_accepted(overlay):
    assert load("hover/fast", overlay(b"\xef\xbb\xbfdelay_ticks = 2\n")).delay_ticks == 2


def test_task_table_is_overlaid_key_by_key(overlay):
    result = load("vision/occluded", overlay("[vision]\ndropout = 0.2\n"))
    assert result.vision.dropout == 0.2
    assert result.vision.occlusion
    assert result.vision.pixel_noise == 1.0


def test_integers_are_accepted_as_floats(overlay):
    result = load("hover/fast", overlay("termination_box = 4\ngoal = [0, 1, 2]\n[adapt]\nfit_every = 3\n"))
    assert (result.termination_box, result.goal, result.adapt.fit_every) == (4.0, (0.0, 1.0, 2.0), 3.0)
    assert type(result.termination_box) is float


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("adapt.modee = 3", r"adapt\.modee: unknown key; there are window, "),
        ("adapt.num_update = 3", r"adapt\.num_update: unknown key; did you mean 'num_updates'\?"),
        ("pretrain.num_env = 3", r"pretrain\.num_env: unknown key; did you mean 'num_envs'\?"),
        ("delay_tick = 3", r"delay_tick: unknown key; did you mean 'delay_ticks'\?"),
        ("task = 'track'\ntrack.referense = 'star'", r"track\.referense: unknown key; did you mean 'reference'\?"),
        ("task = 'vision'\nvision.droput = 0.1", r"vision\.droput: unknown key; did you mean 'dropout'\?"),
        ("pretrain.num_updates = -3", r"pretrain\.num_updates: Input should be greater than or equal to 1, not -3"),
        ("pretrain.learning_rate = 'fast'", r"pretrain\.learning_rate: Input should be a valid number, not 'fast'"),
        ("pretrain.learning_rate = nan", r"pretrain\.learning_rate: "),
        ("pretrain.learning_rate = inf", r"pretrain\.learning_rate: "),
        ("pretrain.adam_b2 = nan", r"pretrain\.adam_b2: "),
        ("adapt.spectral_weight = nan", r"adapt\.spectral_weight: "),
        ("dt = nan", r"dt: "),
        ("adapt.num_updates = true", r"adapt\.num_updates: Input should be a valid integer, not True"),
        ("adapt.num_updates = 3.0", r"adapt\.num_updates: Input should be a valid integer, not 3\.0"),
        ("adapt.num_updates = '3'", r"adapt\.num_updates: Input should be a valid integer, not '3'"),
        (f"adapt.num_updates = '{'3' * 999}'", r"a valid integer, not '3{30,40} \.\.\. 3{10,20}'$"),
        ("adapt.window = true", r"adapt\.window: "),
        ("delay_ticks = true", r"delay_ticks: "),
        ("command_history = true", r"command_history: "),
        ("dt = true", r"dt: "),
        ("termination_box = true", r"termination_box: "),
        ("adapt.fit_every = '3'", r"adapt\.fit_every: Input should be a valid number"),
        ("adapt.learning_rate = '0.1'", r"adapt\.learning_rate: Input should be a valid number"),
        ("goal = [0.0, 1.0, true]", r"goal\.2: Input should be a valid number"),
        ("task = 'vision'\nvision.occlusion = 1", r"vision\.occlusion: Input should be a valid boolean"),
        ("task = 'vision'\nvision.occlusion = 'no'", r"vision\.occlusion: Input should be a valid boolean"),
        ("adapt.update_every = 0.0005", r"adapt\.update_every: Input should be greater than or equal to 0\.001"),
        ("goal = [nan, 0.0, 1.0]", r"goal\.0: Input should be a finite number"),
        ("goal = [0.0, 1.0]", r"goal\.2: "),
        ("adapt = 3", r"adapt: "),
        ("pretrain = [1, 2]", r"pretrain: "),
        ("[vehicle]\nmass = 1.2", r"vehicle\.?.*: "),
        ("= 3", "not TOML"),
        ("a = 1\na = 2", "not TOML"),
        (b"name = '\xff'", "not TOML"),
        ("x = " + "[" * 5000 + "]" * 5000, r"not TOML|x: unknown key"),
        ("x" + ".x" * 5000 + " = 1", r"not TOML|x: unknown key"),
        ("goal = 1.0", r"goal: must be a list of values in brackets, not 1\.0"),
        ("#" * (MAX_TOML_BYTES + 1), rf"larger than the {MAX_TOML_BYTES} bytes that are accepted"),
    ],
)
def test_invalid_overlay_names_path(overlay, text, message):
    check_refusal(overlay(text), message)


def test_missing_or_special_file_is_refused(tmp_path):
    check_refusal(tmp_path / "nothing.toml", "no such file")
    check_refusal(tmp_path, "not a regular file")
    check_refusal(Path("/dev/zero"), "not a regular file")


def test_unknown_presets_are_refused():
    with pytest.raises(ConfigError, match="no preset 'quick'; there are hover/retrim, hover/any, track/retrim"):
        load("quick")
    with pytest.raises(ConfigError, match=r"no preset 'hover/fsat'; did you mean 'hover/fast'\? there are"):
        load("hover/fsat")


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "null", '{"pretrain": 3}', "[" * 100_000, '{"dt": NaN}'])
def test_invalid_json_is_refused(text):
    with pytest.raises(ConfigError, match="header: ") as error:
        parse(text, source="header")
    assert "\n" not in str(error.value)
