"""Settings files: TOML, or JSON such as ``best.json`` of ``jaxbox tune``, with the same names."""

import json
import os
import pathlib
import tomllib
from typing import Any

from jaxbox._files import InputError, atomic_writer, read_text, reason
from jaxbox.config import DetectorConfig
from jaxbox.config.fields import PRESET_KEY, apply_tables, base_of, config_to_toml, without_base

_MAX_BYTES = 2**20


def read_config(
    path: str | os.PathLike[str], *, base: DetectorConfig | None = None, sensor: int | None = None
) -> DetectorConfig:
    """Reads a settings file.

    Args:
      path: TOML, or JSON where it is named so: tables and dotted names of `jaxbox.config.fields`.
      base: what the file changes; None for the preset that it names under ``preset``, or the default one.
      sensor: number of beams that this is fitted to before, see `DetectorConfig.for_sensor`; None for what
        the file names under ``sensor``, if anything.

    Returns:
      The settings.

    Raises:
      InputError: naming file and line or setting, with the nearest names for an unknown one.
    """
    tables = _parse(path)
    try:
        return apply_tables(base_of(tables, preset=base, sensor=sensor), without_base(tables))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def read_preset(path: str | os.PathLike[str]) -> str:
    """Reads which preset a settings file changes.

    Args:
      path: as `read_config`, which refuses a name that is not a preset's.

    Returns:
      What it names under ``preset``, or "default".

    Raises:
      InputError: naming the file, where it is not a settings file.
    """
    return _parse(path).get(PRESET_KEY, "default")


def write_config(path: str | os.PathLike[str], config: DetectorConfig) -> None:
    """Writes every setting, from which `read_config` makes the same settings.

    Args:
      path: the file, ``.toml``; its folder is made where it is missing.
      config: the settings, each threshold one number.
    """
    with atomic_writer(path) as handle:
        handle.write("# Settings of jaxbox; read by `jaxbox detect --config` and jaxbox.io.read_config.\n\n")
        handle.write(config_to_toml(config))


def _parse(path: str | os.PathLike[str]) -> dict[str, Any]:
    text = read_text(path, max_bytes=_MAX_BYTES)
    kind, parse = (
        ("JSON", json.loads) if pathlib.Path(path).suffix.lower() == ".json" else ("TOML", tomllib.loads)
    )
    try:
        tables = parse(text)
    # Tables within tables without end.
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: no {kind} ({reason(error)}); fix the line, or name the file by its kind."
        ) from error
    if not isinstance(tables, dict):
        raise InputError(f'{path}: it must be one object of values by name: {{"box.criterion": "area"}}.')
    return tables
