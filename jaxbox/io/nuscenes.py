"""nuScenes sweeps: ``.pcd.bin``, five float32 a point (x, y, z, intensity, ring) and no header.

They stay in the file's own frame, in which x points right and y forward; boxes are answered in it too.

Reference: Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020.
"""

import os
import pathlib
import re

from jaxbox.io.points import PointFormat, Points, read_float_rows

_COLUMNS = 5
_NS_PER_US = 1000


def read_nuscenes(path: str | os.PathLike[str]) -> Points:
    """Reads a sweep of nuScenes.

    Args:
      path: the file.

    Returns:
      As `jaxbox.io.read_points`; x points right and y forward.

    Raises:
      InputError: where it is missing, or its size is not a multiple of 20 bytes.
    """
    points = read_float_rows(path, _COLUMNS, "x, y, z, intensity, ring")
    return points[:, :3], points[:, 3]


def nuscenes_timestamp_ns(path: pathlib.Path) -> int | None:
    """The time in a file's name.

    >>> name = "n015-2018-07-24-11-22-45+0800__LIDAR_TOP__1532402927647951.pcd.bin"
    >>> nuscenes_timestamp_ns(pathlib.Path(name))
    1532402927647951000
    """
    match = re.search(r"__(\d+)\.pcd\.bin$", path.name, re.IGNORECASE)
    return int(match[1]) * _NS_PER_US if match else None


NUSCENES = PointFormat(
    name="nuScenes", suffixes=(".pcd.bin",), read=read_nuscenes, timestamp_ns=nuscenes_timestamp_ns
)
