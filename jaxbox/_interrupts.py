"""Ctrl-C that is heard: by every command, once, and not in the middle of what belongs together.

A KeyboardInterrupt that Python raises within a callback, such as the one by which JAX hears of garbage
collection, is printed and forgotten, and the program goes on. So a command line raises it again until it ends
something. In a program that only imports jaxbox, nothing here touches its signals.
"""

import atexit
import contextlib
import dataclasses
import os
import pathlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

EXIT_CODE = 130
"""Of a command that was interrupted: 128 and the number of SIGINT, as shells have it."""
_AGAIN_S = 0.2
"""A KeyboardInterrupt that nobody heard is raised again after this."""


@dataclasses.dataclass
class _State:
    came: bool = False
    """Whether an interrupt waits to be heard."""
    held: int = 0
    """Blocks under way that are not to be interrupted."""


_state = _State()


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Ends the process with `EXIT_CODE` where a block is interrupted, unless the block has `heard` it.

    Where the process ignores Ctrl-C, as one in the background may, it goes on to do so.

    A KeyboardInterrupt, or what a library made of it, is not raised: the process ends after its exit
    functions.
    """
    if not _on_main_thread() or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    heard()
    signal.signal(signal.SIGINT, _interrupt)
    if hasattr(signal, "SIGALRM"):
        signal.signal(signal.SIGALRM, _interrupt_again)
    ended: BaseException | None = None
    try:
        yield
    except BaseException as error:
        ended = error
    was_unheard = _state.came
    heard()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Whoever heard it has said so, and chosen the exit code.
    if was_unheard or (isinstance(ended, SystemExit) and ended.code == EXIT_CODE):
        _end(in_words=was_unheard)
    if ended is not None:
        raise ended


def _end(*, in_words: bool) -> NoReturn:
    """Ends the process here: to take apart a compiler that was interrupted may end in a fault."""
    if in_words:
        print("interrupted.", file=sys.stderr)
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(EXIT_CODE)


def heard() -> None:
    """Says that an interrupt needs no more raising: who catches a KeyboardInterrupt and goes on says so."""
    if hasattr(signal, "setitimer") and _on_main_thread():
        signal.setitimer(signal.ITIMER_REAL, 0)
    _state.came = False


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Makes SIGTERM, by which schedulers end a job, the same as Ctrl-C: a KeyboardInterrupt."""
    if not _on_main_thread():
        yield
        return
    is_ours = signal.getsignal(signal.SIGINT) is _interrupt
    before = signal.signal(signal.SIGTERM, _interrupt if is_ours else signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Puts Ctrl-C and SIGTERM off until a block has ended, so that what it writes belongs together.

    Raises:
      KeyboardInterrupt: after the block, where one of them came.
    """
    if not _on_main_thread():
        yield
        return
    came: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: came.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    _state.held += 1
    try:
        yield
    finally:
        _state.held -= 1
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            # As it waits to be heard now, whatever becomes of the exception.
            _state.came = before.get(signal.SIGINT) is _interrupt
            raise KeyboardInterrupt


def _on_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def release() -> None:
    """Ends the wait that this module's import began where the process is the command line.

    Raises:
      SystemExit: where it was interrupted meanwhile.
    """
    if signal.getsignal(signal.SIGINT) is _wait:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if _state.came:
            print("interrupted.", file=sys.stderr)
            raise SystemExit(EXIT_CODE)


def _is_command() -> bool:
    """Whether this process is the command line, and not a program that imports jaxbox, or a worker."""
    # Not imported here, as it takes longer than all else in this file.
    processes = sys.modules.get("multiprocessing.process")
    if not _on_main_thread() or (processes is not None and processes.parent_process() is not None):
        return False
    # While Python looks for the module, that is what the program is called.
    if sys.argv[:1] == ["-m"]:
        return ("-m", "jaxbox") in zip(sys.orig_argv, sys.orig_argv[1:], strict=False)
    return pathlib.Path(sys.argv[0] if sys.argv else "").stem == "jaxbox"


def _wait(_number: int, _frame: FrameType | None) -> None:
    _state.came = True


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    _state.came = True
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S, _AGAIN_S)
    raise KeyboardInterrupt


def _interrupt_again(_number: int, _frame: FrameType | None) -> None:
    if _state.came and not _state.held and not _is_ending():
        raise KeyboardInterrupt


def _is_ending() -> bool:
    """Whether what is being done now, is done because of an interrupt: files are closed, say."""
    error = sys.exception()
    while error is not None:
        if isinstance(error, KeyboardInterrupt | SystemExit):
            return True
        error = error.__context__
    return False


# To import JAX takes a second, in which a KeyboardInterrupt may end the process by a fault, or be forgotten.
if _is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _wait)
