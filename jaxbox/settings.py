"""Settings by dotted name, such as ``vehicles.ring_weight`` or ``clustering.maps.0.min_height_m``.

A name is the path through `DetectorConfig`; a number picks an item of a tuple. A traced setting is a
threshold that compiled code takes as an operand; a static one decides a shape and compiles anew.
"""

import ast
import dataclasses
import difflib
import math
import typing
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import jax

from jaxbox.config import DetectorConfig

NUM_NEAREST = 3
"""Names that an error proposes."""
_TYPE_NAMES = {bool: "True or False", int: "a whole number", str: "a word", type(None): "None"}


@dataclasses.dataclass(frozen=True)
class _Leaf:
    value: Any
    static: bool
    hint: Any


def traced_settings(config: DetectorConfig) -> dict[str, Any]:
    """Every traced setting by its dotted name, in the order of the stages.

    Args:
      config: the settings.

    Returns:
      The thresholds; none of them recompiles `jaxbox.detect` when it moves.

    >>> traced_settings(DetectorConfig())["ground.tolerance_m"]
    0.1
    """
    return {name: leaf.value for name, leaf in _leaves(config) if not leaf.static}


def replace_settings(config: DetectorConfig, changes: Mapping[str, Any]) -> DetectorConfig:
    """Changes settings by their dotted names.

    Args:
      config: the settings.
      changes: the new value of each.

    Returns:
      The changed settings.

    Raises:
      ValueError: naming the setting, where there is none of that name (with the nearest), or where it
        cannot take the value.

    >>> replace_settings(DetectorConfig(), {"clustering.maps.1.cell_m": 0.3}).clustering.maps[1].cell_m
    0.3
    """
    leaves = dict(_leaves(config))
    for name, value in changes.items():
        if name not in leaves:
            raise ValueError(f"there is no setting {name}; nearest are {nearest_settings(name, leaves)}.")
        _check_value(name, leaves[name], value)
        config = _replaced(config, name.split("."), value)
    return config


def changed_settings(config: DetectorConfig, base: DetectorConfig) -> dict[str, Any]:
    """What to change in a base to get some settings, the inverse of `replace_settings`.

    Args:
      config: the settings.
      base: of the same presets' structure, such as the preset that they came from.

    Returns:
      The values that differ, by dotted name.
    """
    values = {name: leaf.value for name, leaf in _leaves(base)}
    return {name: leaf.value for name, leaf in _leaves(config) if leaf.value != values[name]}


def parse_change(text: str) -> tuple[str, Any]:
    """Reads one ``FIELD=VALUE``.

    Args:
      text: the value is a Python literal, or else a word.

    Returns:
      The dotted name and the value.

    Raises:
      ValueError: where there is no "=".

    >>> parse_change("box.criterion=area"), parse_change("vehicles.max_overlap=0.2")
    (('box.criterion', 'area'), ('vehicles.max_overlap', 0.2))
    """
    name, separator, value = text.partition("=")
    if not separator:
        raise ValueError(f"{text}: write it as FIELD=VALUE.")
    try:
        return name.strip(), ast.literal_eval(value.strip())
    except (ValueError, SyntaxError):
        return name.strip(), value.strip()


def check_traced(config: DetectorConfig, name: str) -> None:
    """Refuses a name that no threshold has.

    Args:
      config: the settings.
      name: dotted.

    Raises:
      ValueError: with the nearest traced settings, where the setting is static or unknown.
    """
    leaves = dict(_leaves(config))
    if name in leaves and not leaves[name].static:
        return
    nearest = nearest_settings(name, traced_settings(config))
    if name in leaves:
        raise ValueError(
            f"{name} is static: each value would compile the detector anew. "
            f"Nearest traced settings: {nearest}."
        )
    raise ValueError(f"there is no setting {name}; nearest traced settings: {nearest}.")


def nearest_settings(name: str, known: Mapping[str, Any]) -> str:
    """The known names that look most like one, as a list in words.

    Args:
      name: what was written.
      known: what there is, by dotted name.

    Returns:
      Up to `NUM_NEAREST` names, best first.

    >>> nearest_settings("vehicles.ring_wieght", traced_settings(DetectorConfig())).split(",")[0]
    'vehicles.ring_weight'
    """
    return ", ".join(difflib.get_close_matches(name, known, n=NUM_NEAREST, cutoff=0.0))


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, _Leaf]]:
    """Every setting below a config, depth first."""
    hints = typing.get_type_hints(type(node))
    for field in dataclasses.fields(node):
        value = getattr(node, field.name)
        parts = enumerate(value) if isinstance(value, tuple) else [(None, value)]
        for index, part in parts:
            name = f"{prefix}{field.name}" + ("" if index is None else f".{index}")
            if dataclasses.is_dataclass(part):
                yield from _leaves(part, f"{name}.")
            else:
                yield name, _Leaf(part, bool(field.metadata.get("static")), hints[field.name])


def _check_value(name: str, leaf: _Leaf, value: Any) -> None:
    if not leaf.static and isinstance(value, jax.Array):
        return
    if typing.get_origin(leaf.hint) is Literal:
        choices = typing.get_args(leaf.hint)
        if value not in choices:
            raise ValueError(f"{name} is {value!r}; choose one of {', '.join(map(str, choices))}.")
        return
    allowed = {part for part in (leaf.hint, *typing.get_args(leaf.hint)) if isinstance(part, type)}
    # A bool is an int to Python, and an int will do for a float; nothing else is exchanged.
    if float in allowed:
        fits = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    else:
        fits = type(value) in allowed
    if not fits:
        wanted = (
            "a finite number"
            if float in allowed
            else " or ".join(sorted(_TYPE_NAMES.get(t, t.__name__) for t in allowed))
        )
        raise ValueError(f"{name} is {value!r}; it must be {wanted}.")


def _replaced(node: Any, path: list[str], value: Any) -> Any:
    if not path:
        return value
    step, rest = path[0], path[1:]
    if isinstance(node, tuple):
        index = int(step)
        return (*node[:index], _replaced(node[index], rest, value), *node[index + 1 :])
    return dataclasses.replace(node, **{step: _replaced(getattr(node, step), rest, value)})
