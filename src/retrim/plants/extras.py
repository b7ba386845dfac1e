"""Import optional packages when the plant or method that needs them is created, never together with ``retrim``."""

import contextlib
import importlib
import importlib.util
import io
from types import ModuleType

from ..errors import PlantError


def import_extra(module: str, name: str, *, package: str | None = None, kind: str = "plant") -> ModuleType:
    """Import ``module``, which the extra ``name`` installs.

    Args:
        module: Name of the module.
        name: Name of the extra.
        package: Name in the package registry; by default the name of the extra.
        kind: Kind of component that is named after the extra, for the error message.

    Raises:
        PlantError: The extra is not installed (the message contains the command that installs it), or SciPy was
            imported before SCIPY_ARRAY_API=1 was set, which crazyflow requires.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # mujoco.mjx prints which accelerators it did not find
            return importlib.import_module(module)
    except ImportError as error:
        raise _missing(name, package, kind, str(error)) from error
    except RuntimeError as error:
        raise PlantError(f"plant {name}: {' '.join(str(error).split())}") from error


def check_extra(module: str, name: str, *, package: str | None = None) -> None:
    """Check that a plant's package is installed, without importing it.

    Args:
        module: Module of the package.
        name: Name of the extra, which is also the name of the plant.
        package: Name in the package registry; by default the name of the extra.

    Raises:
        PlantError: The package is not installed; the message contains the command that installs it.
    """
    if importlib.util.find_spec(module) is None:
        raise _missing(name, package, "plant", f"No module named {module!r}")


def _missing(name: str, package: str | None, kind: str, why: str) -> PlantError:
    return PlantError(
        f"{kind} {name!r} needs the package {package or name!r} ({why}); in a checkout: `make dev`, or "
        f"`uv pip install -e '.[{name}]'`; elsewhere: `pip install {package or name}`"
    )
