"""Files in and out: points and recordings of every kind, data sets' layouts, labels, images, and results."""

from jaxbox._files import InputError, atomic_path, atomic_writer, remove_abandoned
from jaxbox.io.annotations import Annotation, read_annotations
from jaxbox.io.argoverse2 import (
    read_argoverse2_boxes,
    read_argoverse2_ground,
    read_argoverse2_points,
    read_feather,
)
from jaxbox.io.config import read_config, write_config
from jaxbox.io.convention import AXES, ORDINARY, PointConvention
from jaxbox.io.drives import find_drives, read_drives
from jaxbox.io.images import read_image
from jaxbox.io.jsonl import detections_record, read_jsonl, tracks_record, write_jsonl
from jaxbox.io.kitti import (
    VEHICLE_TYPES,
    KittiObject,
    boxes_from_objects,
    objects_from_boxes,
    objects_from_detections,
    read_label_folder,
    read_labels,
    write_labels,
)
from jaxbox.io.kitti_calibration import read_calibration, read_raw_calibration, write_calibration
from jaxbox.io.kitti_poses import read_oxts, read_raw_oxts
from jaxbox.io.kitti_tracking import (
    objects_by_frame,
    objects_from_tracks,
    read_track_detections,
    read_track_folder,
    read_tracks,
    write_tracks,
)
from jaxbox.io.labelled import LabelledBoxes
from jaxbox.io.las import read_las
from jaxbox.io.levelled import LevelSweeps, measure_sweeps
from jaxbox.io.npy import read_npy, read_npz
from jaxbox.io.nuscenes import read_nuscenes
from jaxbox.io.pandaset import read_pandaset_boxes, read_pandaset_points
from jaxbox.io.parquet_points import read_parquet_points
from jaxbox.io.pcd import read_pcd, write_pcd
from jaxbox.io.ply import read_ply
from jaxbox.io.points import TimedPoints, read_bin, write_bin
from jaxbox.io.pose_files import PoseFile, PoseFrame, read_pose_file
from jaxbox.io.poses import find_poses
from jaxbox.io.recordings import RecordedSweeps
from jaxbox.io.registry import POINT_SUFFIXES, read_points, read_timed_points
from jaxbox.io.semantic_kitti import read_semantic_labels
from jaxbox.io.sequences import group_sequences
from jaxbox.io.sweep import Sweep
from jaxbox.io.sweeps import RECORDING_SUFFIXES, open_sweeps
from jaxbox.io.text_points import read_text_points

__all__ = [
    "AXES",
    "ORDINARY",
    "POINT_SUFFIXES",
    "RECORDING_SUFFIXES",
    "VEHICLE_TYPES",
    "Annotation",
    "InputError",
    "KittiObject",
    "LabelledBoxes",
    "LevelSweeps",
    "PointConvention",
    "PoseFile",
    "PoseFrame",
    "RecordedSweeps",
    "Sweep",
    "TimedPoints",
    "atomic_path",
    "atomic_writer",
    "boxes_from_objects",
    "detections_record",
    "find_drives",
    "find_poses",
    "group_sequences",
    "measure_sweeps",
    "objects_by_frame",
    "objects_from_boxes",
    "objects_from_detections",
    "objects_from_tracks",
    "open_sweeps",
    "read_annotations",
    "read_argoverse2_boxes",
    "read_argoverse2_ground",
    "read_argoverse2_points",
    "read_bin",
    "read_calibration",
    "read_config",
    "read_drives",
    "read_feather",
    "read_image",
    "read_jsonl",
    "read_label_folder",
    "read_labels",
    "read_las",
    "read_npy",
    "read_npz",
    "read_nuscenes",
    "read_oxts",
    "read_pandaset_boxes",
    "read_pandaset_points",
    "read_parquet_points",
    "read_pcd",
    "read_ply",
    "read_points",
    "read_pose_file",
    "read_raw_calibration",
    "read_raw_oxts",
    "read_semantic_labels",
    "read_text_points",
    "read_timed_points",
    "read_track_detections",
    "read_track_folder",
    "read_tracks",
    "remove_abandoned",
    "tracks_record",
    "write_bin",
    "write_calibration",
    "write_config",
    "write_jsonl",
    "write_labels",
    "write_pcd",
    "write_tracks",
]
