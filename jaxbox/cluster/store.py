"""A folder of results on any file system: a file appears whole, or not at all."""

import contextlib
import os
import pathlib
import tempfile
import uuid
from collections.abc import Iterator
from typing import Any, BinaryIO

from jaxbox._extras import require

_PARTIAL = ".part"


class Store:
    """A folder, local or at any URL that fsspec knows. It can be pickled."""

    def __init__(self, url: str | os.PathLike[str]) -> None:
        """Opens nothing yet.

        Args:
          url: a local folder, or such as ``s3://bucket/folder``; its file system has to be writable.

        Raises:
          ImportError: without the extra ``ray``, or what fsspec needs for the URL.
        """
        self.url = os.fspath(url)
        files: Any = require("fsspec.core", extra="ray", what="archives")
        self._system, self._root = files.url_to_fs(self.url)

    def make(self) -> None:
        """Makes the folder where it is missing."""
        self._system.makedirs(self._root, exist_ok=True)

    def names(self) -> list[str]:
        """Names of the files in the folder, sorted; none where there is no folder."""
        self._system.invalidate_cache()
        if not self._system.isdir(self._root):
            return []
        return sorted(pathlib.PurePosixPath(path).name for path in self._system.ls(self._root, detail=False))

    def read_text(self, name: str) -> str | None:
        """The text of a file, or None where there is none."""
        try:
            return self._system.cat_file(self._path(name)).decode("utf-8", "replace")
        except FileNotFoundError:
            return None

    def write_text(self, name: str, text: str) -> None:
        """Writes a file over whatever was there."""
        with self.writing(name) as path:
            path.write_text(text, "utf-8")

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[pathlib.Path]:
        """Lends a local path, and makes a file of the folder of it once the block has ended well.

        The file is sent under a hidden name and then renamed, so that it never stands there in part:
        whoever is killed leaves it as it was, and what it sent in part for `remove_partials`.

        Args:
          name: of the file.

        Yields:
          Where the file is to be written, on the local disk.
        """
        partial = self._path(f".{name}.{uuid.uuid4().hex}{_PARTIAL}")
        with tempfile.TemporaryDirectory(prefix="jaxbox-") as folder:
            path = pathlib.Path(folder) / name
            yield path
            try:
                self._system.put_file(str(path), partial)
                self._system.mv(partial, self._path(name))
            except BaseException:
                with contextlib.suppress(Exception):
                    self._system.rm_file(partial)
                raise

    @contextlib.contextmanager
    def reading(self, name: str) -> Iterator[BinaryIO]:
        """Opens a file for reading."""
        with self._system.open(self._path(name), "rb") as file:
            yield file

    def remove(self, name: str) -> None:
        """Removes a file, where it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._system.rm_file(self._path(name))

    def remove_partials(self) -> None:
        """Removes what was sent in part by writers that were killed; nobody may be writing meanwhile."""
        for name in self.names():
            if name.startswith(".") and name.endswith(_PARTIAL):
                self.remove(name)

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"
