"""Show the version of retrim, and the commit of the site, on every page."""

from importlib.metadata import version
from typing import Any

from retrim.runkit.provenance import commit


def on_config(config: Any) -> Any:
    """Add the version to the name of the site, and the commit to the line at the foot of each page."""
    release = f"{config.site_name} {version('retrim')}"
    config.copyright = f"{release}, commit {commit()}. {config.copyright}."
    config.site_name = release
    return config
