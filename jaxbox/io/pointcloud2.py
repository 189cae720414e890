"""ROS's ``sensor_msgs/PointCloud2``: any order of fields, padding, either byte order, organised or not."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from jaxbox._files import InputError
from jaxbox.io.point_times import timed_points
from jaxbox.io.points import (
    Points,
    TimedPoints,
    check_num_bytes,
    check_num_points,
    named_points,
    record_dtype,
)

MESSAGE_TYPES = ("sensor_msgs/msg/PointCloud2", "sensor_msgs/PointCloud2")
"""Names of the message in ROS 2 and ROS 1."""

_DTYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8")
"""By the number of `PointField.datatype`."""


_NS_PER_S = 10**9


class PointField(Protocol):
    """``sensor_msgs/PointField``, whichever library decoded it."""

    name: str
    offset: int
    datatype: int
    count: int


class PointCloud2(Protocol):
    """``sensor_msgs/PointCloud2``, whichever library decoded it."""

    header: Any
    height: int
    width: int
    fields: Sequence[Any]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: Any


@dataclasses.dataclass(frozen=True)
class _Layout:
    """Where the rows and points of a message lie in its data, bytes."""

    height: int
    width: int
    point_step: int
    row_step: int

    @property
    def num_bytes(self) -> int:
        """From the first point's first byte to the last one's last."""
        if not self.height * self.width:
            return 0
        return (self.height - 1) * self.row_step + self.width * self.point_step


def decode_pointcloud2(message: PointCloud2, where: str) -> Points:
    """Takes the points out of a message.

    Args:
      message: a cloud of n points, row by row.
      where: recording, topic and time, for the error.

    Returns:
      As `jaxbox.io.read_points`.

    Raises:
      InputError: where the data is shorter than the message says, or x, y or z is missing.
    """
    return named_points(_columns(message, where), where)


def decode_timed_pointcloud2(message: PointCloud2, where: str) -> TimedPoints:
    """Takes the points, and when each was measured, out of a message.

    Args:
      message: as `decode_pointcloud2`; times count from the stamp of its header.
      where: recording, topic and time, for the error.

    Returns:
      The points, without times where no field is named as one of `jaxbox.io.point_times.TIME_NAMES`.

    Raises:
      InputError: as `decode_pointcloud2`, and where the unit of the times is not clear.
    """
    return timed_points(_columns(message, where), where, sweep_ns=stamp_ns(message.header.stamp) or None)


def stamp_ns(stamp: Any) -> int:
    """The time of a header.

    Args:
      stamp: of a message of ROS 1 or ROS 2.

    Returns:
      ns since 1970; 0 where it was not set.
    """
    return stamp.sec * _NS_PER_S + stamp.nanosec


def _columns(message: PointCloud2, where: str) -> dict[str, np.ndarray]:
    check_num_points(message.height * message.width, where)
    # Some drivers leave row_step 0 for clouds of one row.
    row_step = message.row_step or message.width * message.point_step
    layout = _Layout(message.height, message.width, message.point_step, row_step)
    data = np.frombuffer(memoryview(message.data), np.uint8)
    check_num_bytes(layout.num_bytes, data.size, where)
    dtype = _point_dtype(message, where)
    if layout.num_bytes == 0:
        points = np.zeros(0, dtype)
    else:
        strides = (layout.row_step, layout.point_step)
        points = np.ndarray((layout.height, layout.width), dtype, data, strides=strides).ravel()
    return {name: points[name] for name in points.dtype.names or ()}


def _point_dtype(message: PointCloud2, where: str) -> np.dtype:
    """The fields of one value each, where they lie within a point."""
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for field in message.fields:
        if not 0 < field.datatype < len(_DTYPES):
            raise InputError(f"{where}: field {field.name} has the unknown datatype {field.datatype}.")
        kind = np.dtype(order + _DTYPES[field.datatype])
        if field.offset + kind.itemsize > message.point_step:
            raise InputError(
                f"{where}: field {field.name} ends at byte {field.offset + kind.itemsize} of a point of "
                f"{message.point_step}; the message was written wrongly."
            )
        # A count of 0 is how some drivers say 1; a list of values is not a coordinate.
        if field.name and field.name not in names and field.count <= 1:
            names.append(field.name)
            formats.append(kind)
            offsets.append(field.offset)
    layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    return record_dtype(layout, where)
