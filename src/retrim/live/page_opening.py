"""Opens the page of a flight in a browser of this machine."""

import atexit
import contextlib
import os
import sys
import tempfile
import webbrowser
from html import escape
from pathlib import Path


def open_page(url: str, folder: Path) -> None:
    """Open a page by a file that only this user can read: everybody on a machine can read a browser's command line.

    Args:
        url: Of the page, with its token.
        folder: For the file, which goes when this process ends.
    """
    if sys.platform != "darwin" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return  # there is no screen
    with contextlib.suppress(OSError):  # the address was printed, too
        descriptor, name = tempfile.mkstemp(prefix="page-", suffix=".html", dir=folder.resolve())
        atexit.register(_remove, Path(name))
        with os.fdopen(descriptor, "w") as file:
            file.write(f'<meta http-equiv="refresh" content="0; url={escape(url)}">')
        webbrowser.open(Path(name).as_uri())


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()
