"""The command ``retrim``, with one module per command. Commands parse options, call the library, and print results."""

from .main import main as main
