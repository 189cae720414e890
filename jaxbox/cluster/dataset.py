"""detect_dataset(): the driver, which lists sweeps, hands out partitions and keeps the account."""

import concurrent.futures
import contextlib
import dataclasses
import hashlib
import json
import logging
import os
import pickle
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

import jax

from jaxbox import io
from jaxbox._extras import require
from jaxbox.cluster.reports import DatasetReport, PartitionReport
from jaxbox.cluster.sources import SweepRef, list_sweeps
from jaxbox.cluster.store import Store
from jaxbox.cluster.worker import REPORT_KEY, SUFFIX, Partition, PartitionWorker, Task, is_attempt
from jaxbox.config import DetectorConfig
from jaxbox.config.checks import check_config
from jaxbox.config.fields import config_from_toml, config_to_toml, differing_names, recorded_options
from jaxbox.run.cache import CacheFolders
from jaxbox.run.versions import versions

MANIFEST = "manifest.json"
"""The account of a run, next to its partitions."""
CONFIG = "config.toml"
"""The exact settings, next to its partitions."""
SWEEPS_PER_PARTITION = 256
"""About 10 s of work, which is what is lost when a worker dies, in files that are not too small."""
_LOOKERS = 16
"""Threads that look at the partitions of an earlier run: each look waits for the file system."""
_STORE_BYTES = 2**28
"""Of Ray's memory for objects, where it is started here: partitions travel as paths, not as points."""


class ClusterError(RuntimeError):
    """Ray could not go on; the partitions that are done stay, and the run can be resumed."""


def detect_dataset(
    sources: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    config: DetectorConfig | None = None,
    *,
    address: str | None = None,
    workers: int | None = None,
    cpus_per_worker: int = 1,
    sweeps_per_partition: int = SWEEPS_PER_PARTITION,
    batch: int = 8,
    capacity: int | None = None,
    min_score: float = 0.0,
    topic: str | None = None,
    resume: bool = False,
    on_report: Callable[[PartitionReport, int], None] | None = None,
) -> DatasetReport:
    """Detects in all sweeps of an archive, on the workers of a Ray cluster.

    The sweeps are cut into partitions in their order. Each is one Parquet file, ``part-000000.parquet``,
    with the columns of `jaxbox.io.parquet` and the boxes of `jaxbox.detect`, bit for bit. A partition's
    file is there whole or not at all, so that whoever dies costs time and nothing else: Ray starts a
    dead worker again and hands its partition out again. ``manifest.json`` tells what became of every sweep.

    Args:
      sources: local paths as `jaxbox.io.open_sweeps` takes them (on a cluster, on a disk that all nodes
        have), and URLs that fsspec knows, of point files, or of folders or patterns of them.
      output: a folder, local or a URL.
      config: the settings of all; None for the default preset.
      address: of a running cluster, as `ray.init` takes it; None to use the one that this process has
        joined already, or else to start one on this machine, and to end it again.
      workers: processes that detect; None for as many as there are cores.
      cpus_per_worker: cores of each; one is what pays.
      sweeps_per_partition: what a worker that dies costs at most, and how large the files are.
      batch: sweeps that a worker reads ahead and hands to `jaxbox.detect_batch`.
      capacity: points that every sweep is padded to; None for the bucket that holds it.
      min_score: boxes with lower scores are dropped.
      topic: of the points in recordings of several.
      resume: whether partitions of an earlier run that are complete and without failures are kept.
      on_report: told of each partition when it is done, and of how many there are to do.

    Returns:
      What became of every partition. Sweeps that failed are in it by name, with the reason.

    Raises:
      InputError: for sources without sweeps, or an output that holds another run's partitions.
      ValueError: for settings that contradict each other, or a number below 1.
      ImportError: without the extra ``ray``.
      ClusterError: where Ray cannot be reached, or cannot go on.
    """
    numbers = {"cpus_per_worker": cpus_per_worker, "sweeps_per_partition": sweeps_per_partition}
    for name, value in {**numbers, "workers": 1 if workers is None else workers, "batch": batch}.items():
        if value < 1:
            raise ValueError(f"{name} is {value}; it must be at least 1.")
    config = DetectorConfig() if config is None else config
    check_config(config)
    task = Task(
        output=_absolute(os.fspath(output)),
        config=jax.tree.map(float, config),
        capacity=capacity,
        min_score=min_score,
        topic=topic,
        batch=batch,
        num_threads=cpus_per_worker,
        cache_folders=CacheFolders.of_this_process(),
        versions=versions(formats=True),
    )
    given = [sources] if isinstance(sources, str | os.PathLike) else list(sources)
    with _ray(address, workers, cpus_per_worker) as ray:
        run = _Run(task, [os.fspath(source) for source in given], ray, cpus_per_worker)
        return run.run(workers, sweeps_per_partition, resume, on_report)


