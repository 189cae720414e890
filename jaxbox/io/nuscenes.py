"""nuScenes sweeps: ``.pcd.bin``, five float32 a point (x, y, z, intensity, ring) and no header.

They stay in the file's own frame, in which x points right and y forward; boxes are answered in it too.

Reference: Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020.
"""

import os
import pathlib
import re
from typing import Any

import numpy as np

from jaxbox.geometry.rigid import quaternion_of, rotation_about_z
from jaxbox.io.points import PointFormat, Points, read_float_rows
from jaxbox.tracking.tracks import Track, Tracks
from jaxbox.types import Detections

_COLUMNS = 5
_OTHER_NAMES = {"van": "car"}
"""Classes whose name is another one there: a van is one of its cars."""
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


def boxes_to_nuscenes(
    boxes: Detections | Tracks, *, T_global_sensor: np.ndarray | None = None, sample_token: str = ""
) -> list[dict[str, Any]]:
    """Boxes as nuScenes' results have them.

    Args:
      boxes: of one sweep.
      T_global_sensor: (4, 4) m, from the sensor frame to the global one, in which nuScenes wants results;
        None leaves them in the sensor frame.
      sample_token: of the sample that the sweep belongs to.

    Returns:
      One dictionary a box: ``translation`` (3, m), ``size`` (3, m: width, length, height), ``rotation`` (4,
      unit quaternion, real part first, x to the front), ``velocity`` (2, m/s; NaN for detections, as there
      for what is unknown), and name and score of a detection, or id, name and score of a track.
    """
    T = np.eye(4) if T_global_sensor is None else np.asarray(T_global_sensor, np.float64)
    kind = "tracking" if isinstance(boxes, Tracks) else "detection"
    results = []
    for box in boxes:
        length, width, height = box.size.tolist()
        velocity = [*getattr(box, "velocity", (np.nan, np.nan)), 0.0]
        results.append(
            {
                "sample_token": sample_token,
                "translation": (T[:3, :3] @ box.center + T[:3, 3]).tolist(),
                "size": [width, length, height],
                "rotation": quaternion_of(T[:3, :3] @ rotation_about_z(box.heading)).tolist(),
                "velocity": (T[:3, :3] @ velocity)[:2].tolist(),
                f"{kind}_name": _OTHER_NAMES.get(box.label.word, box.label.word),
                f"{kind}_score": box.score,
                **({"tracking_id": str(box.id)} if isinstance(box, Track) else {"attribute_name": ""}),
            }
        )
    return results


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
