"""Fields by dotted name, such as ``vehicles.ring_weight`` or ``clustering.maps.0.min_height_m``.

A name is the path through `DetectorConfig`; a number picks an item of a tuple. A traced field is a
threshold that compiled code takes as an operand; a static one decides a shape and compiles again.

The same names are the keys of a settings file: tables are the stages, an array of tables is a tuple, and a
dotted key reaches one value. `config_to_toml` writes such a text, `config_from_toml` reads it.
"""

import ast
import dataclasses
import difflib
import json
import tomllib
import typing
from collections.abc import Iterator, Mapping
from typing import Any, Literal, TypeVar

import jax
import numpy as np

from jaxbox.config import DetectorConfig, TrackConfig
from jaxbox.config.ranges import MAX_SHOWN, ConfigError, Range, checked_number, range_of, shown

Config = TypeVar("Config", DetectorConfig, TrackConfig)
"""Settings of the detector or of the tracker."""

NUM_NEAREST = 3
"""Names that an error proposes."""
NO_VALUE = "none"
"""How a settings file says None, for which TOML has no word."""
PRESET_KEY = "preset"
"""Key of a settings file that names the preset which the other keys change."""
SENSOR_KEY = "sensor"
"""Key of a settings file that says for how many beams the preset is to be; see `jaxbox.config.sensors`."""
MAX_DEPTH = 8
"""Tables within tables of a settings file; no setting lies half as deep."""
_TYPE_NAMES = {bool: "True or False", int: "a whole number", str: "a word", type(None): "None"}


@dataclasses.dataclass(frozen=True)
class _Leaf:
    name: str
    value: Any
    static: bool
    hint: Any

    @property
    def allowed_types(self) -> set[type]:
        return {part for part in (self.hint, *typing.get_args(self.hint)) if isinstance(part, type)}

    @property
    def range(self) -> Range:
        return range_of(self.name, is_static=self.static, is_whole=float not in self.allowed_types)


def traced_fields(config: DetectorConfig) -> dict[str, Any]:
    """Every traced setting by its dotted name, in the order of the stages.

    Args:
      config: the settings.

    Returns:
      The thresholds; none of them recompiles `jaxbox.detect` when it moves.

    >>> traced_fields(DetectorConfig())["ground.tolerance_m"]
    0.1
    """
    return {name: leaf.value for name, leaf in _leaves(config) if not leaf.static}


def all_fields(config: DetectorConfig | TrackConfig) -> dict[str, Any]:
    """Every setting by its dotted name, the static ones too.

    Args:
      config: the settings.

    Returns:
      The values, in the order of the stages.

    >>> all_fields(DetectorConfig.paper())["box.criterion"]
    'area'
    """
    return {name: leaf.value for name, leaf in _leaves(config)}


def traced_ranges(config: DetectorConfig | TrackConfig) -> dict[str, Range]:
    """The range of every traced setting.

    Args:
      config: the settings.

    Returns:
      By dotted name, in the order of `traced_fields`.

    >>> traced_ranges(DetectorConfig())["vehicles.max_overlap"].text
    'a finite number from 0 to 1'
    """
    return {name: leaf.range for name, leaf in _leaves(config) if not leaf.static}


def check_static(config: DetectorConfig | TrackConfig) -> None:
    """Refuses static settings of a wrong type or outside their range, as `replace_fields` does.

    Args:
      config: the settings, in which NumPy's numbers will do for Python's.

    Raises:
      ConfigError: naming the setting.
    """
    for name, leaf in _leaves(config):
        if leaf.static:
            value = leaf.value.item() if isinstance(leaf.value, np.generic) else leaf.value
            _checked_value(name, leaf, value)


def replace_fields(config: Config, changes: Mapping[str, Any]) -> Config:
    """Changes settings by their dotted names.

    Args:
      config: the settings.
      changes: the new value of each.

    Returns:
      The changed settings.

    Raises:
      ConfigError: naming the setting, where there is none of that name (with the nearest), or where it
        cannot take the value; a `ValueError`.

    >>> replace_fields(DetectorConfig(), {"clustering.maps.1.cell_m": 0.3}).clustering.maps[1].cell_m
    0.3
    """
    leaves = dict(_leaves(config))
    for name, value in changes.items():
        if name not in leaves:
            raise ConfigError(f"there is no setting {name}; nearest are {nearest_fields(name, leaves)}.")
        config = _replaced(config, name.split("."), _checked_value(name, leaves[name], value))
    return config


def apply_tables(config: DetectorConfig, tables: Mapping[str, Any]) -> DetectorConfig:
    """Changes settings by nested tables, dotted names, or both, as a parsed settings file holds them.

    Args:
      config: the settings.
      tables: values by name. A list of tables sets the length of a tuple, and its items begin as those of
        `config` or, beyond them, as the defaults; ``"none"`` is None.

    Returns:
      The changed settings.

    Raises:
      ValueError: naming the setting, as `replace_fields`.

    >>> maps = [{"cell_m": 0.3}, {"cell_m": 0.6}]
    >>> [m.cell_m for m in apply_tables(DetectorConfig(), {"clustering": {"maps": maps}}).clustering.maps]
    [0.3, 0.6]
    """
    values: dict[str, Any] = {}
    lengths: dict[str, int] = {}
    _flatten(tables, "", values, lengths)
    for name, length in lengths.items():
        config = _resized(config, name, length)
    return replace_fields(config, values)


