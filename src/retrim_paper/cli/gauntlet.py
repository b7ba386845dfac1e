"""The command ``retrim gauntlet``."""

from .. import tables
from .reproduce import command_of

gauntlet = command_of(tables.gauntlet, "gauntlet")
