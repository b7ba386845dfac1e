"""Packages that only one plant needs: imported when that plant is made, never with ``retrim``."""

import contextlib
import importlib
import io
from types import ModuleType

from ..plant import PlantError


def extra(module: str, name: str) -> ModuleType:
    """Import ``module`` of the extra ``name``; raises ``PlantError`` with the command that installs it.

    crazyflow cannot do with a SciPy that was first imported without SCIPY_ARRAY_API=1, which ``retrim`` sets. Where
    SciPy came first, crazyflow says what to do; that becomes a ``PlantError`` too.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # mujoco.mjx prints which accelerators it did not find
            return importlib.import_module(module)
    except ImportError as error:
        raise PlantError(f"plant {name} needs the extra: pip install 'retrim[{name}]' ({error})") from error
    except RuntimeError as error:
        raise PlantError(f"plant {name}: {' '.join(str(error).split())}") from error
