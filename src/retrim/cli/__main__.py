"""``python -m retrim.cli``."""

from .main import main

main()
