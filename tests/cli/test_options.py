"""Help texts: names come from the registries, and an option without a default shows none."""

import importlib

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


def test_module_that_ends_the_process_does_not_make_a_command_succeed(tmp_path, monkeypatch):
    (tmp_path / "command_that_exits.py").write_text(
        "import sys\n\n\ndef leave():\n    return lambda stop: sys.exit(0)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(main, "own_commands", lambda: {"leave": ("Do something.", "command_that_exits")})
    message = "retrim: a module of yours ended the command: SystemExit: 0\n"
    assert retrim("leave", cwd=tmp_path, code=1) == message
