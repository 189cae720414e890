"""JAX's compilation cache with a checksum in each entry: JAX looks at none before it runs what it finds.

An entry is machine code, compressed, and where that is by zstd damage need not be noticed. JAX has no public
way to put another cache in the place of its own, so that what makes it is wrapped; a version of JAX that
makes it in another way goes on without checksums.
"""

import contextlib
import hashlib
import importlib
import pathlib
from collections.abc import Callable, Collection
from typing import Any

_MAGIC = b"jaxbox entry 1\n"
_DIGEST_SIZE = hashlib.sha256().digest_size
_MAKER = "get_file_cache"
"""JAX's function that makes the cache of a folder."""
_SUFFIX = "-cache"
"""Of JAX's files, after the key."""


class CheckedEntries:
    """A cache of JAX's whose entries carry a SHA-256 of their key and content."""

    def __init__(self, kept: Any, folder: str) -> None:
        """Wraps the cache of a folder.

        Args:
          kept: with `get` and `put`, as JAX's `CacheInterface`.
          folder: that it is in.
        """
        self._kept, self._path = kept, pathlib.Path(folder)

    def get(self, key: str) -> bytes | None:
        """The content of an entry; None where there is none, or not the one that was put under the key."""
        entry = self._kept.get(key)
        if entry is None:
            return None
        content = entry[len(_MAGIC) + _DIGEST_SIZE :]
        if entry == _sealed(key, content):
            return content
        # JAX writes over no entry.
        with contextlib.suppress(OSError):
            (self._path / f"{key}{_SUFFIX}").unlink(missing_ok=True)
        return None

    def put(self, key: str, value: bytes) -> None:
        """Keeps a content under a key."""
        self._kept.put(key, _sealed(key, value))


def _sealed(key: str, content: bytes) -> bytes:
    return _MAGIC + hashlib.sha256(key.encode() + b"\n" + content).digest() + content


class _MakeChecked:
    """In the place of JAX's function: makes the cache of a folder, and wraps it."""

    def __init__(self, make: Callable[[str], Any], folders: Collection[str]) -> None:
        self._make, self._folders = make, folders

    def __call__(self, path: str) -> Any:
        made = self._make(path)
        if path not in self._folders or not isinstance(made, tuple):
            return made
        return CheckedEntries(made[0], path), *made[1:]


def check_entries(folders: Collection[str]) -> None:
    """Has JAX's cache check its entries where it is in one of some folders.

    Args:
      folders: that jaxbox gave to JAX; more may be added later. In any other, entries stay as JAX has them.
    """
    try:
        maker = importlib.import_module("jax._src.compilation_cache")
        make = getattr(maker, _MAKER)
    except (ImportError, AttributeError):
        return
    if not isinstance(make, _MakeChecked):
        setattr(maker, _MAKER, _MakeChecked(make, folders))
