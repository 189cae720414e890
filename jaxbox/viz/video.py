"""Videos and animated GIFs of pictures, written whole or not at all."""

import contextlib
import importlib.util
import os
import pathlib
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from jaxbox._extras import require
from jaxbox._files import atomic_path

CODEC = "mp4v"
"""MPEG-4, which OpenCV writes without further libraries, and browsers do not play."""
GIF_COLORS = 64
"""Enough for boxes, trails and points; a photograph shows steps."""
_ENCODER = "imageio_ffmpeg"
_EXTRA = "video"
_MAX_REASON = 500

AddPicture = Callable[[np.ndarray], Any]
"""Adds a picture: (h, w, 3) uint8, red green blue."""


@contextlib.contextmanager
def open_video(path: str | os.PathLike[str], *, rate_hz: float) -> Iterator[AddPicture]:
    """Opens a video that takes its name when it is whole; one without pictures is not written.

    With the extra ``video`` it is H.264, which browsers play, else MPEG-4.

    Args:
      path: the file, ``.mp4``; its folder is made where it is missing.
      rate_hz: pictures a second.

    Yields:
      What adds a picture. The first one's size is the video's; others are cut or filled with black at their
      right and lower edge.

    Raises:
      OSError: where the video cannot be written.
    """
    begin = _begin_h264 if importlib.util.find_spec(_ENCODER) else _begin_mpeg4
    # Blocks of two pixels are what the codecs take.
    with _open(path, begin, rate_hz=rate_hz, block_px=2) as write:
        yield write


@contextlib.contextmanager
def open_gif(path: str | os.PathLike[str], *, rate_hz: float) -> Iterator[AddPicture]:
    """Opens an animated GIF that takes its name when it is whole; one without pictures is not written.

    It has one palette of `GIF_COLORS`, without dither, and repeats without end. All pictures are held in
    memory until the palette is known.

    Args:
      path: the file, ``.gif``; its folder is made where it is missing.
      rate_hz: pictures a second; GIF has steps of 0.01 s.

    Yields:
      As `open_video`.

    Raises:
      OSError: where it cannot be written.
      ImportError: without the extra ``video``.
    """
    require(_ENCODER, extra=_EXTRA, what="Animated GIFs")
    with _open(path, _begin_gif, rate_hz=rate_hz, block_px=1) as write:
        yield write


_Begin = Callable[[pathlib.Path, str, tuple[int, int], float, contextlib.ExitStack], AddPicture]
"""Begins a file, which errors call by another name, of a size (height, width, px) and rate; the stack ends
it."""


@contextlib.contextmanager
def _open(
    path: str | os.PathLike[str], begin: _Begin, *, rate_hz: float, block_px: int
) -> Iterator[AddPicture]:
    size, add = (0, 0), None
    with contextlib.ExitStack() as stack:

        def write(picture: np.ndarray) -> None:
            nonlocal add, size
            if add is None:
                height, width = picture.shape[:2]
                size = (height // block_px * block_px, width // block_px * block_px)
                temporary = stack.enter_context(atomic_path(path)).resolve()
                add = begin(temporary, str(path), size, rate_hz, stack)
            add(np.ascontiguousarray(_fit(picture, size)))

        yield write


def _begin_mpeg4(
    path: pathlib.Path, where: str, size: tuple[int, int], rate_hz: float, stack: contextlib.ExitStack
) -> AddPicture:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), rate_hz, size[::-1])
    stack.callback(writer.release)
    if not writer.isOpened():
        raise OSError(f"{where}: OpenCV cannot write a video there ({CODEC}).")
    return lambda picture: writer.write(picture[..., ::-1].copy())


def _begin_h264(
    path: pathlib.Path, where: str, size: tuple[int, int], rate_hz: float, stack: contextlib.ExitStack
) -> AddPicture:
    # The index comes first, so that a browser begins before it has the whole file.
    options = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    return stack.enter_context(_ffmpeg(path, where, size, rate_hz, options))


def _begin_gif(
    path: pathlib.Path, where: str, size: tuple[int, int], rate_hz: float, stack: contextlib.ExitStack
) -> AddPicture:
    palette = f"split[a][b];[a]palettegen=max_colors={GIF_COLORS}[p];[b][p]paletteuse=dither=none"
    return stack.enter_context(_ffmpeg(path, where, size, rate_hz, ["-vf", palette]))


@contextlib.contextmanager
def _ffmpeg(
    path: pathlib.Path, where: str, size: tuple[int, int], rate_hz: float, options: Sequence[str]
) -> Iterator[AddPicture]:
    """Runs ffmpeg, which takes pictures from its input."""
    try:
        program = require(_ENCODER, extra=_EXTRA, what="H.264 videos").get_ffmpeg_exe()
    # Its wheels for some platforms hold none.
    except RuntimeError as error:
        raise OSError(f"{where}: {error}") from error
    pictures = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[1]}x{size[0]}", "-r", f"{rate_hz:.6f}"]
    command = [program, "-y", "-v", "error", *pictures, "-i", "-", *options, str(path)]
    with tempfile.TemporaryFile() as errors:
        # In a session of its own: Ctrl-C is for the command, which ends the film well.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=errors, stderr=errors, start_new_session=True
        )
        assert process.stdin is not None
        broken = None
        try:
            yield process.stdin.write
            process.stdin.close()
        except BrokenPipeError as error:
            # It has ended, and says why.
            broken = error
        except BaseException:
            process.kill()
            raise
        finally:
            with contextlib.suppress(OSError):
                process.stdin.close()
            code = process.wait()
        if code or broken is not None:
            errors.seek(0)
            text = errors.read(_MAX_REASON).decode(errors="replace").strip()
            raise OSError(f"{where}: ffmpeg ended with code {code} ({text}).") from broken


def _fit(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture at another size, px: height, width."""
    if picture.shape[:2] == size:
        return picture
    fitted = np.zeros((*size, 3), np.uint8)
    height, width = min(size[0], picture.shape[0]), min(size[1], picture.shape[1])
    fitted[:height, :width] = picture[:height, :width]
    return fitted
