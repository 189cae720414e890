"""stream(): recorded sweeps through the detector, the next one read while one is computed."""

import concurrent.futures
import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxbox._box import ByValue
from jaxbox._padding import aligned_empty, checked_points, fill_rows, fitting_capacity
from jaxbox.config import DetectorConfig, TrackConfig
from jaxbox.config.checks import check_config
from jaxbox.run.arguments import as_config, as_key, as_sweeps, dropped_points
from jaxbox.run.batching import checked_devices, detect_on
from jaxbox.run.processes import ProcessPool, WorkerDied, ahead
from jaxbox.types import Detections, PointCloud

NUM_BUFFERS = 3
"""Of each device: one sweep is computed, one has been read, and one is being read."""


class ReadableSweep(Protocol):
    """What `stream` asks of a sweep; `jaxbox.io.Sweep` has it."""

    @property
    def name(self) -> str:
        """Of the sweep, for the results."""
        ...

    def read_points(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Reads (n, 3) x, y, z in m and (n,) intensity, or None for the latter."""
        ...


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class StreamedSweep(ByValue):
    """One sweep that went through, or did not."""

    name: str
    """Of the sweep."""
    num_points: int
    """Points of the sweep; 0 where it could not be read."""
    detections: Detections | None
    """What was found, in arrays of the host; None where the sweep failed."""
    error: str | None
    """Why the sweep failed; None where it did not."""

    def __repr__(self) -> str:
        """The name, and what was found or why nothing was."""
        return f"{type(self).__name__} {self.name}: {self.error or self.detections}"


def stream(
    sweeps: Iterable[ReadableSweep | PointCloud | ArrayLike],
    config: DetectorConfig | str | None = None,
    key: jax.Array | int | None = None,
    *,
    capacity: int | None = None,
    workers: int = 1,
    devices: Sequence[Any] | None = None,
    track: TrackConfig | None = None,
) -> Iterator[StreamedSweep]:
    """Finds the vehicles of recorded sweeps, and reads ahead meanwhile.

    With one worker a thread reads and pads the next sweeps while some are computed, into buffers that are
    used again, and the devices take turns, see `detect_batch`: to use all cores of a CPU, ask for several
    devices. With more workers, each sweep is read, padded and computed by one of that many processes, which
    a script must start under ``if __name__ == "__main__":``. Each device and each process compiles, or takes
    the program from JAX's compilation cache where that is on.

    It asks for sweeps before their turn: a sensor's, which come one by one, are for `detect`.

    Args:
      sweeps: what `jaxbox.io.open_sweeps` gives, or the like; with several workers they are pickled. Arrays
        (n, 3 or more), as `detect` takes them, are named by their number: "000000".
      config: the settings of all, or the name of a preset; None for the default preset.
      key: the JAX random key of all, or an integer, its seed; None for 0.
      capacity: points that every sweep is padded to; None for the bucket that holds it.
      workers: processes; with 1 it is this one.
      devices: JAX devices of this process to compute on; None for all of them, and with several
        workers, each of which computes on its own first device.
      track: the tracker's settings, to follow the vehicles of one drive too: `jaxbox.track`, which also
        takes poses and rates, gives the results. None for each sweep by itself.

    Yields:
      The result of each sweep, in their order, as `detect` gives it: on a CPU, with the same bits. One that
      cannot be read comes with an error, and the others go on. One whose process dies is tried in a new
      process, and comes with an error where that dies too. With `track` they are `jaxbox.TrackedSweep`.

    Raises:
      ValueError: for settings that contradict each other, workers below 1, no devices, or devices together
        with several workers; when its turn comes, for an array of another shape.
      TypeError: for one sweep or a path instead of sweeps; when its turn comes, for anything but a sweep.
    """
    if track is not None:
        from jaxbox.run import tracking  # noqa: PLC0415 - it is built on this module

        return tracking.track(
            sweeps, config, track, key=key, capacity=capacity, workers=workers, devices=devices
        )
    if workers < 1:
        raise ValueError(f"workers is {workers}; it must be at least 1.")
    config = as_config(config)
    check_config(config)
    readable, one_key = as_sweeps(sweeps, called="jaxbox.stream"), None if key is None else as_key(key)
    if workers == 1:
        return _stream_here(readable, config, one_key, capacity, checked_devices(devices))
    if devices is not None:
        raise ValueError(f"workers is {workers} and devices are named; name one of the two.")
    return _stream_in_processes(readable, _Settings.pack(config, one_key, capacity), workers)


class _Buffer:
    """Padded arrays that sweeps of one capacity after the other are written to."""

    def __init__(self) -> None:
        self._rows, self._intensity = aligned_empty((0, 4)), aligned_empty((0,))

    def fill(
        self, xyz: np.ndarray, intensity: np.ndarray | None, capacity: int | None, num_dropped: int
    ) -> PointCloud:
        """A cloud that holds until the buffer is filled again."""
        xyz, intensity = checked_points(xyz, intensity)
        capacity = fitting_capacity(len(xyz)) if capacity is None else capacity
        if len(self._rows) != capacity:
            self._rows, self._intensity = aligned_empty((capacity, 4)), aligned_empty((capacity,))
        fill_rows(xyz, intensity, self._rows, self._intensity)
        # On a CPU JAX computes with the buffer itself: who fills it again has waited for the result.
        return PointCloud(self._rows, self._intensity, np.array(len(xyz) + num_dropped, np.int32))


def _read(sweep: ReadableSweep, buffer: _Buffer, capacity: int | None) -> PointCloud | str:
    """The padded sweep, or why there is none."""
    try:
        return buffer.fill(*sweep.read_points(), capacity, dropped_points(sweep))
    except Exception as error:
        # Whatever a reader may raise concerns its own sweep alone.
        return f"{type(error).__name__}: {error}"


def _start(
    name: str, cloud: PointCloud | str, config: DetectorConfig, key: jax.Array | None, device: Any
) -> StreamedSweep:
    """A result whose arrays may still be computing."""
    if isinstance(cloud, str):
        return StreamedSweep(name, 0, None, cloud)
    return StreamedSweep(name, int(cloud.num_points), detect_on(device, cloud, config, key), None)


def _finish(started: StreamedSweep) -> StreamedSweep:
    detections = None if started.detections is None else started.detections.on_host()
    return dataclasses.replace(started, detections=detections)


def _stream_here(
    sweeps: Iterable[ReadableSweep],
    config: DetectorConfig,
    key: jax.Array | None,
    capacity: int | None,
    devices: Sequence[Any],
) -> Iterator[StreamedSweep]:
    buffers = itertools.cycle([_Buffer() for _ in range(NUM_BUFFERS * len(devices))])
    turns = itertools.cycle(devices)

    def start(pair: tuple[ReadableSweep, concurrent.futures.Future[PointCloud | str]]) -> StreamedSweep:
        sweep, read = pair
        return _start(sweep.name, read.result(), config, key, next(turns))

    with concurrent.futures.ThreadPoolExecutor(1) as reader:
        count = len(devices)
        read = ahead(sweeps, lambda sweep: reader.submit(_read, sweep, next(buffers), capacity), count)
        # The devices are busy with the next ones while the caller looks at this.
        for _, computing in ahead(read, start, count):
            yield _finish(computing)


@dataclasses.dataclass(frozen=True)
class _Settings:
    """What a worker needs, in types that can be unpickled before JAX starts."""

    config: DetectorConfig
    key_data: np.ndarray | None
    key_impl: str | None
    capacity: int | None

    @classmethod
    def pack(cls, config: DetectorConfig, key: jax.Array | None, capacity: int | None) -> "_Settings":
        return cls(
            config=jax.tree.map(float, config),
            key_data=None if key is None else np.asarray(jax.random.key_data(key)),
            key_impl=None if key is None else str(jax.random.key_impl(key)),
            capacity=capacity,
        )

    def start(self) -> Callable[[ReadableSweep], StreamedSweep]:
        """In a worker process: what takes each sweep."""
        buffer, key, device = _Buffer(), None, jax.local_devices()[0]
        if self.key_data is not None:
            key = jax.random.wrap_key_data(jnp.asarray(self.key_data), impl=self.key_impl)
        return lambda sweep: _finish(
            _start(sweep.name, _read(sweep, buffer, self.capacity), self.config, key, device)
        )


def _stream_in_processes(
    sweeps: Iterable[ReadableSweep], settings: _Settings, workers: int
) -> Iterator[StreamedSweep]:
    with ProcessPool(settings.start, workers) as pool:
        for sweep, job in ahead(sweeps, pool.submit, 2 * workers):
            try:
                yield job.result()
            except WorkerDied as died:
                yield StreamedSweep(sweep.name, 0, None, str(died))
