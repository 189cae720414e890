"""What the compiler has freed, given back to the system."""

import contextlib
import ctypes
import sys
import threading
from collections.abc import Iterator

EVERY_S = 0.2
"""Often enough to come between the compiler and JAX, which copies what was compiled for its cache."""


@contextlib.contextmanager
def giving_memory_back() -> Iterator[None]:
    """While it lasts, and once at its end, memory that was freed goes back to the system.

    glibc keeps it for later: after a compilation half a gigabyte, which no sweep will ask for. Other C
    libraries are left alone.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is None:
        yield
        return
    done = threading.Event()

    def trim_until_done() -> None:
        while not done.wait(EVERY_S):
            trim(0)

    trimming = threading.Thread(target=trim_until_done, daemon=True)
    trimming.start()
    try:
        yield
    finally:
        done.set()
        trimming.join()
        trim(0)