def _absolute(output: str) -> str:
    """A path that means the same to workers, whose working directory may be another."""
    return output if "://" in output or "::" in output else os.path.abspath(output)


@contextlib.contextmanager
def _ray(address: str | None, workers: int | None, cpus_per_worker: int) -> Iterator[Any]:
    """Ray, joined or started; it is left as it was found."""
    # It must not tell anybody of its use, nor need a network to start.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray: Any = require("ray", extra="ray", what="clusters")
    data: Any = require("ray.data", extra="ray", what="clusters")
    if ray.is_initialized() and address is None:
        joined = False
    else:
        started_here = {"include_dashboard": False, "object_store_memory": _STORE_BYTES}
        started_here["num_cpus"] = None if workers is None else workers * cpus_per_worker
        joined = True
        # "local" starts one here, whatever address the environment names.
        options = {"address": address} if address else {"address": "local", **started_here}
        try:
            with warnings.catch_warnings():
                # JAX warns of any fork; those of Ray replace the process immediately.
                warnings.filterwarnings("ignore", r"os\.fork\(\)", RuntimeWarning)
                ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
        except (RuntimeError, ConnectionError, ValueError) as error:
            raise ClusterError(f"Ray cannot be reached or started: {error}") from error
    context = data.DataContext.get_current()
    shown, context.enable_progress_bars = context.enable_progress_bars, False
    logger = logging.getLogger("ray.data")
    level, _ = logger.level, logger.setLevel(logging.ERROR)
    try:
        yield ray
    finally:
        context.enable_progress_bars = shown
        logger.setLevel(level)
        if joined:
            ray.shutdown()


