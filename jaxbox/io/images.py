"""Camera images."""

import os

import cv2
import numpy as np

from jaxbox.io._files import InputError, read_bytes


def read_image(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads a camera image.

    Args:
      path: a PNG, JPEG or other file that OpenCV decodes.

    Returns:
      (height, width, 3) uint8, RGB.

    Raises:
      InputError: where it is missing or cannot be decoded.
    """
    data = np.frombuffer(read_bytes(path), np.uint8)
    # OpenCV raises on an empty buffer and answers None to one it cannot decode.
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise InputError(f"{path}: not a readable image; copy it again, or remove it to go on without.")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
