"""Files read with errors a user can act on, and written whole or not at all."""

import contextlib
import math
import os
import pathlib
import tempfile
from collections.abc import Iterator
from typing import TextIO


class InputError(ValueError):
    """A file or folder that cannot be used; the message names it, the line or field, and the mend."""


def read_text(path: str | os.PathLike[str]) -> str:
    """Reads a text file.

    Args:
      path: the file.

    Returns:
      Its text.

    Raises:
      InputError: where it is missing, unreadable or not text.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file ({error.reason} at byte {error.start}).") from error


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Reads a file.

    Args:
      path: the file.

    Returns:
      Its bytes.

    Raises:
      InputError: where it is missing or unreadable.
    """
    try:
        return pathlib.Path(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file; check the path.") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error


def finite_number(text: str, name: str, where: str) -> float:
    """Reads a number.

    Args:
      text: the word.
      name: the field, for the error.
      where: file and line, for the error.

    Returns:
      A finite number.

    Raises:
      InputError: for anything else.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {name} is {text!r}; it must be a finite number.")
    return value


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Lends a temporary file that takes its name only once the block has ended well.

    A crash or an error within the block leaves whatever stood at `path` as it was. The temporary file
    lies in the same folder, because a rename is atomic only within one file system.

    Args:
      path: the file; its folder is made where it is missing.

    Yields:
      Path of an empty file with the same suffix, to be written by any means.
    """
    target = pathlib.Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.stem}.", suffix=target.suffix)
    os.close(handle)
    temporary = pathlib.Path(name)
    try:
        yield temporary
        # mkstemp makes the file private; a result is to be as readable as any other new file.
        temporary.chmod(_default_mode())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def atomic_writer(path: str | os.PathLike[str]) -> Iterator[TextIO]:
    """Opens a text file that takes its name only once it is whole; see `atomic_path`.

    Args:
      path: the file; its folder is made where it is missing.

    Yields:
      A UTF-8 text handle.
    """
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as handle:
        yield handle


def _default_mode() -> int:
    """Permissions that `open` would give a new file; the mask can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
