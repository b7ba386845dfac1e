"""``retrim gauntlet``."""

from ..evaluation import tables
from .reproduce import command_of

gauntlet = command_of(tables.gauntlet, "gauntlet")
