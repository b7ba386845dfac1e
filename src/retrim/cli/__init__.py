"""The command ``retrim``: one file per command. Commands parse, call the library, print, and return an exit code."""

from .main import main as main
