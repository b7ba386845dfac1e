"""Packages that only one plant needs: imported when that plant is made, never with ``retrim``."""

import contextlib
import importlib
import io
import os
from types import ModuleType

from ..plant import PlantError


def extra(module: str, name: str) -> ModuleType:
    """Import ``module`` of the extra ``name``; raises ``PlantError`` with the command that installs it.

    crazyflow needs SCIPY_ARRAY_API=1 before SciPy is first imported, by whichever plant comes first, hence always.
    """
    os.environ.setdefault("SCIPY_ARRAY_API", "1")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # mujoco.mjx prints which accelerators it did not find
            return importlib.import_module(module)
    except ImportError as error:
        raise PlantError(f"plant {name} needs the extra: pip install 'retrim[{name}]' ({error})") from error
