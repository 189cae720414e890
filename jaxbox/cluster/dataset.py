"""detect_dataset(): all sweeps of an archive to boxes, on the workers of a Ray cluster."""

import functools
import os
from collections.abc import Callable, Iterator, Sequence

import jax

from jaxbox.cluster.detect_worker import DetectTask, DetectWorker
from jaxbox.cluster.reports import DatasetReport, PartitionReport
from jaxbox.cluster.run import Run, absolute, check_counts, joined_ray
from jaxbox.cluster.sources import SweepRef, listed
from jaxbox.config import DetectorConfig
from jaxbox.config.checks import check_config
from jaxbox.run.arguments import as_config
from jaxbox.run.cache import CacheFolders
from jaxbox.run.versions import versions

SWEEPS_PER_PARTITION = 256
"""About 10 s of work, which is what is lost when a worker dies, in files that are not too small."""


def detect_dataset(
    sources: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    config: DetectorConfig | str | None = None,
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
) -> DatasetReport[PartitionReport]:
    """Detects in all sweeps of an archive, on the workers of a Ray cluster.

    The sweeps are cut into partitions in their order. Each is one Parquet file, ``part-000000.parquet``,
    with the columns of `jaxbox.io.parquet` and the boxes of `jaxbox.detect`, bit for bit. A partition's
    file is there whole or not at all, so that whoever dies costs time and nothing else: Ray starts a
    dead worker again and hands its partition out again. ``manifest.json`` tells what became of every sweep.

    Args:
      sources: local paths as `jaxbox.io.open_sweeps` takes them (on a cluster, on a disk that all nodes
        have), and URLs that fsspec knows, of point files, or of folders or patterns of them.
      output: a folder, local or a URL.
      config: the settings of all, or the name of a preset; None for the default preset.
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
    check_counts(
        cpus_per_worker=cpus_per_worker,
        sweeps_per_partition=sweeps_per_partition,
        workers=workers,
        batch=batch,
    )
    config = as_config(config)
    check_config(config)
    task = DetectTask(
        output=absolute(output),
        config=jax.tree.map(float, config),
        capacity=capacity,
        min_score=min_score,
        topic=topic,
        batch=batch,
        num_threads=cpus_per_worker,
        cache_folders=CacheFolders.of_this_process(),
        versions=versions(formats=True),
    )
    divide = functools.partial(partition_sweeps, size=sweeps_per_partition)
    with joined_ray(address, workers, cpus_per_worker) as ray:
        run = Run(task, DetectWorker, divide, listed(sources), ray, cpus_per_worker)
        return run.run(workers, resume, on_report)


def partition_sweeps(refs: Sequence[SweepRef], size: int) -> Iterator[tuple[str, Sequence[SweepRef]]]:
    """Cuts sweeps into partitions.

    Args:
      refs: all of them, in order.
      size: sweeps of each partition but the last.

    Yields:
      Name and sweeps.

    >>> [name for name, _ in partition_sweeps([SweepRef("a", "a.bin")] * 3, 2)]
    ['part-000000', 'part-000001']
    """
    for number, first in enumerate(range(0, len(refs), size)):
        yield f"part-{number:06d}", refs[first : first + size]
