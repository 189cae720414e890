"""Vehicle poses of Argoverse 2: ``LOG/city_SE3_egovehicle.feather``."""

from collections.abc import Sequence

import numpy as np

from jaxbox._files import InputError
from jaxbox.io.argoverse2 import log_sensor_xyz_m, read_table
from jaxbox.io.pose_files import rigid_from_quaternions
from jaxbox.io.pose_track import PoseTrack, UnusableSource
from jaxbox.io.sweep import Sweep

POSES_FILE = "city_SE3_egovehicle.feather"
"""In the folder of a log."""

_ROTATION, _POSITION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
_TIME = "timestamp_ns"


def argoverse2_poses(sweeps: Sequence[Sweep]) -> tuple[np.ndarray, str] | None:
    """Poses of sweeps of Argoverse 2, of the upper LiDAR that their points are moved to.

    Args:
      sweeps: ``LOG/sensors/lidar/*.feather``, at least one.

    Returns:
      (F, 4, 4) float64 T_world_sensor, m; the world is the city's frame. And the file; None where the layout
      is another one, or has no poses.

    Raises:
      InputError: naming file and row, where it is bad.
      UnusableSource: where it does not cover the sweeps.
      ImportError: without the extra ``arrow``.
    """
    folder = sweeps[0].points_path.parent
    path = folder.parent.parent / POSES_FILE
    if (folder.parent.name, folder.name) != ("sensors", "lidar") or not path.is_file():
        return None
    times = [sweep.timestamp_ns for sweep in sweeps if sweep.timestamp_ns is not None]
    if len(times) < len(sweeps):
        raise UnusableSource(f"{path}: sweeps are not named by their times")
    T_vehicle_sensor = np.eye(4)
    # Points keep the vehicle's axes.
    T_vehicle_sensor[:3, 3] = log_sensor_xyz_m(sweeps[0].points_path)
    try:
        return _read_track(str(path)).at(np.array(times)) @ T_vehicle_sensor, str(path)
    except UnusableSource as error:
        raise UnusableSource(f"{path}: {error}") from error


def _read_track(path: str) -> PoseTrack:
    names = (_TIME, *_ROTATION, *_POSITION)
    table = read_table(path, names)
    if missing := [name for name in names if name not in table or table[name].dtype.kind not in "fiu"]:
        raise InputError(f"{path}: no column {missing[0]} of numbers. Copy the file again.")
    if not len(table[_TIME]):
        raise InputError(f"{path}: it holds no pose.")
    wxyz = np.stack([table[name] for name in _ROTATION], axis=1)
    place = np.stack([table[name] for name in _POSITION], axis=1)
    poses = rigid_from_quaternions(wxyz, place, lambda row: f"{path}, row {row}")
    return PoseTrack.sorted(table[_TIME], poses)
