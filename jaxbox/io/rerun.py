"""Detections, or tracks, as a recording of the rerun viewer: points, boxes, and the image with their edges.

Entities: ``world/points``, ``world/boxes``, ``camera/image`` and ``camera/boxes``, and of tracks
``world/trails`` and ``world/velocities``; timelines ``sweep``, its number, and ``time``.
``rerun FILE.rrd`` shows it.
"""

import contextlib
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jaxbox._extras import require
from jaxbox._files import atomic_path
from jaxbox.geometry.projection import project_boxes
from jaxbox.io.foxglove import caption_of, color_of
from jaxbox.io.results import ResultFile, SweepResult, WriteResult
from jaxbox.types import Calibration

_JPEG_QUALITY = 85
_BOX_STEP = 128
"""The projection of boxes is compiled for multiples of this."""
_POINT_RADIUS_M = 0.03
_HEIGHTS_M = (-2.0, 2.0)
_LOW, _HIGH = np.array([70, 90, 130]), np.array([250, 245, 220])

_project_boxes = jax.jit(project_boxes)


@contextlib.contextmanager
def open_rerun(path: pathlib.Path, resume: bool = False) -> Iterator[WriteResult]:
    """Opens a recording for the results of a run.

    Args:
      path: the file, ``.rrd``; its folder is made where it is missing.
      resume: must be False: a recording cannot be continued.

    Yields:
      What adds a sweep.

    Raises:
      ValueError: for `resume`.
      ImportError: without the extra ``rerun``.
    """
    if resume:
        raise ValueError("a rerun recording cannot be continued.")
    rerun = require("rerun", extra="rerun", what="rerun recordings")
    with atomic_path(path) as temporary:
        recording = rerun.RecordingStream("jaxbox")
        recording.save(str(temporary))
        recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        index = 0

        def write(result: SweepResult) -> None:
            nonlocal index
            recording.set_time("sweep", sequence=index)
            recording.set_time("time", timestamp=np.datetime64(result.time_ns(index), "ns"))
            _log_world(rerun, recording, result)
            _log_camera(rerun, recording, result)
            index += 1

        try:
            yield write
        finally:
            recording.flush()
            recording.disconnect()


def _log_world(rerun: Any, recording: Any, result: SweepResult) -> None:
    if result.xyz is not None:
        xyz = result.xyz[np.isfinite(result.xyz).all(axis=1)]
        low, high = _HEIGHTS_M
        share = np.clip((xyz[:, 2:] - low) / (high - low), 0, 1)
        colors = (_LOW + share * (_HIGH - _LOW)).astype(np.uint8)
        recording.log("world/points", rerun.Points3D(xyz, colors=colors, radii=_POINT_RADIUS_M))
    center, size, yaw = _arrays(result.record)
    boxes, colors = result.record["boxes"], _colors(result.record)
    drawn = rerun.Boxes3D(
        centers=center,
        half_sizes=size / 2,
        quaternions=np.column_stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)]),
        labels=[caption_of(box) for box in boxes],
        colors=colors,
    )
    recording.log("world/boxes", drawn)
    if result.trails is None:
        return
    trails = [result.trails.get(box["id"], np.zeros((0, 3))) for box in boxes]
    recording.log("world/trails", rerun.LineStrips3D(trails, colors=colors))
    is_moving = np.array([box["state"] != "standing" for box in boxes], bool)
    velocity = np.array([[*box["velocity"], 0.0] for box in boxes]).reshape(-1, 3)
    arrows = rerun.Arrows3D(origins=center[is_moving], vectors=velocity[is_moving], colors=colors[is_moving])
    recording.log("world/velocities", arrows)


def _log_camera(rerun: Any, recording: Any, result: SweepResult) -> None:
    if result.calibration is None or result.image is None:
        return
    recording.log("camera/image", rerun.Image(result.image).compress(jpeg_quality=_JPEG_QUALITY))
    lines, colors = _image_lines(result.record, result.calibration)
    recording.log("camera/boxes", rerun.LineStrips2D(lines, colors=colors))


def _image_lines(record: Mapping[str, Any], calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """(lines, 2, 2) px: edges of the boxes that the camera sees; (lines, 3) uint8 colours."""
    center, size, yaw = _arrays(record)
    if len(yaw) == 0:
        return np.zeros((0, 2, 2)), np.zeros((0, 3), np.uint8)
    count = len(yaw)
    # Every new number of boxes would compile the projection again.
    rows = np.arange(_BOX_STEP * -(-count // _BOX_STEP)) % count
    seen = _project_boxes(center[rows], size[rows], yaw[rows], calibration)
    keep = np.asarray(seen.edge_valid)[:count] & np.asarray(seen.visible)[:count, None]
    colors = np.broadcast_to(_colors(record)[:, None], (*keep.shape, 3))
    return np.asarray(seen.edges_uv)[:count][keep], colors[keep]


def _arrays(record: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """center (k, 3), size (k, 3) and yaw (k,) of a record's boxes."""
    boxes = record["boxes"]
    center, size = (
        np.array([box[name] for box in boxes], np.float32).reshape(-1, 3) for name in ("center", "size")
    )
    return center, size, np.array([box["yaw"] for box in boxes], np.float32)


def _colors(record: Mapping[str, Any]) -> np.ndarray:
    colors = [color_of(box) for box in record["boxes"]]
    return (255 * np.array(colors).reshape(-1, 3)).astype(np.uint8)


RERUN = ResultFile(name="detections.rrd", open=open_rerun, wants_points=True)
