"""Compiled functions kept between runs, so that only the first run waits for the compiler."""

import os
import pathlib
from collections.abc import Mapping

import jax

CACHE_VARIABLE = "JAXBOX_CACHE_DIR"
"""Environment variable that names another folder, or, when empty, switches the cache off."""
_JAX_VARIABLE = "JAX_COMPILATION_CACHE_DIR"


def cache_folder(environment: Mapping[str, str]) -> pathlib.Path | None:
    """Where compiled functions are kept; None where the cache is switched off.

    Args:
      environment: the environment variables.

    Returns:
      ``JAXBOX_CACHE_DIR``, else ``jaxbox`` within ``XDG_CACHE_HOME``, else ``~/.cache/jaxbox``.

    >>> cache_folder({"JAXBOX_CACHE_DIR": ""}) is None
    True
    """
    chosen = environment.get(CACHE_VARIABLE)
    if chosen is not None:
        return pathlib.Path(chosen) if chosen else None
    root = environment.get("XDG_CACHE_HOME")
    return (pathlib.Path(root) if root else pathlib.Path.home() / ".cache") / "jaxbox"


def enable_cache(environment: Mapping[str, str] = os.environ) -> pathlib.Path | None:
    """Switches JAX's persistent compilation cache on, unless the user has set it up already.

    Args:
      environment: the environment variables.

    Returns:
      The folder, or None where the cache is off or its folder cannot be made.
    """
    if _JAX_VARIABLE in environment:
        return pathlib.Path(environment[_JAX_VARIABLE])
    folder = cache_folder(environment)
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # A home that cannot be written costs time, not the answer.
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    return folder
