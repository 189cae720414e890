"""Work over processes: results in order, and no item lost with a process that dies.

Each process has a thread in the parent that hands it one item at a time, so it is known which item a process
had when it died. That item is tried once more in a new process, and the others never notice.
"""

import collections
import concurrent.futures
import dataclasses
import multiprocessing
import os
import pickle
import queue
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

from jaxbox.run.cache import CacheFolders

THREADS_VARIABLE = "NPROC"
"""Environment variable by which XLA is told how many threads a process may take."""

_END_S = 10.0
"""An idle process that has not ended by itself after this time is killed."""

_LARGE_BYTES = 4096
"""Arrays of this size and more go from process to process as they are; smaller ones within the pickle."""

Item = TypeVar("Item")
Result = TypeVar("Result")
Begun = TypeVar("Begun")


_Start = Callable[[], Callable[[Any], Any]]


class WorkerDied(RuntimeError):
    """The process that worked on an item ended, twice."""


class _ProcessEnded(Exception):
    """A process ended before it answered."""


def ahead(items: Iterable[Item], begin: Callable[[Item], Begun], count: int) -> Iterator[tuple[Item, Begun]]:
    """Each item and what was begun for it, in order; the next `count` are begun before it is handed out.

    Args:
      items: asked for one by one.
      begin: begins with an item, and returns such as its future.
      count: how far ahead.

    Yields:
      Every item that there was, also where asking for another failed; then that error is raised.
    """
    waiting: collections.deque[tuple[Item, Begun]] = collections.deque()
    source, broken = iter(items), None
    while True:
        try:
            item = next(source)
        except StopIteration:
            break
        except Exception as error:
            # What was read before a recording breaks off is as good as ever.
            broken = error
            break
        waiting.append((item, begin(item)))
        if len(waiting) > count:
            yield waiting.popleft()
    yield from waiting
    if broken is not None:
        raise broken


class ProcessPool(Generic[Item, Result]):
    """A fixed number of processes, as a context; leaving it early, by an error or Ctrl-C, kills them."""

    def __init__(self, start: Callable[[], Callable[[Item], Result]], workers: int) -> None:
        """Starts nothing yet: a process starts with its first item.

        Args:
          start: called once in each process, for what is called with each item there. It is pickled, and so
            are items and results; a script must start its work under ``if __name__ == "__main__":``.
          workers: number of processes. They share the cores.
        """
        self._start, self._surroundings = start, _Environment.of_this(workers)
        self._threads = concurrent.futures.ThreadPoolExecutor(workers, initializer=_keep_interrupts_away)
        self._own = threading.local()
        self._lock, self._left = threading.Lock(), False
        self._processes: set[_Process] = set()
        self._deaths: queue.SimpleQueue[tuple[Item, str]] = queue.SimpleQueue()

    def submit(self, item: Item) -> Future[Result]:
        """Hands an item to the next process that is free.

        Args:
          item: what can be pickled.

        Returns:
          A future of what the process answers. It raises what was raised there, or `WorkerDied`.
        """
        return self._threads.submit(self._run, item)

    def take_deaths(self) -> list[tuple[Item, str]]:
        """Items whose process died since this was last asked, and how; each of them is tried once more."""
        deaths = []
        while not self._deaths.empty():
            deaths.append(self._deaths.get())
        return deaths

    def __enter__(self) -> "ProcessPool[Item, Result]":
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        with self._lock:
            self._left = kind is not None
            if self._left:
                for process in self._processes:
                    process.kill()
        self._threads.shutdown(cancel_futures=self._left)
        for process in self._processes:
            process.dismiss()
        for process in self._processes:
            process.wait()

    def _run(self, item: Item) -> Result:
        try:
            return self._process().call(item)
        except _ProcessEnded as ended:
            self._drop()
            self._deaths.put((item, str(ended)))
        try:
            return self._process().call(item)
        except _ProcessEnded as ended:
            self._drop()
            raise WorkerDied(f"its process ended, and so did the second that tried it ({ended}).") from ended

    def _process(self) -> "_Process":
        """This thread's process, started where there is none."""
        if getattr(self._own, "process", None) is None:
            with self._lock:
                if self._left:
                    raise _ProcessEnded("the pool was left")
                self._own.process = _Process(self._start, self._surroundings)
                self._processes.add(self._own.process)
        return self._own.process

    def _drop(self) -> None:
        with self._lock:
            self._processes.discard(self._own.process)
        self._own.process = None


