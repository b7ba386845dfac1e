"""The command ``retrim``: one file per command."""

from .main import main as main
