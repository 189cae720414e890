"""Files in and out: KITTI's formats and folder layouts, plain points, JSON Lines."""

from jaxbox.io._files import InputError
from jaxbox.io.kitti import KittiObject, read_label_folder, read_labels, write_labels

__all__ = ["InputError", "KittiObject", "read_label_folder", "read_labels", "write_labels"]
