"""The command line: ``jaxbox demo``, ``detect``, ``eval``, ``tune``, ``export`` and ``info``."""

from jaxbox.cli.app import app

__all__ = ["app"]
