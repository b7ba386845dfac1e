"""Help texts: names come from the registries, and an option without a default shows none."""

import importlib
import re

import pytest

from commands import retrim
from retrim import ConfigError
from retrim.config.disturbances import DISTURBANCES
from retrim.config.faults import FAULTS
from retrim.config.methods import METHODS, find_method
from retrim.config.plants import PLANTS
from retrim.config.references import REFERENCES
from retrim.config.residuals import RESIDUALS
from retrim.config.sensors import SENSORS
from retrim.config.vehicles import VEHICLES

main = importlib.import_module("retrim.cli.main")  # the package has a function of that name


@pytest.mark.parametrize("command", ["fly", "live"])
@pytest.mark.parametrize(
    "registry", [DISTURBANCES, FAULTS, METHODS, PLANTS, REFERENCES, RESIDUALS, SENSORS, VEHICLES], ids=lambda r: r._kind
)
def test_help_lists_every_registered_name(command, registry, tmp_path):
    display = "".join(retrim(command, "--help", cwd=tmp_path).replace("│", " ").split())  # lines may break inside names
    assert [name for name in registry if name not in display] == []


@pytest.mark.parametrize("command", ["pretrain", "fly", "live", "sweep", "export", "demo", "gauntlet"])
def test_option_without_default_shows_none(command, tmp_path):
    out = retrim(command, "--help", cwd=tmp_path)
    assert "{None}" not in out
    assert "default: None" not in out


def test_methods_of_installed_packages_are_listed_and_suggested(tmp_path):
    assert {"datt", "raptor"} <= set(METHODS.plugins())
    display = "".join(retrim("fly", "--help", cwd=tmp_path).replace("│", " ").split())
    assert "datt,indi-double,indi-half,raptorofinstalledpackages" in display
    with pytest.raises(ConfigError, match="no method 'rapto'; did you mean 'raptor'"):
        find_method("rapto")


@pytest.mark.parametrize("error", [ImportError, SystemExit])
def test_broken_package_does_not_affect_other_commands(error, monkeypatch, capsys):
    class Broken:
        value = "broken:COMMANDS"

        def load(self):
            raise error("no module named broken")

    monkeypatch.setattr(main, "entry_points", lambda group: [Broken()])
    assert set(main.commands()) == set(main.COMMANDS)
    assert "the commands of broken:COMMANDS cannot be loaded: no module named broken" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("exits", "def run():\n    return lambda stop: exit(0)\n", r"retrim: a module of yours .*SystemExit: 0\n"),
        ("exits_early", "raise SystemExit(0)\n", r"retrim: a module of yours ended the command: SystemExit: 0\n"),
        ("raises", "x = 1\nraise ValueError('no rig')\n", r"retrim: \S+, line 2: ValueError: no rig; .*\n"),
    ],
)
def test_faulty_module_of_a_command_is_reported_in_one_line(name, text, message, tmp_path, monkeypatch):
    (tmp_path / f"command_that_{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(main, "commands", lambda: {"run": ("Do something.", f"command_that_{name}")})
    assert re.fullmatch(message, retrim("run", cwd=tmp_path, code=1))
