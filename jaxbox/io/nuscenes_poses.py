"""Ego poses of nuScenes, from the tables of a ``v1.0-*`` folder.

Those tables are lists of a gigabyte in the whole data set, so they are read one record after the other.

Reference: Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020.
"""

import dataclasses
import json
import pathlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbox._files import InputError, check_file, reason
from jaxbox.io.pose_files import rigid_from_quaternions
from jaxbox.io.pose_track import UnusableSource
from jaxbox.io.sweep import Sweep

_PIECE_CHARACTERS = 2**20
_MAX_RECORD_CHARACTERS = 2**20
"""Of one record; they have some hundred."""
_FIELDS = (("rotation", 4), ("translation", 3))
"""Of a pose, and their numbers."""
_TABLES = ("sample_data.json", "calibrated_sensor.json", "ego_pose.json")


def nuscenes_poses(sweeps: Sequence[Sweep]) -> tuple[np.ndarray, str] | None:
    """Poses of sweeps of nuScenes.

    Args:
      sweeps: ``ROOT/samples/LIDAR_TOP/*.pcd.bin`` or ``ROOT/sweeps/LIDAR_TOP/*.pcd.bin``, at least one.

    Returns:
      (F, 4, 4) float64 T_world_sensor, m, and the folder of the tables; None where the layout is another one,
      or there are no tables.

    Raises:
      InputError: naming table and record, where one is bad.
      UnusableSource: where no table knows all of the sweeps.
    """
    folder = sweeps[0].points_path.parent
    if folder.name != "LIDAR_TOP":
        return None
    root = folder.parent.parent
    versions = [path for path in sorted(root.glob("v1.0-*")) if all((path / t).is_file() for t in _TABLES)]
    names = [sweep.points_path.name for sweep in sweeps]
    missing = names[0]
    for version in versions:
        data = _records(version / "sample_data.json", names, key=_file_name)
        if len(data) == len(set(names)):
            return _poses(version, [data[name] for name in names]), str(version)
        missing = next(name for name in names if name not in data)
    if not versions:
        return None
    raise UnusableSource(f"{', '.join(map(str, versions))}: no record of {missing}")


def _poses(version: pathlib.Path, data: Sequence[dict[str, Any]]) -> np.ndarray:
    parts = []
    for table, field in (
        ("ego_pose.json", "ego_pose_token"),
        ("calibrated_sensor.json", "calibrated_sensor_token"),
    ):
        tokens = [str(record.get(field)) for record in data]
        found = _records(version / table, tokens, key=lambda record: str(record.get("token")))
        if absent := [token for token in tokens if token not in found]:
            raise InputError(f"{version / table}: no record {absent[0]}. Copy the tables again.")
        wxyz, place = (_numbers(found, tokens, version / table, *field) for field in _FIELDS)
        parts.append(rigid_from_quaternions(wxyz, place, _Where(version / table, tokens)))
    T_world_ego, T_ego_sensor = parts
    return T_world_ego @ T_ego_sensor


@dataclasses.dataclass(frozen=True)
class _Where:
    """Table and record of a pose, for errors."""

    path: pathlib.Path
    tokens: Sequence[str]

    def __call__(self, index: int) -> str:
        return f"{self.path}, {self.tokens[index]}"


def _numbers(
    found: Mapping[str, dict[str, Any]], tokens: Sequence[str], path: pathlib.Path, name: str, count: int
) -> np.ndarray:
    """A field of several numbers of each of the records."""
    rows = []
    for token in tokens:
        try:
            rows.append(np.array(found[token][name], np.float64).reshape(count))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}, {token}: no {name} of {count} numbers. Copy the table again."
            ) from error
    return np.array(rows)


def _file_name(record: dict[str, Any]) -> str:
    return str(record.get("filename")).rpartition("/")[2]


def _records(path: pathlib.Path, wanted: Collection[str], *, key: Any) -> dict[str, dict[str, Any]]:
    """Those records of a table whose key is wanted."""
    names = set(wanted)
    return {key(record): record for record in iter_json_records(path) if key(record) in names}


def iter_json_records(path: pathlib.Path) -> Iterator[dict[str, Any]]:
    """Reads a JSON list of objects, one after the other.

    Args:
      path: the file, of any size.

    Yields:
      The objects.

    Raises:
      InputError: where it is not such a list, or an object takes a megabyte.
    """
    check_file(path, max_bytes=None)
    decoder, text, start = json.JSONDecoder(), "", 0
    try:
        with path.open(encoding="utf-8-sig") as file:
            while True:
                start = _skip(text, start)
                if text.startswith("{", start):
                    try:
                        record, start = decoder.raw_decode(text, start)
                        yield record
                        continue
                    except json.JSONDecodeError:
                        # It may end in the next piece.
                        pass
                elif start < len(text):
                    break
                if len(text) - start > _MAX_RECORD_CHARACTERS or not (piece := file.read(_PIECE_CHARACTERS)):
                    break
                text, start = text[start:] + piece, 0
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: JSON that cannot be read ({reason(error)}).") from error
    if text[start:].strip() != "]":
        raise InputError(f"{path}: no JSON list of records to its end. Copy it again.")


def _skip(text: str, start: int) -> int:
    """The next place that is not a blank, comma or opening bracket."""
    while start < len(text) and text[start] in " \t\r\n,[":
        start += 1
    return start
