"""The settings of a page as the text that ``jaxbox detect --config`` reads."""

import json
from typing import Any

from jaxbox.config import DetectorConfig
from jaxbox.config.fields import NO_VALUE, PRESET_KEY, changed_fields, config_to_toml


def config_text(config: DetectorConfig, preset: str | None, *, min_score: float) -> str:
    """Writes settings as TOML, as short as it goes.

    Args:
      config: the settings.
      preset: the preset of which they differ by single values: only those are written. None writes all.
      min_score: boxes of lower scores were hidden; the text says by which option `detect` leaves them out.

    Returns:
      TOML, from which `jaxbox.io.read_config` makes the same settings.

    >>> print(config_text(DetectorConfig.paper(), "paper", min_score=0.2))
    # jaxbox detect SWEEPS --output out --config THIS_FILE --min-score 0.2
    preset = "paper"
    <BLANKLINE>
    """
    command = f"# jaxbox detect SWEEPS --output out --config THIS_FILE --min-score {min_score:g}\n"
    if preset is None:
        return command + config_to_toml(config)
    changes = changed_fields(config, DetectorConfig.presets()[preset])
    lines = [f"{name} = {_toml_value(value)}\n" for name, value in {PRESET_KEY: preset, **changes}.items()]
    return command + "".join(lines)


def _toml_value(value: Any) -> str:
    return json.dumps(NO_VALUE if value is None else value)