@dataclasses.dataclass
class _Run:
    """One call of `detect_dataset`."""

    task: Task
    inputs: list[str]
    ray: Any
    cpus_per_worker: int

    def __post_init__(self) -> None:
        self._store = Store(self.task.output)
        self._options = {
            "capacity": self.task.capacity,
            "min_score": self.task.min_score,
            "topic": self.task.topic,
        }

    def run(
        self,
        workers: int | None,
        sweeps_per_partition: int,
        resume: bool,
        on_report: Callable[[PartitionReport, int], None] | None,
    ) -> DatasetReport:
        start = time.perf_counter()
        if workers is None:
            cores = self.ray.cluster_resources().get("CPU", 1)
            workers = max(1, int(cores) // self.cpus_per_worker)
        refs = list_sweeps(self.inputs, self.task.topic, self._in_parallel)
        partitions = self._plan(refs, sweeps_per_partition)
        kept = self._look(partitions, resume)
        missing = [partition for partition in partitions if partition.name not in kept]
        reports = dict(kept)
        num_done_before = sum(part.num_done for part in kept.values())
        report = DatasetReport(
            partitions=[], num_skipped=len(kept), num_done_before=num_done_before, workers=workers
        )
        self._store.make()
        self._store.remove_partials()
        self._forget_attempts()
        self._store.write_text(CONFIG, config_to_toml(self.task.config))
        self._account(report, finished=False)
        try:
            # Closed immediately on an early exit, so that Ray ends the workers.
            with contextlib.closing(self._results(missing, min(workers, max(1, len(missing))))) as results:
                for done in results:
                    reports[done.name] = done
                    if on_report is not None:
                        on_report(done, len(missing))
        except KeyboardInterrupt:
            report.interrupted = True
        finally:
            report.partitions = [reports[p.name] for p in partitions if p.name in reports]
            report.elapsed_s = time.perf_counter() - start
            whole = len(report.partitions) == len(partitions) and not report.failures
            self._account(report, finished=whole)
        return report

    def _forget_attempts(self) -> None:
        """Removes the notes of an earlier run: workers that ended with it did not die of a sweep."""
        for name in self._store.names():
            if is_attempt(name):
                self._store.remove(name)

    def _in_parallel(self, function: Callable[[Any], Any], arguments: Sequence[Any]) -> Sequence[Any]:
        """The tasks of listing."""
        if len(arguments) <= 1:
            return [function(argument) for argument in arguments]
        remote = self.ray.remote(num_cpus=1)(function)
        try:
            return self.ray.get([remote.remote(argument) for argument in arguments])
        except self.ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, io.InputError | OSError) else error from error

    def _plan(self, refs: list[SweepRef], size: int) -> list[Partition]:
        decisive = [config_to_toml(self.task.config), self._options]
        groups = [tuple(refs[first : first + size]) for first in range(0, len(refs), size)]
        return [
            Partition(name=f"part-{number:06d}", key=_digest([*decisive, group]), refs=group)
            for number, group in enumerate(groups)
        ]

    def _look(self, partitions: list[Partition], resume: bool) -> dict[str, PartitionReport]:
        """Reports of the partitions that need not be done again."""
        there = {name for name in self._store.names() if name.endswith(SUFFIX)}
        if not there:
            return {}
        if not resume:
            raise io.InputError(
                f"{self.task.output}: there are {len(there)} partitions of an earlier run; go on with "
                "--resume (resume=True), or give another output."
            )
        if strange := sorted(there - {partition.file for partition in partitions}):
            raise io.InputError(
                f"{self.task.output}: {strange[0]} belongs to a run over other sweeps or of another "
                "partition size; give another output."
            )
        self._check_resumable()
        candidates = [partition for partition in partitions if partition.file in there]
        with concurrent.futures.ThreadPoolExecutor(_LOOKERS) as threads:
            found = threads.map(self._earlier_report, candidates)
            return {report.name: report for report in found if report is not None}

    def _check_resumable(self) -> None:
        text = self._store.read_text(CONFIG)
        if text is None:
            return
        try:
            earlier = config_from_toml(text, base=self.task.config)
        except ValueError as error:
            raise io.InputError(f"{self.task.output}/{CONFIG}: {error}; give another output.") from error
        recorded = self._options
        # Without a manifest each partition still says for itself whether it was made with these options.
        with contextlib.suppress(ValueError):
            recorded = recorded_options(self._store.read_text(MANIFEST) or "")
        differing = differing_names(self.task.config, self._options, earlier=earlier, recorded=recorded)
        if differing:
            raise io.InputError(
                f"{self.task.output}: an earlier run had other settings: {', '.join(differing)} differ. Give "
                f"its {CONFIG} and the options in {MANIFEST}, or another output."
            )

    def _earlier_report(self, partition: Partition) -> PartitionReport | None:
        """The report within a partition's file; None where it has to be done (again)."""
        parquet: Any = require("pyarrow.parquet", extra="ray", what="partitions")
        arrow: Any = require("pyarrow", extra="ray", what="partitions")
        try:
            with self._store.reading(partition.file) as file:
                metadata = parquet.read_metadata(file).metadata or {}
            report = PartitionReport.from_json(metadata[REPORT_KEY.encode()])
        except (arrow.ArrowException, KeyError, ValueError):
            return None
        # A sweep that failed may have been fixed since; then all of its partition is done again.
        return report if report.key == partition.key and not report.failures else None

    def _results(self, partitions: list[Partition], workers: int) -> Generator[PartitionReport, None, None]:
        """The reports as they come."""
        if not partitions:
            return
        data: Any = require("ray.data", extra="ray", what="clusters")
        rows = [{"partition": pickle.dumps(partition)} for partition in partitions]
        # One block a partition: a block is what Ray gives out, and gives out again when a worker dies.
        dataset = data.from_items(rows, override_num_blocks=len(rows)).map(
            PartitionWorker,
            fn_constructor_args=(self.task,),
            compute=data.ActorPoolStrategy(size=workers, max_tasks_in_flight_per_actor=1),
            num_cpus=self.cpus_per_worker,
        )
        try:
            for row in dataset.iter_rows():
                yield PartitionReport.from_json(row["report"])
        except self.ray.exceptions.RayError as error:
            raise ClusterError(f"Ray could not go on: {error}") from error

    def _account(self, report: DatasetReport, *, finished: bool) -> None:
        """Writes the manifest."""
        account = {
            "finished": finished,
            **report.summary(),
            "versions": self.task.versions,
            "inputs": self.inputs,
            "options": self._options,
            "config": config_to_toml(self.task.config),
            "failures": report.failures,
            "deaths": report.deaths,
            "partitions": [dataclasses.asdict(part) for part in report.partitions],
        }
        self._store.write_text(MANIFEST, json.dumps(account, indent=1, allow_nan=False) + "\n")


def _digest(value: Any) -> str:
    """A name for what something says."""
    text = json.dumps(value, default=dataclasses.asdict, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
