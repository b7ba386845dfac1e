"""Open a flight's page in a browser on this machine."""

import atexit
import contextlib
import os
import sys
import tempfile
import webbrowser
from html import escape
from pathlib import Path


def open_page(url: str, folder: Path) -> None:
    """Open a page in a browser through a file that only this user can read.

    All users of a machine can read a browser's command line, so the command line must not contain the token.

    Args:
        url: Address of the page, with its token.
        folder: Folder for the file; the file is removed when this process ends.
    """
    if sys.platform != "darwin" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return  # this machine does not have a screen
    with contextlib.suppress(OSError):  # on failure the user can still open the printed address
        descriptor, name = tempfile.mkstemp(prefix="page-", suffix=".html", dir=folder.resolve())
        atexit.register(_remove, Path(name))
        with os.fdopen(descriptor, "w") as file:
            file.write(f'<meta http-equiv="refresh" content="0; url={escape(url)}">')
        webbrowser.open(Path(name).as_uri())


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()
