"""A whole archive on a Ray cluster: sweeps of any file system in, partitioned Parquet out."""

from jaxbox.cluster.dataset import detect_dataset
from jaxbox.cluster.drives import track_dataset
from jaxbox.cluster.reports import DatasetReport, DriveReport, PartitionReport
from jaxbox.cluster.run import ClusterError

__all__ = [
    "ClusterError",
    "DatasetReport",
    "DriveReport",
    "PartitionReport",
    "detect_dataset",
    "track_dataset",
]
