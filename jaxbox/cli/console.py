"""What goes to the terminal: results to stdout, progress and errors to stderr, and exit codes."""

import contextlib
import enum
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.progress import TimeRemainingColumn as _TimeLeft
from rich.text import Text

from jaxbox._interrupts import EXIT_CODE
from jaxbox.io import InputError
from jaxbox.run.cache import CacheWarning

FILE_WIDTH = 120
"""Columns of a table where stdout is not a terminal: wide enough for all of them."""


class OutputError(Exception):
    """Results cannot be written, so that a run cannot go on; the message names the file and the fix."""


class ExitCode(enum.IntEnum):
    """How a command ended."""

    OK = 0
    FRAME_FAILED = 1
    BAD_INPUT = 2
    INTERRUPTED = EXIT_CODE


def exit_code(*, failed: bool, interrupted: bool) -> ExitCode:
    """How a run over sweeps ended.

    >>> exit_code(failed=True, interrupted=False)
    <ExitCode.FRAME_FAILED: 1>
    """
    if interrupted:
        return ExitCode.INTERRUPTED
    return ExitCode.FRAME_FAILED if failed else ExitCode.OK


def printable(text: str) -> str:
    """Text of one line that does nothing to a terminal or a log, whatever name of a file is in it.

    Args:
      text: any.

    Returns:
      The text, with control characters, line breaks, marks that reorder text, and what is no text at all
      written as Python escapes.

    >>> printable("a\\x1b[31m b")
    'a\\\\x1b[31m b'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def counted(count: int, noun: str) -> str:
    """A number of things in words.

    >>> counted(1, "sweep"), counted(0, "fault")
    ('1 sweep', '0 faults')
    """
    return f"{count} {noun}{'s' * (count != 1)}"


class _Lines(Console):
    """Prints each piece of text as one line, see `printable`."""

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich's, with the text escaped."""
        super().print(*(printable(o) if isinstance(o, str) else o for o in objects), **options)


def stdout() -> Console:
    """Console for results. Made when asked, so that a redirected stdout is honoured."""
    width = None if sys.stdout.isatty() else FILE_WIDTH
    return _Lines(highlight=False, soft_wrap=True, width=width)


def stderr() -> Console:
    """Console for progress and errors."""
    return _Lines(stderr=True, highlight=False, soft_wrap=True)


def print_error(message: str) -> None:
    """Prints one line to stderr, as it stands: a path may hold what looks like markup."""
    stderr().print(Text.assemble(("error: ", "bold red"), printable(message)))


def print_warning(message: str) -> None:
    """Prints one line to stderr, as `print_error`: something to know, after which all goes on."""
    stderr().print(Text.assemble(("warning: ", "bold yellow"), printable(message)))


@contextlib.contextmanager
def cache_warnings() -> Iterator[None]:
    """Turns the reason why nothing is kept between runs into one line on stderr."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CacheWarning)
        yield
    for warning in caught:
        print_warning(str(warning.message))


@contextlib.contextmanager
def input_errors() -> Iterator[None]:
    """Turns errors that the user can fix into one line on stderr and exit code 2.

    Raises:
      typer.Exit: in place of a bad input, an unwritable folder, a missing extra or a lack of memory.
    """
    try:
        yield
    except (InputError, OutputError, OSError, ImportError) as error:
        print_error(str(error))
        raise typer.Exit(ExitCode.BAD_INPUT) from error
    except (MemoryError, RuntimeError) as error:
        # JAX's errors are all of one class.
        if not (isinstance(error, MemoryError) or str(error).startswith("RESOURCE_EXHAUSTED")):
            raise
        print_error(
            f"there is not enough memory ({str(error) or 'none is left'}). Take a smaller --capacity, "
            "smaller capacities in the settings, or fewer --jobs; on a GPU see what else runs there."
        )
        raise typer.Exit(ExitCode.BAD_INPUT) from error


class _Rate(ProgressColumn):
    """Sweeps a second."""

    def render(self, task: Task) -> Text:
        """One number once there is one."""
        return Text("" if task.speed is None else f"{task.speed:.1f}/s")


def make_progress(*, shown: bool) -> Progress:
    """A progress bar with rate and time left, on stderr; it hides where stderr is not a terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        _TimeLeft(),
        TextColumn("left"),
        console=stderr(),
        transient=True,
        disable=not shown,
        # Lines printed meanwhile go above the bar; where stdout is a file they must stay in it.
        redirect_stdout=sys.stdout.isatty(),
    )
