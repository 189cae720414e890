"""Camera images."""

import os
import struct

import cv2
import numpy as np

from jaxbox._files import InputError, read_bytes

MAX_PIXELS = 2**26
"""Ten times those of the finest cameras; OpenCV asks for the memory of what a file claims."""

_PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_JPEG = b"\xff\xd8"
_MARKER = 0xFF
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that begin with a size."""


def read_image(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads a camera image.

    Args:
      path: a PNG or JPEG file.

    Returns:
      (height, width, 3) uint8, RGB.

    Raises:
      InputError: where it is missing, cannot be decoded, or claims more than `MAX_PIXELS`.
    """
    data = read_bytes(path)
    _checked_size(data, path)
    # As it is stored, which is what the calibration is of, whatever turn the file proposes to viewers.
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    # OpenCV answers None to what it cannot decode.
    if image is None:
        raise _unreadable(path)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Reads how large a camera image is, without decoding it.

    Args:
      path: a PNG or JPEG file.

    Returns:
      Width and height, px, those of `read_image`.

    Raises:
      InputError: where it is missing, its head is of neither format, or it claims more than `MAX_PIXELS`.
    """
    return _checked_size(read_bytes(path), path)


def _checked_size(data: bytes, path: str | os.PathLike[str]) -> tuple[int, int]:
    width, height = _claimed_size(data)
    if width * height > MAX_PIXELS:
        raise InputError(f"{path}: it claims {width} x {height} pixels; at most {MAX_PIXELS} are read.")
    if not width * height:
        raise _unreadable(path)
    return width, height


def _unreadable(path: str | os.PathLike[str]) -> InputError:
    return InputError(f"{path}: not a readable image; copy it again, or remove it to go on without.")


def _claimed_size(data: bytes) -> tuple[int, int]:
    """Width and height, px, by the file's head; zeros where it is neither PNG nor JPEG."""
    if data.startswith(_PNG) and len(data) >= len(_PNG) + 8:
        width, height = struct.unpack_from(">II", data, len(_PNG))
        return width, height
    place = len(_JPEG)
    while data.startswith(_JPEG) and place + 9 <= len(data) and data[place] == _MARKER:
        marker, length, height, width = struct.unpack_from(">xBHxHH", data, place)
        if marker == _MARKER:  # a filler
            place += 1
            continue
        if marker in _JPEG_FRAMES:
            return width, height
        place += 2 + length
    return 0, 0
