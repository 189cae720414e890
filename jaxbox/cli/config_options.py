"""The settings that a command was asked for: a preset, a file of changes, and changes one by one."""

import pathlib
from collections.abc import Sequence

from jaxbox.config import DetectorConfig, TrackConfig
from jaxbox.config.checks import check_config
from jaxbox.config.fields import Config, all_fields, base_of, parse_change, preset_config, replace_fields
from jaxbox.io import InputError, read_config
from jaxbox.io.config import read_preset


def chosen_config(
    preset: str | None,
    file: pathlib.Path | None,
    changes: Sequence[str],
    *,
    sensor: int | None = None,
) -> DetectorConfig:
    """Puts the settings together.

    Args:
      preset: name of the preset to start from; None for the one that the file names, or the default.
      file: settings file, TOML or JSON, or None.
      changes: each ``FIELD=VALUE``; they come last.
      sensor: number of beams that the preset is fitted to, before the file's changes; None for the one that
        the file names, or none.

    Returns:
      The settings.

    Raises:
      InputError: for an unknown preset or setting, a value that does not fit, a file that is not such a file,
        or settings that contradict each other.
    """
    try:
        base = None if preset is None else preset_config(preset)
    except ValueError as error:
        raise InputError(f"--preset {error}") from error
    try:
        fitted = base_of({}, preset=base, sensor=sensor)
    except ValueError as error:
        raise InputError(f"--sensor {error}") from error
    config = fitted if file is None else read_config(file, base=base, sensor=sensor)
    config = _changed(config, changes, "--set")
    try:
        check_config(config)
    except ValueError as error:
        raise InputError(str(error)) from error
    return config


def chosen_track_config(changes: Sequence[str]) -> TrackConfig:
    """The settings of the tracker.

    Args:
      changes: each ``FIELD=VALUE``, to the defaults.

    Returns:
      The settings.

    Raises:
      InputError: for an unknown setting, with the nearest, or a value that does not fit.

    >>> chosen_track_config(["max_misses=6"]).max_misses
    6.0
    """
    return _changed(TrackConfig(), changes, "--track-set")


def _changed(config: Config, changes: Sequence[str], option: str) -> Config:
    """Settings with the changes that an option gave, each ``FIELD=VALUE``."""
    try:
        return replace_fields(config, dict(parse_change(change) for change in changes))
    except ValueError as error:
        raise InputError(f"{option}: {error}") from error


def chosen_preset(preset: str | None, file: pathlib.Path | None) -> str:
    """Name of the preset that `chosen_config` starts from.

    Args:
      preset: as there.
      file: as there; it has to be one that was read.

    Returns:
      One of `DetectorConfig.presets`.

    >>> chosen_preset(None, None)
    'default'
    """
    if preset is not None:
        return preset
    return "default" if file is None else read_preset(file)


def complete_preset(incomplete: str) -> list[str]:
    """Presets that a shell proposes.

    >>> complete_preset("pa")
    ['paper']
    """
    return [name for name in DetectorConfig.presets() if name.startswith(incomplete)]


def complete_setting(incomplete: str) -> list[str]:
    """Settings that a shell proposes, up to where the value is to be typed.

    >>> complete_setting("ground.tol")
    ['ground.tolerance_m=']
    """
    return [f"{name}=" for name in all_fields(DetectorConfig()) if name.startswith(incomplete)]


def complete_track_setting(incomplete: str) -> list[str]:
    """Settings of the tracker that a shell proposes, up to where the value is to be typed.

    >>> complete_track_setting("max_m")
    ['max_misses=']
    """
    return [f"{name}=" for name in all_fields(TrackConfig()) if name.startswith(incomplete)]
