"""What one worker of a cluster does: reads the sweeps of a partition, detects, and writes its file."""

import concurrent.futures
import dataclasses
import json
import os
import pickle
import platform
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from typing import Any

import jax
import numpy as np

from jaxbox import io
from jaxbox.cluster.reports import PartitionReport
from jaxbox.cluster.sources import SweepReader, SweepRef
from jaxbox.cluster.store import Store
from jaxbox.config import DetectorConfig
from jaxbox.io.parquet import open_parquet
from jaxbox.io.results import SweepResult
from jaxbox.run.batching import detect_batch
from jaxbox.run.cache import CacheFolders
from jaxbox.run.processes import THREADS_VARIABLE, ahead
from jaxbox.run.versions import versions
from jaxbox.types import Detections, PointCloud

if sys.platform == "win32":
    resource = None
else:
    import resource

SUFFIX = ".parquet"
"""Of the partitions' files."""
REPORT_KEY = "jaxbox.partition"
"""Key of a partition's metadata that holds its report."""
_ATTEMPT = ".attempt.json"
MAX_DEATHS = 2
"""A sweep on which that many workers died, each with that sweep alone, is given up."""
_READERS = 4
"""Threads that read: fetching waits for the network, and readers let go of Python's lock."""
_DECISIVE = ("jaxbox", "jax", "jaxlib")
"""Packages whose versions decide the bits of the answer."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Partition:
    """The sweeps of one file."""

    name: str
    """Of the file, without the suffix."""
    key: str
    """Digest of everything that decides its content."""
    refs: tuple[SweepRef, ...]
    """Its sweeps, in order."""

    @property
    def file(self) -> str:
        """Its name within the output."""
        return self.name + SUFFIX


@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """What is the same for all partitions."""

    output: str
    """Folder of the results, local or a URL."""
    config: DetectorConfig
    """The detector's settings."""
    capacity: int | None
    """Points a sweep is padded to, or None for what it needs."""
    min_score: float
    """Boxes with lower scores are dropped."""
    topic: str | None
    """Of the points in recordings."""
    batch: int
    """Sweeps that are read ahead and detected together."""
    num_threads: int
    """Of XLA in each worker."""
    cache_folders: CacheFolders
    """Where traced and compiled programs are kept."""
    versions: Mapping[str, str]
    """Of the driver."""


class Attempt:
    """The memory of a partition's earlier attempts, in a small file next to it while it is at work.

    The first attempt goes in batches. Once a worker has died, the next goes sweep by sweep and notes each
    before it begins, so that one that always kills its worker is known, and given up.
    """

    def __init__(self, store: Store, partition: str) -> None:
        """Looks for an earlier attempt that did not end, and notes this one."""
        self._store, self._name = store, f".{partition}{_ATTEMPT}"
        text = store.read_text(self._name)
        earlier: dict[str, Any] = json.loads(text) if text else {"attempts": 0, "at": None, "deaths": {}}
        self.num_before: int = earlier["attempts"]
        """Attempts that did not end."""
        self._deaths: dict[str, int] = earlier["deaths"]
        if earlier["at"] is not None:
            self._deaths[earlier["at"]] = self._deaths.get(earlier["at"], 0) + 1
        self.begin(None)

    @property
    def careful(self) -> bool:
        """Whether to go sweep by sweep."""
        return self.num_before > 0

    def begin(self, sweep: str | None) -> None:
        """Notes the sweep that comes next."""
        counts = {"attempts": self.num_before + 1, "at": sweep, "deaths": self._deaths}
        note = {**counts, "node": platform.node(), "pid": os.getpid()}
        self._store.write_text(self._name, json.dumps(note))

    def gives_up(self, sweep: str) -> bool:
        """Whether a sweep has ended too many workers."""
        return self._deaths.get(sweep, 0) >= MAX_DEATHS

    def end(self) -> None:
        """Forgets the attempts, as the partition is done."""
        self._store.remove(self._name)


def is_attempt(name: str) -> bool:
    """Whether a file of the output is the note of an attempt that has not ended."""
    return name.startswith(".") and name.endswith(_ATTEMPT)


@dataclasses.dataclass(frozen=True)
class _Read:
    """A sweep that is ready to be detected, or why it is not."""

    ref: SweepRef
    cloud: PointCloud | None = None
    timestamp_ns: int | None = None
    num_bytes: int = 0
    error: str = ""


