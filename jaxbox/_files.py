"""Files read with errors a user can act on, and written whole or not at all."""

import contextlib
import json
import math
import os
import pathlib
import stat
import sys
import tempfile
from collections.abc import Iterator
from typing import Any, TextIO

if sys.platform == "win32":
    fcntl = None
else:
    import fcntl


class InputError(ValueError):
    """A file or folder that cannot be used; the message names it, the line or field, and the fix."""


MAX_SWEEP_BYTES = 2**30
"""Of the points of one sweep, packed or unpacked, and of any other file that is read as a whole."""

MAX_TEXT_BYTES = 2**28
"""Of a text file, which takes several times its size while it is read."""


_MAX_REASON = 200
_TEMPORARY = ".jaxbox-"
"""How the names of temporary files begin; hidden, so that no folder's sweeps are found in them."""


def check_file(path: str | os.PathLike[str], *, max_bytes: int | None = MAX_SWEEP_BYTES) -> int:
    """Refuses what cannot be read to its end: pipes, devices, sockets, folders, and files beyond a bound.

    Args:
      path: of a file; a link to one is a file.
      max_bytes: its bound; None for files that are read piece by piece.

    Returns:
      Its size, bytes.

    Raises:
      InputError: where it is missing, no plain file, or too large.
    """
    try:
        found = os.stat(path)
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file; check the path.") from error
    # A path with a NUL is a ValueError.
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}).") from error
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"{path}: no plain file; copy what it stands for into a file, and give that.")
    if max_bytes is not None and found.st_size > max_bytes:
        raise InputError(
            f"{path}: {found.st_size} bytes; at most {max_bytes} are read. Is it the file that was meant? "
            "Split it if so."
        )
    return found.st_size


def read_text(path: str | os.PathLike[str], *, max_bytes: int | None = MAX_TEXT_BYTES) -> str:
    """Reads a text file.

    Args:
      path: the file.
      max_bytes: as `check_file`.

    Returns:
      Its text.

    Raises:
      InputError: where it is missing, unreadable, too large or not text.
    """
    try:
        return read_bytes(path, max_bytes=max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file ({error.reason} at byte {error.start}).") from error


def read_bytes(path: str | os.PathLike[str], *, max_bytes: int | None = MAX_SWEEP_BYTES) -> bytes:
    """Reads a file.

    Args:
      path: the file.
      max_bytes: as `check_file`.

    Returns:
      Its bytes.

    Raises:
      InputError: where it is missing, unreadable or too large.
    """
    check_file(path, max_bytes=max_bytes)
    try:
        return pathlib.Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error


def parse_json(text: str, where: str) -> Any:
    """Reads JSON.

    Args:
      text: the whole of it.
      where: the file, for the error.

    Returns:
      What it holds.

    Raises:
      InputError: where it is not JSON, is nested without end, or has a number of thousands of digits.
    """
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        place = f"{where}, line {error.lineno}" if "\n" in text else where
        raise InputError(f"{place}: not JSON ({error.msg} at column {error.colno}).") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: JSON that cannot be read ({reason(error)}).") from error


def reason(error: BaseException) -> str:
    """What another library says of a broken file, as one short line: it may quote the file itself.

    >>> reason(ValueError("first\\nsecond"))
    'first'
    >>> reason(EOFError())
    'EOFError'
    """
    text = str(error)[: 2 * _MAX_REASON].strip().partition("\n")[0]
    return (text if len(text) <= _MAX_REASON else f"{text[:_MAX_REASON]}...") or type(error).__name__


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
    lies in the same folder, because a rename is atomic only within one file system. A process that is
    killed leaves it there; `remove_abandoned` takes it away.

    Args:
      path: the file; its folder is made where it is missing.

    Yields:
      Path of an empty file with the same suffix, to be written by any means.

    Raises:
      OSError: naming the file, where its folder cannot be made or written.
    """
    target = pathlib.Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=_TEMPORARY, suffix=target.suffix)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(target)) from error
    temporary = pathlib.Path(name)
    # Held while the file is written, and given up by the system when the process ends in any way.
    is_locked = _try_lock(handle)
    if not is_locked:
        os.close(handle)
    try:
        yield temporary
        # mkstemp makes the file private; a result is to be as readable as any other new file.
        temporary.chmod(_default_mode())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    finally:
        if is_locked:
            os.close(handle)


def check_no_link(folder: str | os.PathLike[str]) -> None:
    """Refuses a link where a folder of the output is to be: what is written through it lies elsewhere.

    Args:
      folder: that files will be written to; it need not be there.

    Raises:
      InputError: where it is a link.
    """
    if pathlib.Path(folder).is_symlink():
        raise InputError(
            f"{folder}: a link, and pictures are not written through one; remove it, or name the folder that "
            "it stands for as output."
        )


def remove_abandoned(folder: str | os.PathLike[str]) -> None:
    """Removes temporary files of `atomic_path` whose process was killed before it could do so itself.

    Args:
      folder: where they would lie; it need not be there. Those that are still written are left alone.
    """
    for path in pathlib.Path(folder).glob(f"{_TEMPORARY}*"):
        with contextlib.suppress(OSError):
            handle = os.open(path, os.O_RDWR)
            try:
                if _try_lock(handle):
                    path.unlink()
            finally:
                os.close(handle)


def _try_lock(handle: int) -> bool:
    """Locks an open file for this process alone; False where another holds it, or files have no locks."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


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
