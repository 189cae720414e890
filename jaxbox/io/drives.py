"""Which drive each frame was recorded on: one "frame drive" a line."""

import os
import pathlib
from collections.abc import Iterable, Sequence

from jaxbox._files import InputError, read_text

PathLike = str | os.PathLike[str]

FILE_NAME = "drives.txt"
_COMMENT = "#"
_COLUMNS = (2, 3)


def find_drives(folder: PathLike) -> pathlib.Path | None:
    """The file ``drives.txt`` in a folder of labelled sweeps, or beside it.

    Args:
      folder: such as ``KITTI`` or ``KITTI/training``.

    Returns:
      The file; None where there is none.
    """
    folder = pathlib.Path(folder).absolute()
    files = (folder / FILE_NAME, folder.parent / FILE_NAME)
    return next((file for file in files if file.is_file()), None)


def read_drives(path: PathLike | Sequence[PathLike], names: Iterable[str]) -> dict[str, str]:
    """Reads the drive of each frame.

    Frames of one drive show the same street and often the same cars, so figures are pooled by drive.

    Args:
      path: text, one frame and its drive a line, separated by spaces, and behind them, if you like, its
        number in the drive; empty lines and what follows a "#" are skipped. Frames beyond those asked for
        are allowed. Or several such files.
      names: the frames to look up.

    Returns:
      The drive of each of these frames, in their order.

    Raises:
      InputError: naming file and line for a line of other words, and both places of a frame that stands
        twice; naming the first frame that is missing.
    """
    given = [path] if isinstance(path, str | os.PathLike) else path
    # Two folders may share a file, which is read once.
    paths = list(dict.fromkeys(map(pathlib.Path, given)))
    drives: dict[str, str] = {}
    places: dict[str, str] = {}
    for file in paths:
        _read_file(file, drives, places)
    names = list(names)
    missing = [name for name in names if name not in drives]
    if missing:
        raise InputError(
            f"{', '.join(map(str, paths))}: no drive for {len(missing)} of {len(names)} frames, the first is "
            f'{missing[0]}; add a line "{missing[0]} DRIVE".'
        )
    return {name: drives[name] for name in names}


def _read_file(path: pathlib.Path, drives: dict[str, str], places: dict[str, str]) -> None:
    """Adds the frames of one file, and where they stand, to those of the files before it."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition(_COMMENT)[0].split()
        if not words:
            continue
        place = f"{path}, line {number}"
        if len(words) not in _COLUMNS:
            raise InputError(f"{place}: {len(words)} words; write the frame, a space, its drive.")
        frame, drive = words[:2]
        if frame in drives:
            raise InputError(
                f"{place}: frame {frame} has a drive already, by {places[frame]}; remove one of the "
                "two lines."
            )
        drives[frame], places[frame] = drive, place