def _keep_interrupts_away() -> None:
    """Keeps Ctrl-C, which a terminal sends to all, from this thread's processes: the parent ends them.

    Windows cannot, and its processes hear it.
    """
    if not hasattr(signal, "pthread_sigmask"):
        return
    # It lets the signal through again where it starts, which the first process would make it do.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


@dataclasses.dataclass(frozen=True)
class _Environment:
    """What a process must know before JAX starts in it."""

    num_threads: int
    cache_folders: CacheFolders

    @classmethod
    def of_this(cls, workers: int) -> "_Environment":
        return cls(
            num_threads=max(1, (os.cpu_count() or 1) // workers),
            cache_folders=CacheFolders.of_this_process(),
        )

    def apply(self) -> None:
        os.environ.setdefault(THREADS_VARIABLE, str(self.num_threads))
        self.cache_folders.apply()


class _Process:
    """A worker process as its thread in the parent sees it."""

    def __init__(self, start: _Start, surroundings: _Environment) -> None:
        # A fork would copy JAX's threads half-way through their work.
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, surroundings, start), daemon=True)
        self._process.start()
        theirs.close()

    def call(self, item: Any) -> Any:
        """The answer to one item."""
        data = pickle.dumps(item)
        try:
            self._connection.send_bytes(data)
            head, *arrays = [self._connection.recv_bytes() for _ in range(self._connection.recv())]
        except (EOFError, OSError) as error:
            self._process.join(_END_S)
            raise _ProcessEnded(_describe_exit(self._process.exitcode)) from error
        # As bytes they could not be written to.
        is_result, value = pickle.loads(head, buffers=[bytearray(array) for array in arrays])
        if not is_result:
            raise value
        return value

    def kill(self) -> None:
        """Ends the process, whatever it does."""
        self._process.kill()

    def dismiss(self) -> None:
        """Lets the process end; it waits for an item and finds that there are none."""
        self._connection.close()

    def wait(self) -> None:
        """Waits for the end."""
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _describe_exit(code: int | None) -> str:
    """How a process ended, in words.

    >>> _describe_exit(-9), _describe_exit(3)
    ('killed by SIGKILL, perhaps for want of memory', 'exit code 3')
    """
    if code is None or code >= 0:
        return f"exit code {code}"
    hint = ", perhaps for want of memory" if -code == signal.SIGKILL else ""
    return f"killed by {signal.Signals(-code).name}{hint}"


def _serve(connection: Connection, surroundings: _Environment, start: _Start) -> None:
    """A worker process: answers items until the parent lets go."""
    surroundings.apply()
    calls: list[Callable[[Any], Any]] = []
    while True:
        try:
            data = connection.recv_bytes()
        except EOFError:
            return
        parts = _answer(start, calls, data)
        connection.send(len(parts))
        for part in parts:
            connection.send_bytes(part)


def _answer(start: _Start, calls: list[Callable[[Any], Any]], data: bytes) -> list[bytes | memoryview]:
    """(True, result) or (False, error), see `_pickle`."""
    try:
        if not calls:
            calls.append(start())
        return _pickle((True, calls[0](pickle.loads(data))))
    except Exception as error:
        error.add_note(f"In a worker process:\n{traceback.format_exc()}")
        try:
            sent = pickle.dumps((False, error))
            pickle.loads(sent)
        except Exception:
            # An error that cannot travel goes as its words.
            return [pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))]
        return [sent]


def _pickle(value: Any) -> list[bytes | memoryview]:
    """A value pickled, and after it the memory of its large arrays, which is not copied."""
    arrays: list[memoryview] = []

    def keep_inside(buffer: pickle.PickleBuffer) -> bool:
        memory = buffer.raw()
        is_small = memory.nbytes < _LARGE_BYTES
        if not is_small:
            arrays.append(memory)
        return is_small

    return [pickle.dumps(value, protocol=5, buffer_callback=keep_inside), *arrays]
