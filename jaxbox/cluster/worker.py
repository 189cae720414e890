"""What one worker of a cluster does: notes that a partition begins, and writes its file and report."""

import abc
import dataclasses
import json
import os
import pickle
import platform
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any, Generic, TypeVar

from jaxbox.cluster.reports import AnyReport
from jaxbox.cluster.sources import SweepReader, SweepRef
from jaxbox.cluster.store import Store
from jaxbox.config import DetectorConfig
from jaxbox.io.parquet import open_parquet
from jaxbox.io.results import SweepResult
from jaxbox.run.cache import CacheFolders
from jaxbox.run.processes import THREADS_VARIABLE
from jaxbox.run.versions import versions

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
"""A sweep or drive on which that many workers died, each with it alone, is given up."""
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
    num_threads: int
    """Of XLA in each worker."""
    cache_folders: CacheFolders
    """Where traced and compiled programs are kept."""
    versions: Mapping[str, str]
    """Of the driver."""

    @property
    def options(self) -> dict[str, Any]:
        """What the results depend on besides the detector's settings, as JSON can hold it."""
        return {"capacity": self.capacity, "min_score": self.min_score, "topic": self.topic}


class Attempt:
    """The memory of a partition's earlier attempts, in a small file next to it while it is at work.

    Before a sweep or drive begins alone it is noted, so that one that always kills its worker is known, and
    given up.
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
    def one_by_one(self) -> bool:
        """Whether to go sweep by sweep."""
        return self.num_before > 0

    def begin(self, name: str | None) -> None:
        """Notes the sweep or drive that comes next; None for several together."""
        counts = {"attempts": self.num_before + 1, "at": name, "deaths": self._deaths}
        note = {**counts, "node": platform.node(), "pid": os.getpid()}
        self._store.write_text(self._name, json.dumps(note))

    def gives_up(self, name: str) -> bool:
        """Whether a sweep or drive has ended too many workers."""
        return self._deaths.get(name, 0) >= MAX_DEATHS

    def end(self) -> None:
        """Forgets the attempts, as the partition is done."""
        self._store.remove(self._name)


def is_attempt(name: str) -> bool:
    """Whether a file of the output is the note of an attempt that has not ended."""
    return name.startswith(".") and name.endswith(_ATTEMPT)


AnyTask = TypeVar("AnyTask", bound=Task)


class PartitionWorker(abc.ABC, Generic[AnyTask, AnyReport]):
    """Takes partitions one after the other; Ray makes one in each of its processes."""

    columns: Mapping[str, str]
    """Of its files, as `open_parquet` takes them."""

    def __init__(self, task: AnyTask) -> None:
        """Prepares JAX, which must not have started in this process."""
        os.environ.setdefault(THREADS_VARIABLE, str(task.num_threads))
        task.cache_folders.apply()
        self._task, self._store = task, Store(task.output)
        self._reader = SweepReader(task.topic)

    def __call__(self, row: Mapping[str, bytes]) -> dict[str, str]:
        """Ray Data's form of `work`: a pickled partition in, its report as JSON out."""
        return {"report": self.work(pickle.loads(row["partition"])).to_json()}

    def work(self, partition: Partition) -> AnyReport:
        """Does what a partition asks for and writes its file.

        Args:
          partition: what to do.

        Returns:
          The report, with the error where there is no file.
        """
        report = self.report_type()(
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
            report = report.failed(f"{type(error).__name__}: {error}")
        return report

    def _check_versions(self) -> None:
        own = versions()
        differing = [name for name in _DECISIVE if own[name] != self._task.versions[name]]
        if differing:
            pairs = ", ".join(f"{name} {own[name]} for {self._task.versions[name]}" for name in differing)
            raise RuntimeError(f"the worker has {pairs}; install the driver's versions on every node.")

    def _write(self, partition: Partition, attempt: Attempt, report: AnyReport) -> None:
        start = time.perf_counter()
        metadata: dict[str, str] = {}
        with (
            self._store.writing(partition.file) as path,
            open_parquet(path, metadata=metadata, columns=self.columns) as write,
        ):
            for record in self._records(partition, attempt, report):
                report.num_boxes += len(record["boxes"])
                write(SweepResult(record=record))
            report.peak_mb = _peak_mb()
            report.seconds = time.perf_counter() - start - report.compile_s
            metadata[REPORT_KEY] = report.to_json()

    @classmethod
    @abc.abstractmethod
    def report_type(cls) -> type[AnyReport]:
        """The kind of its reports."""

    @abc.abstractmethod
    def _records(
        self, partition: Partition, attempt: Attempt, report: AnyReport
    ) -> Iterator[Mapping[str, Any]]:
        """What the file says of each sweep that went through, in order; the rest is put into the report."""


def _peak_mb() -> float:
    """Resident memory of this process at its most; 0 where the system does not say."""
    if resource is None:
        return 0.0
    # Linux counts in KiB.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
