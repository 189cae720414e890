"""A video of pictures, written whole or not at all."""

import contextlib
import os
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from jaxbox._files import atomic_path

CODEC = "mp4v"
"""MPEG-4, which OpenCV writes without further libraries."""


@contextlib.contextmanager
def open_video(path: str | os.PathLike[str], *, rate_hz: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Opens a video that takes its name when it is whole; one without pictures is not written.

    Args:
      path: the file, ``.mp4``; its folder is made where it is missing.
      rate_hz: pictures a second.

    Yields:
      What adds a picture: (h, w, 3) uint8, red green blue. The first one's size is the video's; others are
      cut or filled with black at their right and lower edge.

    Raises:
      OSError: where the video cannot be written.
    """
    writer: cv2.VideoWriter | None = None
    with contextlib.ExitStack() as stack:

        def write(picture: np.ndarray) -> None:
            nonlocal writer, size
            if writer is None:
                # The codec takes blocks of two pixels.
                size = (picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2)
                temporary = stack.enter_context(atomic_path(path))
                writer = cv2.VideoWriter(
                    str(temporary), cv2.VideoWriter.fourcc(*CODEC), rate_hz, (size[1], size[0])
                )
                stack.callback(writer.release)
                if not writer.isOpened():
                    raise OSError(f"{path}: OpenCV cannot write a video there ({CODEC}).")
            writer.write(np.ascontiguousarray(_fit(picture, size)[..., ::-1]))

        size = (0, 0)
        yield write


def _fit(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture at another size, px: height, width."""
    if picture.shape[:2] == size:
        return picture
    fitted = np.zeros((*size, 3), np.uint8)
    height, width = min(size[0], picture.shape[0]), min(size[1], picture.shape[1])
    fitted[:height, :width] = picture[:height, :width]
    return fitted
