"""A run over an archive: its driver, which lists sweeps, hands out partitions and writes the manifest."""

import concurrent.futures
import contextlib
import dataclasses
import hashlib
import importlib
import ipaddress
import json
import logging
import os
import pickle
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from typing import Any, Generic

from jaxbox import io
from jaxbox._extras import require
from jaxbox._interrupts import heard
from jaxbox.cluster.reports import AnyReport, DatasetReport
from jaxbox.cluster.sources import SweepRef, list_sweeps
from jaxbox.cluster.store import Store
from jaxbox.cluster.worker import REPORT_KEY, SUFFIX, Partition, PartitionWorker, Task, is_attempt
from jaxbox.config.fields import config_from_toml, config_to_toml, differing_names, recorded_options

MANIFEST = "manifest.json"
"""What became of each sweep of a run, next to its partitions."""
CONFIG = "config.toml"
"""The exact settings, next to its partitions."""
_NUM_READERS = 16
"""Threads that read the reports of an earlier run: each read waits for the file system."""
CLUSTERS_VARIABLE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Environment variable without which Ray takes the loopback address for its machine's, on any system."""
_STORE_BYTES = 2**28
"""Of Ray's memory for objects, where it is started here: partitions travel as paths, not as points."""

Groups = Iterable[tuple[str, Sequence[SweepRef]]]
"""Name and sweeps of each partition."""


class ClusterError(RuntimeError):
    """Ray could not go on; the partitions that are done stay, and the run can be resumed."""


def check_counts(**counts: int | None) -> None:
    """Refuses numbers below 1, by name; None is one that was not given.

    >>> check_counts(workers=None, batch=8)
    """
    for name, value in counts.items():
        if value is not None and value < 1:
            raise ValueError(f"{name} is {value}; it must be at least 1.")


def absolute(path: str | os.PathLike[str]) -> str:
    """A path that means the same to workers, whose working directory may be another; URLs as they are."""
    text = os.fspath(path)
    return text if "://" in text or "::" in text else os.path.abspath(text)


@contextlib.contextmanager
def joined_ray(address: str | None, workers: int | None, cpus_per_worker: int) -> Iterator[Any]:
    """Ray, joined or started; it is left as it was found.

    Args:
      address: as `jaxbox.cluster.detect_dataset`.
      workers: of the run; None for as many as there are cores.
      cpus_per_worker: cores of each.

    Yields:
      The module.

    Raises:
      ImportError: without the extra ``ray``.
      ClusterError: where it cannot be reached or started.
    """
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
        place = contextlib.nullcontext() if address else _on_loopback(ray)
        try:
            with warnings.catch_warnings(), place:
                # JAX warns of any fork; those of Ray replace the process immediately.
                warnings.filterwarnings("ignore", r"os\.fork\(\)", RuntimeWarning)
                ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
        except (RuntimeError, ConnectionError, ValueError) as error:
            raise ClusterError(f"Ray cannot be reached or started: {error}") from error
        if not address:
            _check_loopback(ray)
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


@contextlib.contextmanager
def _on_loopback(ray: Any) -> Iterator[None]:
    """Has a Ray that is started in the block listen on the loopback interface, as it does on a Mac.

    Its services ask nobody who is there: who reaches one runs code as this user. Their address depends on a
    constant of Ray's, which each of its processes reads from the environment.
    """
    constants: Any = importlib.import_module("ray._private.ray_constants")
    before = os.environ.get(CLUSTERS_VARIABLE), getattr(constants, "ENABLE_RAY_CLUSTER", None)
    os.environ[CLUSTERS_VARIABLE] = "0"
    constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        constants.ENABLE_RAY_CLUSTER = before[1]
        if before[0] is None:
            del os.environ[CLUSTERS_VARIABLE]
        else:
            os.environ[CLUSTERS_VARIABLE] = before[0]


def _check_loopback(ray: Any) -> None:
    """Ends and refuses a Ray that was started here and is at another address than the loopback one."""
    address = ray.util.get_node_ip_address()
    if not ipaddress.ip_address(address).is_loopback:
        ray.shutdown()
        raise ClusterError(
            f"Ray {ray.__version__} listens at {address}, where it can be reached from other machines, and "
            "asks nobody who is there; install another version, or start one by `ray start --head` in a "
            "network that you trust, and name it by --address auto."
        )


