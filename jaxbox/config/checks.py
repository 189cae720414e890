"""Fields of the configuration that contradict each other."""

from jaxbox.config.presets import DetectorConfig


def check_config(config: DetectorConfig) -> None:
    """Refuses fields that contradict each other.

    Args:
      config: of the detector.

    Raises:
      ValueError: naming the fields and what to do.
    """
    if config.completion.mode != "evidence":
        return
    if not config.evidence.enabled:
        raise ValueError(
            'completion.mode is "evidence" but evidence.enabled is False; '
            'enable the evidence, or set completion.mode to "away" or "none".'
        )
    if config.box.criterion not in ("closeness", "visible_closeness"):
        raise ValueError(
            f'completion.mode "evidence" weighs closeness, but box.criterion is {config.box.criterion!r}; '
            'choose a closeness criterion, or set completion.mode to "away" or "none".'
        )