def config_from_toml(text: str, *, base: DetectorConfig | None = None) -> DetectorConfig:
    """Reads the text of a settings file.

    Args:
      text: TOML; what it does not name stays as in the base.
      base: settings to start from; None for the preset that the text names under ``preset``, or else the
        default one, for the number of beams that it names under ``sensor``.

    Returns:
      The settings.

    Raises:
      ValueError: with the line where it is not TOML, or with the setting, as `replace_fields`.

    >>> config_from_toml("vehicles.max_overlap = 0.2").vehicles.max_overlap
    0.2
    """
    tables = tomllib.loads(text)
    return apply_tables(base_of(tables, preset=base), without_base(tables))


def base_of(
    tables: Mapping[str, Any], *, preset: DetectorConfig | None = None, sensor: int | None = None
) -> DetectorConfig:
    """What the other keys of a parsed settings file change: a preset, for a sensor.

    Args:
      tables: of the file.
      preset: instead of the one that the file names, or else of the default one.
      sensor: number of beams instead of the file's; where neither says, the preset stays as it is.

    Returns:
      The settings.

    Raises:
      ValueError: for an unknown name, or a number of beams without settings.
    """
    preset = preset_config(tables.get(PRESET_KEY, "default")) if preset is None else preset
    sensor = tables.get(SENSOR_KEY) if sensor is None else sensor
    if sensor is None:
        return preset
    if isinstance(sensor, bool) or not isinstance(sensor, int):
        raise ConfigError(f"{SENSOR_KEY} is {shown(sensor)}; it must be a number of beams, such as 32.")
    return DetectorConfig.for_sensor(sensor, base=preset)


