"""Recordings: files of many sweeps, which are read one message after the other.

A new kind is a module with a `RecordingFormat`, and a line in `jaxbox.io.sweeps`.
"""

import dataclasses
import difflib
import itertools
import pathlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, overload

from jaxbox._files import InputError
from jaxbox.io.convention import ORDINARY
from jaxbox.io.points import RecordedPoints
from jaxbox.io.sweep import Sweep

Message = tuple[int, RecordedPoints]
"""Time in ns, and what decodes the points."""

PoseMessage = tuple[str, int, Any]
"""Topic, time in ns at which it was recorded, and a message of `POSE_TYPES`."""

ODOMETRY = "nav_msgs/msg/Odometry"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
POSE_TYPES: Mapping[str, str] = {
    ODOMETRY: ODOMETRY,
    "nav_msgs/Odometry": ODOMETRY,
    TF_MESSAGE: TF_MESSAGE,
    "tf2_msgs/TFMessage": TF_MESSAGE,
    # Before tf2 ROS 1 had the same message under another name.
    "tf/msg/tfMessage": TF_MESSAGE,
    "tf/tfMessage": TF_MESSAGE,
}
"""Messages that say where something is, by the names that recordings give them."""

_MAX_NAMED = 12


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordingFormat:
    """A kind of file, or folder, that holds many sweeps."""

    name: str
    """In words, for the documentation and errors."""
    suffixes: tuple[str, ...]
    """Lower-case ends of its file names."""
    open: Callable[[pathlib.Path, str | None], "RecordedSweeps"]
    """Opens one by its path and the topic to take, None for the only one."""
    read_poses: Callable[[pathlib.Path], Iterator[PoseMessage]] = lambda _: iter(())
    """Reads its odometry and transforms, in the order of time; none where its kind has none."""
    is_folder: Callable[[pathlib.Path], bool] = lambda _: False
    """Whether a folder is one of them."""


class RecordedSweeps(Sequence[Sweep]):
    """The sweeps of one topic of a recording, in the order of time.

    Each pass reads the recording from its start and holds one message at a time; a sweep keeps its
    message until it is dropped. An item by its number costs a pass up to it.
    """

    def __init__(
        self, path: pathlib.Path, topic: str, count: int, messages: Callable[[], Iterator[Message]]
    ) -> None:
        self.path = path
        """The recording."""
        self.topic = topic
        """The topic that the sweeps are from."""
        self.convention = ORDINARY
        """How the points of each are to be taken."""
        self._count = count
        self._messages = messages

    def __len__(self) -> int:
        """Messages of the topic, by the recording's index."""
        return self._count

    def name_of(self, index: int) -> str:
        """The name of a sweep: its number behind that of the recording."""
        return f"{self.path.stem}_{index:06d}"

    def __iter__(self) -> Iterator[Sweep]:
        """One pass over the recording."""
        for index, (timestamp_ns, decode) in enumerate(self._messages()):
            yield Sweep(
                self.name_of(index),
                self.path,
                timestamp_ns=timestamp_ns,
                sequence=self.path.stem,
                decode=decode,
                convention=self.convention,
            )

    @overload
    def __getitem__(self, index: int) -> Sweep: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Sweep, ...]: ...
    def __getitem__(self, index: int | slice) -> Sweep | tuple[Sweep, ...]:
        """A sweep by its number, or several."""
        wanted = range(len(self))[index]
        if isinstance(wanted, int):
            return next(itertools.islice(self, wanted, None))
        if len(wanted) == 0:
            return ()
        ascending = wanted if wanted.step > 0 else wanted[::-1]
        found = tuple(itertools.islice(self, ascending.start, ascending.stop, ascending.step))
        return found if wanted.step > 0 else found[::-1]


def choose_topic(
    path: pathlib.Path,
    topic: str | None,
    counts: Mapping[str, int],
    others: Sequence[str],
    packets: Collection[str] = (),
) -> str:
    """Picks the topic of points that is meant.

    Args:
      path: the recording, for the error.
      topic: its name, or None for the only one.
      counts: number of messages of each topic of points.
      others: names of the other topics, for the error.
      packets: those of `counts` that are a sensor's packets: None means one of them only where there is
        nothing else, as a driver's points are likely of the same sensor.

    Returns:
      A name of `counts`.

    Raises:
      InputError: where there is no such topic, or none is named among several.

    >>> choose_topic(pathlib.Path("a.bag"), None, {"/points": 3}, ["/imu"])
    '/points'
    """
    if topic is None and (points := {name: n for name, n in counts.items() if name not in packets}):
        counts = points
    listed = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
    if not counts:
        names = ", ".join(sorted(others)[:_MAX_NAMED]) or "none at all"
        raise InputError(
            f"{path}: no topic of sensor_msgs/PointCloud2, or of velodyne_msgs/VelodyneScan; its topics are "
            f"{names}."
        )
    if topic is None and len(counts) > 1:
        raise InputError(f"{path}: several topics of points: {listed}; choose one with --topic (topic=...).")
    if topic is not None and topic not in counts:
        nearest = difflib.get_close_matches(topic, counts, n=1, cutoff=0.0)
        raise InputError(f"{path}: no topic {topic} of points; there are {listed}. Nearest: {nearest[0]}.")
    return topic or next(iter(counts))