@dataclasses.dataclass
class Run(Generic[AnyReport]):
    """One call of `detect_dataset` or `track_dataset`."""

    task: Task
    """What is the same for all partitions."""
    worker: type[PartitionWorker[Any, AnyReport]]
    """What does them."""
    divide: Callable[[list[SweepRef]], Groups]
    """Divides all sweeps among partitions."""
    inputs: list[str]
    """Sources that were given."""
    ray: Any
    """The module, started."""
    cpus_per_worker: int = 1
    """Cores of each worker."""

    def __post_init__(self) -> None:
        self._store = Store(self.task.output)
        self._options = self.task.options

    def run(
        self,
        workers: int | None,
        resume: bool,
        on_report: Callable[[AnyReport, int], None] | None,
    ) -> DatasetReport[AnyReport]:
        """Does the partitions that are missing.

        Args:
          workers: processes; None for as many as there are cores.
          resume: whether partitions of an earlier run are kept.
          on_report: is told of each partition that is done, and of how many there are to do.

        Returns:
          What became of all partitions.

        Raises:
          InputError: for sources without sweeps, or an output that holds another run's partitions.
          ClusterError: where Ray cannot go on.
        """
        start = time.perf_counter()
        if workers is None:
            cores = self.ray.cluster_resources().get("CPU", 1)
            workers = max(1, int(cores) // self.cpus_per_worker)
        refs = list_sweeps(self.inputs, self.task.topic, self._in_parallel)
        partitions = plan(self.task, self.divide(refs))
        kept = self._finished_reports(partitions, resume)
        missing = [partition for partition in partitions if partition.name not in kept]
        # What takes longest begins first, so that the workers end together.
        missing.sort(key=lambda partition: -len(partition.refs))
        reports = dict(kept)
        num_done_before = sum(part.num_done for part in kept.values())
        report: DatasetReport[AnyReport] = DatasetReport(
            partitions=[], num_skipped=len(kept), num_done_before=num_done_before, workers=workers
        )
        self._store.make()
        self._store.remove_partials()
        self._forget_attempts()
        self._store.write_text(CONFIG, config_to_toml(self.task.config))
        self._write_manifest(report, finished=False)
        try:
            # Closed immediately on an early exit, so that Ray ends the workers.
            with contextlib.closing(self._results(missing, min(workers, max(1, len(missing))))) as results:
                for done in results:
                    reports[done.name] = done
                    if on_report is not None:
                        on_report(done, len(missing))
        except KeyboardInterrupt:
            heard()
            report.interrupted = True
        finally:
            report.partitions = [reports[p.name] for p in partitions if p.name in reports]
            report.elapsed_s = time.perf_counter() - start
            whole = len(report.partitions) == len(partitions) and not report.failures
            self._write_manifest(report, finished=whole)
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

    def _finished_reports(self, partitions: list[Partition], resume: bool) -> dict[str, AnyReport]:
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
                f"{self.task.output}: {strange[0]} belongs to a run over other sweeps or with other "
                "partitions; give another output."
            )
        self._check_resumable()
        candidates = [partition for partition in partitions if partition.file in there]
        with concurrent.futures.ThreadPoolExecutor(_NUM_READERS) as threads:
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

    def _earlier_report(self, partition: Partition) -> AnyReport | None:
        """The report within a partition's file; None where it has to be done (again)."""
        parquet: Any = require("pyarrow.parquet", extra="ray", what="partitions")
        arrow: Any = require("pyarrow", extra="ray", what="partitions")
        try:
            with self._store.reading(partition.file) as file:
                metadata = parquet.read_metadata(file).metadata or {}
            report = self.worker.report_type().from_json(metadata[REPORT_KEY.encode()])
        except (arrow.ArrowException, KeyError, ValueError):
            return None
        # A sweep that failed may have been fixed since; then all of its partition is done again.
        return report if report.key == partition.key and not report.failures else None

    def _results(self, partitions: list[Partition], workers: int) -> Generator[AnyReport, None, None]:
        """The reports as they come."""
        if not partitions:
            return
        data: Any = require("ray.data", extra="ray", what="clusters")
        rows = [{"partition": pickle.dumps(partition)} for partition in partitions]
        # One block a partition: a block is what Ray gives out, and gives out again when a worker dies.
        dataset = data.from_items(rows, override_num_blocks=len(rows)).map(
            self.worker,
            fn_constructor_args=(self.task,),
            compute=data.ActorPoolStrategy(size=workers, max_tasks_in_flight_per_actor=1),
            num_cpus=self.cpus_per_worker,
        )
        try:
            for row in dataset.iter_rows():
                yield self.worker.report_type().from_json(row["report"])
        except self.ray.exceptions.RayError as error:
            raise ClusterError(f"Ray could not go on: {error}") from error

    def _write_manifest(self, report: DatasetReport[AnyReport], *, finished: bool) -> None:
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


def plan(task: Task, groups: Groups) -> list[Partition]:
    """The partitions of a run, each with the digest of all that decides its content.

    Args:
      task: what they have in common.
      groups: their names and sweeps.

    Returns:
      The partitions, in the order of the groups.
    """
    decisive = [config_to_toml(task.config), task.options]
    return [Partition(name=name, key=_digest([*decisive, refs]), refs=tuple(refs)) for name, refs in groups]


def _digest(value: Any) -> str:
    """A name for what something says."""
    text = json.dumps(value, default=dataclasses.asdict, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