def without_base(tables: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of a settings file without what names its base: preset and sensor."""
    return {name: value for name, value in tables.items() if name not in (PRESET_KEY, SENSOR_KEY)}


def preset_config(name: Any) -> DetectorConfig:
    """A preset by its name.

    Args:
      name: one of `DetectorConfig.presets`.

    Returns:
      Its settings.

    Raises:
      ValueError: for another name.
    """
    presets = DetectorConfig.presets()
    if not isinstance(name, str) or name not in presets:
        text = name if isinstance(name, str) else shown(name)
        raise ConfigError(f"{text}: there is no such preset; choose one of {', '.join(presets)}.")
    return presets[name]


def config_to_toml(config: DetectorConfig) -> str:
    """Writes every setting, so that `config_from_toml` makes the same settings from any base.

    Args:
      config: the settings, each threshold one number.

    Returns:
      TOML: a table a stage, an array of tables for component maps and classes.

    >>> config_to_toml(DetectorConfig()).splitlines()[:3]
    ['[region]', 'half_x_m = 80.0', 'half_y_m = 60.0']
    """
    tables: dict[tuple[str, ...], list[str]] = {}
    for name, leaf in _leaves(config):
        *table, key = name.split(".")
        tables.setdefault(tuple(table), []).append(f"{key} = {_toml_value(leaf)}")
    roots = list(dict.fromkeys(table[0] for table in tables))
    # A stage's own values stand before its arrays, or TOML would take them for the last item's.
    ordered = sorted(tables, key=lambda table: (roots.index(table[0]), len(table)))
    blocks = [[_toml_header(table), *tables[table]] for table in ordered]
    return "\n\n".join("\n".join(block) for block in blocks) + "\n"


def _toml_header(table: tuple[str, ...]) -> str:
    if table[-1].isdecimal():
        return f"[[{'.'.join(table[:-1])}]]"
    return f"[{'.'.join(table)}]"


def _toml_value(leaf: _Leaf) -> str:
    if leaf.value is None:
        return json.dumps(NO_VALUE)
    if isinstance(leaf.value, bool | str):
        return json.dumps(leaf.value)
    return repr(float(leaf.value)) if float in leaf.allowed_types else repr(int(leaf.value))


def _flatten(node: Any, name: str, values: dict[str, Any], lengths: dict[str, int], depth: int = 0) -> None:
    """Splits nested tables into values by dotted name, and the lengths of lists of tables."""
    if depth > MAX_DEPTH:
        raise ConfigError(f"tables within tables, more than {MAX_DEPTH} deep, under {name[:MAX_SHOWN]}.")
    if isinstance(node, Mapping):
        parts = node.items()
    elif isinstance(node, list) and all(isinstance(part, Mapping) for part in node):
        lengths[name] = len(node)
        parts = enumerate(node)
    else:
        values[name] = node
        return
    for key, part in parts:
        _flatten(part, f"{name}.{key}" if name else str(key), values, lengths, depth + 1)


def _resized(config: DetectorConfig, name: str, length: int) -> DetectorConfig:
    """A tuple of sub-configs of another length."""
    items: Any = config
    steps = name.split(".")
    for step in steps:
        items = getattr(items, step, None)
    if not isinstance(items, tuple) or not items:
        lists = dict.fromkeys(leaf.partition(".0.")[0] for leaf, _ in _leaves(config) if ".0." in leaf)
        raise ValueError(f"{name} is not a list; nearest lists are {nearest_fields(name, lists)}.")
    # Another class would have no defaults to begin with: there are as many as labels.
    is_open = all(field.default is not dataclasses.MISSING for field in dataclasses.fields(items[0]))
    if length < 1 or (length != len(items) and not is_open):
        wanted = "at least 1" if is_open else str(len(items))
        raise ValueError(f"{name} has {length} entries; it must have {wanted}.")
    more = tuple(type(items[0])() for _ in range(length - len(items)))
    return _replaced(config, steps, (items + more)[:length])


def changed_fields(config: DetectorConfig, base: DetectorConfig) -> dict[str, Any]:
    """What to change in a base to get some settings, the inverse of `replace_fields`.

    Args:
      config: the settings.
      base: of the same presets' structure, such as the preset that they came from.

    Returns:
      The values that differ, by dotted name.
    """
    values = {name: leaf.value for name, leaf in _leaves(base)}
    return {name: leaf.value for name, leaf in _leaves(config) if leaf.value != values.get(name, leaf)}


def differing_names(
    config: DetectorConfig,
    options: Mapping[str, Any],
    *,
    earlier: DetectorConfig,
    recorded: Mapping[str, Any],
) -> list[str]:
    """Names of the settings and options in which a run differs from the earlier one that it would resume.

    Args:
      config: the settings now.
      options: other options that the results depend on, now.
      earlier: the settings then.
      recorded: the options then.

    Returns:
      Dotted names and names of options; empty where nothing differs.
    """
    other = [name for name, value in options.items() if recorded.get(name) != value]
    return [*changed_fields(earlier, config), *other]


def recorded_options(account: str | bytes) -> Mapping[str, Any]:
    """The options recorded in the account of a run.

    Args:
      account: JSON with the options under "options".

    Raises:
      ValueError: where it is broken.
    """
    try:
        return dict(json.loads(account)["options"])
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError("it does not say with which options the run was made") from error


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
    # The last two for brackets within brackets without end.
    except (ValueError, SyntaxError, RecursionError, MemoryError):
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
    nearest = nearest_fields(name, traced_fields(config))
    if name in leaves:
        raise ValueError(
            f"{name} is static: each value would compile the detector again. "
            f"Nearest traced settings: {nearest}."
        )
    raise ValueError(f"there is no setting {name}; nearest traced settings: {nearest}.")


def nearest_fields(name: str, known: Mapping[str, Any]) -> str:
    """The known names that look most like one, as a list in words.

    Args:
      name: what was written.
      known: what there is, by dotted name.

    Returns:
      Up to `NUM_NEAREST` names, best first.

    >>> nearest_fields("vehicles.ring_wieght", traced_fields(DetectorConfig())).split(",")[0]
    'vehicles.ring_weight'
    """
    return ", ".join(difflib.get_close_matches(name, known, n=NUM_NEAREST, cutoff=0.0))


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, _Leaf]]:
    """Every setting below a config, depth first."""
    hints = typing.get_type_hints(type(node))
    for field in dataclasses.fields(node):
        value = getattr(node, field.name)
        parts = enumerate(value) if isinstance(value, tuple | list) else [(None, value)]
        for index, part in parts:
            name = f"{prefix}{field.name}" + ("" if index is None else f".{index}")
            if dataclasses.is_dataclass(part):
                yield from _leaves(part, f"{name}.")
            else:
                yield name, _Leaf(name, part, bool(field.metadata.get("static")), hints[field.name])


def _checked_value(name: str, leaf: _Leaf, value: Any) -> Any:
    """The value as the setting holds it: a float where a whole number was given for one."""
    if not leaf.static and isinstance(value, jax.Array):
        return value
    if typing.get_origin(leaf.hint) is Literal:
        choices = typing.get_args(leaf.hint)
        if value not in choices:
            raise ConfigError(f"{name} is {shown(value)}; choose one of {', '.join(map(str, choices))}.")
        return value
    allowed = leaf.allowed_types
    # An int in the place of a threshold would be another type to the compiler, which then starts again.
    if float in allowed:
        return checked_number(name, value, leaf.range)
    if isinstance(value, str) and value == NO_VALUE and type(None) in allowed:
        return None
    # A bool is an int to Python; nothing is exchanged here.
    if type(value) not in allowed:
        wanted = " or ".join(sorted(_TYPE_NAMES.get(t, t.__name__) for t in allowed))
        raise ConfigError(f"{name} is {shown(value)}; it must be {wanted}.")
    if type(value) is int:
        checked_number(name, value, leaf.range)
    return value


def _replaced(node: Any, path: list[str], value: Any) -> Any:
    if not path:
        return value
    step, rest = path[0], path[1:]
    if isinstance(node, tuple):
        index = int(step)
        return (*node[:index], _replaced(node[index], rest, value), *node[index + 1 :])
    return dataclasses.replace(node, **{step: _replaced(getattr(node, step), rest, value)})