class PartitionWorker:
    """Takes partitions one after the other; Ray makes one in each of its processes."""

    def __init__(self, task: Task) -> None:
        """Prepares JAX, which must not have started in this process."""
        os.environ.setdefault(THREADS_VARIABLE, str(task.num_threads))
        task.cache_folders.apply()
        self._task, self._store = task, Store(task.output)
        self._reader = SweepReader(task.topic)
        self._threads = concurrent.futures.ThreadPoolExecutor(_READERS)
        self._compiled: set[int] = set()

    def __call__(self, row: Mapping[str, bytes]) -> dict[str, str]:
        """Ray Data's form of `work`: a pickled partition in, its report as JSON out."""
        return {"report": self.work(pickle.loads(row["partition"])).to_json()}

    def work(self, partition: Partition) -> PartitionReport:
        """Detects in the sweeps of a partition and writes its file.

        Args:
          partition: what to do.

        Returns:
          The report, with the error where there is no file.
        """
        report = PartitionReport(
            name=partition.name,
            key=partition.key,
            num_sweeps=len(partition.refs),
            worker=f"{platform.node()}:{os.getpid()}",
        )
        try:
            self._check_versions()
            attempt = Attempt(self._store, partition.name)
            report.num_deaths = attempt.num_before
            self._write(partition, attempt, report)
            attempt.end()
        except Exception as error:
            # The other partitions do not depend on this one; the run's report names it.
            report = dataclasses.replace(report, status={}, error=f"{type(error).__name__}: {error}")
        return report

    def _check_versions(self) -> None:
        own = versions()
        differing = [name for name in _DECISIVE if own[name] != self._task.versions[name]]
        if differing:
            pairs = ", ".join(f"{name} {own[name]} for {self._task.versions[name]}" for name in differing)
            raise RuntimeError(f"the worker has {pairs}; install the driver's versions on every node.")

    def _write(self, partition: Partition, attempt: Attempt, report: PartitionReport) -> None:
        start = time.perf_counter()
        metadata: dict[str, str] = {}
        with (
            self._store.writing(partition.file) as path,
            open_parquet(path, metadata=metadata) as write,
        ):
            for read, detections in self._detections(partition.refs, attempt, report):
                report.num_bytes += read.num_bytes
                if detections is None:
                    failure = {"sweep": read.ref.name, "url": read.ref.url, "reason": read.error}
                    report.failures.append(failure)
                    continue
                record = io.detections_record(
                    read.ref.name,
                    detections,
                    min_score=self._task.min_score,
                    timestamp_ns=read.timestamp_ns,
                )
                report.status[read.ref.name] = int(detections.status)
                report.num_boxes += len(record["boxes"])
                write(SweepResult(record=record))
            report.peak_mb = _peak_mb()
            report.seconds = time.perf_counter() - start - report.compile_s
            metadata[REPORT_KEY] = report.to_json()

    def _detections(
        self, refs: Sequence[SweepRef], attempt: Attempt, report: PartitionReport
    ) -> Iterator[tuple[_Read, Detections | None]]:
        """Each sweep in order; the next batch is read while one is computed."""
        size, lead = (1, 0) if attempt.careful else (self._task.batch, 1)
        batches = [refs[first : first + size] for first in range(0, len(refs), size)]
        for _, reading in ahead(batches, lambda batch: self._begin(batch, attempt), lead):
            reads = [future.result() for future in reading]
            clouds = [read.cloud for read in reads if read.cloud is not None]
            report.compile_s += sum(self._compile(cloud.capacity) for cloud in clouds)
            start = time.perf_counter()
            # One sweep's arrays come to the host while the next are still computed.
            found = iter(detect_batch(clouds, self._task.config))
            for read in reads:
                detections = None if read.cloud is None else next(found).on_host()
                report.detect_s += time.perf_counter() - start
                yield read, detections
                start = time.perf_counter()

    def _begin(self, refs: Sequence[SweepRef], attempt: Attempt) -> list[Future[_Read]]:
        if attempt.careful:
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
        jax.block_until_ready(detect_batch([empty], self._task.config))
        self._compiled.add(capacity)
        return time.perf_counter() - start


def _peak_mb() -> float:
    """Resident memory of this process at its most; 0 where the system does not say."""
    if resource is None:
        return 0.0
    # Linux counts in KiB.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
