"""The settings that a command was asked for: a preset, a file of changes, and changes one by one."""

import json
import pathlib
from collections.abc import Sequence

from jaxbox.config import DetectorConfig
from jaxbox.io import InputError
from jaxbox.settings import parse_change, replace_settings
from jaxbox.steps import check_settings


def chosen_config(preset: str, settings: pathlib.Path | None, changes: Sequence[str]) -> DetectorConfig:
    """Puts the settings together.

    Args:
      preset: name of the preset to start from.
      settings: JSON file of values by dotted name, such as ``best.json`` of ``jaxbox tune``, or None.
      changes: each ``FIELD=VALUE``; they come last.

    Returns:
      The settings.

    Raises:
      InputError: for an unknown preset or setting, a value that does not fit, a file that is no such JSON,
        or settings that contradict each other.
    """
    if preset not in DetectorConfig.presets():
        names = ", ".join(DetectorConfig.presets())
        raise InputError(f"--preset {preset}: there is no such preset; choose one of {names}.")
    config = DetectorConfig.presets()[preset]
    if settings is not None:
        config = _with_file(config, settings)
    try:
        config = replace_settings(config, dict(parse_change(change) for change in changes))
    except ValueError as error:
        raise InputError(f"--set: {error}") from error
    try:
        check_settings(config)
    except ValueError as error:
        raise InputError(str(error)) from error
    return config


def _with_file(config: DetectorConfig, path: pathlib.Path) -> DetectorConfig:
    try:
        values = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise InputError(
            f"{path}: no JSON ({error}); give one such as best.json of `jaxbox tune`."
        ) from error
    if not isinstance(values, dict):
        raise InputError(f'{path}: it must be one object of values by name: {{"box.criterion": "area"}}.')
    try:
        return replace_settings(config, values)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
