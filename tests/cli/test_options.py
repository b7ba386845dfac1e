"""Help texts: names come from the registries, and an option without a default shows none."""

import pytest

from commands import retrim
from retrim.config.disturbances import DISTURBANCES
from retrim.config.faults import FAULTS
from retrim.config.methods import METHODS
from retrim.config.plants import PLANTS
from retrim.config.references import REFERENCES
from retrim.config.residuals import RESIDUALS
from retrim.config.sensors import SENSORS
from retrim.config.vehicles import VEHICLES


@pytest.mark.parametrize("command", ["fly", "live"])
@pytest.mark.parametrize(
    "registry", [DISTURBANCES, FAULTS, METHODS, PLANTS, REFERENCES, RESIDUALS, SENSORS, VEHICLES], ids=lambda r: r._kind
)
def test_help_lists_every_registered_name(command, registry, tmp_path):
    shown = "".join(retrim(command, "--help", cwd=tmp_path).replace("│", " ").split())  # lines end inside of names
    assert [name for name in registry if name not in shown] == []


@pytest.mark.parametrize("command", ["pretrain", "fly", "live", "sweep", "export", "demo", "gauntlet"])
def test_an_option_without_a_default_shows_none(command, tmp_path):
    out = retrim(command, "--help", cwd=tmp_path)
    assert "{None}" not in out
    assert "default: None" not in out
