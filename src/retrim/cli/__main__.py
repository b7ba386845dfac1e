"""Run the command line as ``python -m retrim.cli``."""

from .main import main

if __name__ == "__main__":
    main()
