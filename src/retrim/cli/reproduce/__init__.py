"""``retrim reproduce``: tables and figures, written where the documentation keeps them; one file each."""

from collections.abc import Callable

from .hover import hover
from .model import model
from .plants import plants
from .reversing import reversing
from .tracking import tracking
from .vision import vision

TABLES: dict[str, Callable[..., int]] = {
    "hover": hover,
    "reversing": reversing,
    "tracking": tracking,
    "vision": vision,
    "plants": plants,
    "model": model,
}


def reproduce() -> int:
    """Tables and figures, each a command of its own: hover, reversing, tracking, vision, plants, model."""
    raise AssertionError("reproduce has commands of its own")
