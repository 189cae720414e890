"""A partition of sweeps that are detected in batches, to one file of boxes."""

import concurrent.futures
import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from typing import Any

import jax
import numpy as np

from jaxbox import io
from jaxbox.cluster.reports import PartitionReport
from jaxbox.cluster.sources import SweepRef
from jaxbox.cluster.worker import MAX_DEATHS, Attempt, Partition, PartitionWorker, Task
from jaxbox.io.parquet import PARQUET_COLUMNS
from jaxbox.run.batching import detect_batch
from jaxbox.run.processes import ahead
from jaxbox.types import Detections, PointCloud

_READERS = 4
"""Threads that read: fetching waits for the network, and readers let go of Python's lock."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectTask(Task):
    """What is the same for all partitions of sweeps."""

    batch: int
    """Sweeps that are read ahead and detected together."""


@dataclasses.dataclass(frozen=True)
class _Read:
    """A sweep that is ready to be detected, or why it is not."""

    ref: SweepRef
    cloud: PointCloud | None = None
    timestamp_ns: int | None = None
    num_bytes: int = 0
    error: str = ""


class DetectWorker(PartitionWorker[DetectTask, PartitionReport]):
    """Detects in the sweeps of partitions.

    The first attempt at a partition goes in batches. Once a worker has died, the next goes sweep by sweep.
    """

    columns = PARQUET_COLUMNS

    def __init__(self, task: DetectTask) -> None:
        """Prepares JAX, which must not have started in this process."""
        super().__init__(task)
        self._threads = concurrent.futures.ThreadPoolExecutor(_READERS)
        self._compiled: set[int] = set()

    @classmethod
    def report_type(cls) -> type[PartitionReport]:
        """The kind of its reports."""
        return PartitionReport

    def _records(
        self, partition: Partition, attempt: Attempt, report: PartitionReport
    ) -> Iterator[Mapping[str, Any]]:
        for read, detections in self._detections(partition.refs, attempt, report):
            report.num_bytes += read.num_bytes
            if detections is None:
                report.add_failure(read.ref.name, read.ref.url, read.error)
                continue
            report.status[read.ref.name] = int(detections.status)
            yield io.detections_record(
                read.ref.name,
                detections,
                min_score=self._task.min_score,
                timestamp_ns=read.timestamp_ns,
            )

    def _detections(
        self, refs: Sequence[SweepRef], attempt: Attempt, report: PartitionReport
    ) -> Iterator[tuple[_Read, Detections | None]]:
        """Each sweep in order; the next batch is read while one is computed."""
        size, lead = (1, 0) if attempt.one_by_one else (self._task.batch, 1)
        batches = [refs[first : first + size] for first in range(0, len(refs), size)]
        for _, reading in ahead(batches, lambda batch: self._begin(batch, attempt), lead):
            reads = [future.result() for future in reading]
            clouds = [read.cloud for read in reads if read.cloud is not None]
            report.compile_s += sum(self._compile(cloud.capacity) for cloud in clouds)
            start = time.perf_counter()
            # One sweep's arrays come to the host while a CPU still computes the next.
            found = iter(detect_batch(clouds, self._task.config))
            for read in reads:
                detections = None if read.cloud is None else next(found).on_host()
                report.detect_s += time.perf_counter() - start
                yield read, detections
                start = time.perf_counter()

    def _begin(self, refs: Sequence[SweepRef], attempt: Attempt) -> list[Future[_Read]]:
        if attempt.one_by_one:
            attempt.begin(refs[0].name)
        return [self._threads.submit(self._read, ref, attempt.gives_up(ref.name)) for ref in refs]

    def _read(self, ref: SweepRef, is_given_up: bool) -> _Read:
        if is_given_up:
            return _Read(ref, error=f"its worker died {MAX_DEATHS} times, with this sweep alone")
        try:
            read = self._reader.read(ref)
            cloud = PointCloud.from_numpy(*read.points, capacity=self._task.capacity)
        except (io.InputError, OSError) as error:
            return _Read(ref, error=str(error))
        except Exception as error:
            # Whatever a reader may raise concerns its own sweep alone.
            return _Read(ref, error=f"{type(error).__name__}: {error}")
        return _Read(ref, cloud, read.timestamp_ns, read.num_bytes)

    def _compile(self, capacity: int) -> float:
        """Seconds until the detector of a capacity is there; 0 where it is already."""
        if capacity in self._compiled:
            return 0.0
        start = time.perf_counter()
        empty = PointCloud.from_numpy(np.zeros((0, 3), np.float32), capacity=capacity)
        # For each device that batches go to.
        jax.block_until_ready(detect_batch([empty] * jax.local_device_count(), self._task.config))
        self._compiled.add(capacity)
        return time.perf_counter() - start
