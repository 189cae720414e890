"""Which drive each frame was recorded on: one "frame drive" a line."""

import os
from collections.abc import Iterable

from jaxbox._files import InputError, read_text

_COMMENT = "#"
_COLUMNS = 2


def read_drives(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, str]:
    """Reads the drive of each frame.

    Frames of one drive show the same street and often the same cars, so figures are pooled by drive.

    Args:
      path: text, one frame and its drive a line, separated by spaces; empty lines and what follows a "#" are
        skipped. Frames beyond those asked for are allowed.
      names: the frames to look up.

    Returns:
      The drive of each of these frames, in their order.

    Raises:
      InputError: naming file and line for a line that is not two words or a frame that stands twice;
        naming the first frame that is missing.
    """
    drives: dict[str, str] = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition(_COMMENT)[0].split()
        if not words:
            continue
        if len(words) != _COLUMNS:
            raise InputError(
                f"{path}, line {number}: {len(words)} words; write the frame, a space, its drive."
            )
        frame, drive = words
        if frame in drives:
            raise InputError(
                f"{path}, line {number}: frame {frame} stands there twice; keep one of the lines."
            )
        drives[frame] = drive
    names = list(names)
    missing = [name for name in names if name not in drives]
    if missing:
        raise InputError(
            f"{path}: no drive for {len(missing)} of {len(names)} frames, the first is {missing[0]}; "
            f'add a line "{missing[0]} DRIVE".'
        )
    return {name: drives[name] for name in names}
