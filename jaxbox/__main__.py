"""Runs the command line as ``python -m jaxbox``."""

from jaxbox.cli import main

if __name__ == "__main__":
    main()
