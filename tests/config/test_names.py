"""Names of files cannot inject markup or code into presets, C headers, pages or plots."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib.text import Text

from retrim import ConfigError
from retrim.config import PRESETS, changed, load, read_vehicle
from retrim.config.loading import load_for
from retrim.config.names import plain_from
from retrim.export.c_header import remark
from retrim.runkit.document import TableSection, as_text
from retrim.viz.panels import Curve, Panel, bars, panel_figure
from retrim.viz.plots import save

HOSTILE = [
    "*/ int system(const char *); /*",
    "a\\\nb",
    "??/\nint x;",
    "/*",
    "$x_$",
    "[a](javascript:b)",
    "<script>",
    "a|b",
    "a\x1b[2J",
    "é",
    "",
    65 * "x",
    "a\n",
]
VEHICLE = "mass = 0.7\ninertia = [2e-3, 2e-3, 3e-3]\narm = [0.08, 0.08]\nthrust_max = 30.0\nrates_max = [9, 9, 4]\n"


@pytest.mark.parametrize("name", HOSTILE)
def test_special_names_are_refused(tmp_path, name):
    preset = load("hover/retrim")
    for key in ("name", "task"):
        with pytest.raises(ConfigError, match=rf"{key}: .* must be 1 to 64 characters") as error:
            changed(preset, **{key: name})
        assert str(error.value).isprintable()
    text = VEHICLE + "motor_tau = 0.03\nname = " + re.sub("'", '"', repr(name)).replace("\\x1b", "\\u001b")
    (tmp_path / "v.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"name: .* must be 1 to 64 characters"):
        read_vehicle(tmp_path / "v.toml")


def test_usual_names_are_accepted(tmp_path):
    for name in (*PRESETS, "track circle+star at 8.0", "a_b-c"):
        assert changed(load("hover/retrim"), name=name).name == name == plain_from(name)
    assert load_for("mine:task", "hover/fast").name == "mine.task on hover/fast"
    (tmp_path / "Vögel (alt).toml").write_text(VEHICLE + "motor_tau = 0.03")
    assert read_vehicle(tmp_path / "Vögel (alt).toml").name == "V.gel .alt."


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no C compiler")
def test_c_remark_cannot_end_comment(tmp_path):
    text = "".join(f"/* {remark(name)} */\n/* a {remark(name)}/{remark(name)} */\n" for name in (*HOSTILE, "//", "/"))
    (tmp_path / "a.c").write_text(text + "int main(void) { return 0; }\n")
    words = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Wcomment", "-Wtrigraphs", "-Werror", "-E", "-P", "a.c"]
    left = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert left.split() == ["int", "main(void)", "{", "return", "0;", "}"]


@pytest.mark.parametrize("name", HOSTILE)
def test_table_cell_has_no_links_or_html(name):
    heading, _, _, _, line, _ = TableSection(("a", "b"), ((name, "1"),), title=f"t {name}").markdown()
    assert heading == f"## {as_text(f't {name}')}"
    assert len(re.findall(r"(?<!\\)\|", line)) == 3
    assert not re.search(r"\]\(|<[a-z]|[\x00-\x1f]", line + heading)


def test_dollar_signs_in_plots_are_text(tmp_path):
    x, name = np.array([1.0, 2.0, 1000.0]), "cost $x_$ and $\\nothing$"
    for figure in (panel_figure(name, [Panel(name, name, name, [Curve(x, x, name)], log=True)]),
                   bars(name, {name: {name: [1.0]}})):  # fmt: skip
        save(figure, tmp_path, "p")  # Matplotlib raises if it parses this as a formula.
        ours = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
        formulas = {text.get_text() for text in ours if text.get_parse_math() and "$" in text.get_text()}
        assert name in {text.get_text() for text in ours}
        assert all("mathdefault{10^" in text for text in formulas)  # powers of ten are drawn this way
        assert not any("mathdefault" in text.get_text() for text in ours if not text.get_parse_math())
