"""The command line: ``jaxbox demo``, ``detect``, ``eval``, ``tune``, ``export`` and ``info``."""

from jaxbox.cli.app import app, main

__all__ = ["app", "main"]
