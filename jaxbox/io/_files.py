"""Files read with errors a user can act on, and written whole or not at all."""

import contextlib
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


@contextlib.contextmanager
def atomic_writer(path: str | os.PathLike[str]) -> Iterator[TextIO]:
    """Opens a text file that takes its name only once it is whole.

    A crash or an error within the block leaves whatever stood at `path` as it was. The temporary file
    lies in the same folder, because a rename is atomic only within one file system.

    Args:
      path: the file; its folder is made where it is missing.

    Yields:
      A UTF-8 text handle.
    """
    target = pathlib.Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".tmp")
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8", newline="\n") as handle:
            yield handle
        # mkstemp makes the file private; a result is to be as readable as any other new file.
        os.chmod(temporary, _default_mode())
        os.replace(temporary, target)
    except BaseException:
        pathlib.Path(temporary).unlink(missing_ok=True)
        raise


def _default_mode() -> int:
    """Permissions that `open` would give a new file; the mask can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
