"""A place for one sweep between the thread that receives and the one that detects: the newest wins."""

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Closed(Exception):
    """Nothing more will come."""


class Mailbox(Generic[T]):
    """One item at most: a new one takes the place of one that nobody has fetched, which is counted."""

    def __init__(self) -> None:
        """Begins empty."""
        self._changed = threading.Condition()
        self._item: T | None = None
        self._closed = False
        self._error: BaseException | None = None
        self.num_skipped = 0
        """Items whose place was taken before anybody fetched them, and those of `skip`."""

    def put(self, item: T) -> None:
        """Leaves an item.

        Args:
          item: not None.
        """
        with self._changed:
            self.num_skipped += self._item is not None
            self._item = item
            self._changed.notify_all()

    def skip(self) -> None:
        """Counts an item that was fetched, and that nobody looked at."""
        with self._changed:
            self.num_skipped += 1

    def close(self, error: BaseException | None = None) -> None:
        """Says that nothing more comes.

        Args:
          error: why; raised in `take` once the last item is fetched. None where the source has ended.
        """
        with self._changed:
            self._closed, self._error = True, self._error or error
            self._changed.notify_all()

    def take(self, timeout_s: float | None = None) -> T | None:
        """Fetches the item, or waits for one.

        Args:
          timeout_s: at most so long, s; None for as long as it takes.

        Returns:
          The item; None where none came in that time.

        Raises:
          Closed: where there is none, and nothing more comes.
          BaseException: the error that `close` was given, in its place.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed, timeout_s)
            if self._item is None and self._closed:
                raise self._error or Closed
            item, self._item = self._item, None
            return item
