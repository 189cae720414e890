"""Fuzzing of every reader of `jaxbox.io`: only documented errors, no hang, bounded memory.

    python -m quality.fuzz_readers [--reader NAME ...] [--minutes 10] [--folder DIR] [--json FILE]

libFuzzer, by way of Atheris (``pip install atheris``, not a dependency), changes small files that the
formats' own libraries wrote (`fuzz_targets`), and keeps what reaches new code of the reader or its library.
The readers take their turns in processes of their own, on one core. What one raises besides
`jaxbox.io.InputError`, a warning included, is kept once a place in the code as ``DIR/NAME/findings/*``; bytes
that hang it, end its process or ask for too much memory are kept too, and count where reading them once more
does the same.

A finding, once fixed, goes to ``tests/corpus/NAME``, which the tests read. Where the file of ``--json`` is
there, its minutes and executions are added to, reader by reader.
"""

import hashlib
import importlib
import json
import mmap
import os
import pathlib
import resource
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from typing import Any

WATCHED = ["jaxbox.io", "jaxbox.config.fields", "pypcd4", "laspy", "rosbags", "mcap", "tomllib", "zipfile"]
"""Modules whose branches guide the fuzzer; code that is not Python is a black box to it."""
UNWATCHED = ["rosbags.typesys"]
"""Of these: tables of every message there is, which take a minute to prepare."""

try:
    atheris = importlib.import_module("atheris")
except ImportError as missing:
    raise SystemExit("fuzzing needs atheris: pip install atheris") from missing
# Only what is imported here is watched, so nothing of the readers may come before.
with atheris.instrument_imports(include=WATCHED, exclude=UNWATCHED):
    from benchmarks import common
    from quality.fuzz_targets import TARGETS, Target, prepared

MEMORY_BYTES = 2**31
"""What a reader may take beyond the libraries themselves, for a file of at most `MAX_FILE_BYTES`."""
TIME_LIMIT_S = 20
"""A file that takes longer is a hang."""
MAX_FILE_BYTES = 65536
MINUTES = 10.0
_LEAST_S = 2.0


class Counter:
    """A number in a file, which outlives the process whatever ends it."""

    def __init__(self, path: pathlib.Path) -> None:
        path.write_bytes(bytes(8))
        with path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), 8)

    def add(self) -> None:
        """One more."""
        self._map[:8] = struct.pack("<q", self.value + 1)

    @property
    def value(self) -> int:
        """So many."""
        return struct.unpack("<q", self._map[:8])[0]


def in_child(work: Callable[[], None], log: str | os.PathLike[str]) -> int:
    """Runs something in a fork of this process, its output in a file, and returns how it ended."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(handle, sys.stdout.fileno())
            os.dup2(handle, sys.stderr.fileno())
            warnings.simplefilter("error")
            work()
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def limit_memory() -> None:
    """Lets allocations fail beyond the bound, so that asking for more is a finding."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[0])
    bound = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (bound, bound))


def fuzz(target: Target, folder: pathlib.Path, seconds: int, counter: Counter) -> None:
    """Feeds a reader until the time is over, or it ends the process."""
    corpus, findings = folder / "corpus", folder / "findings"
    for each in (corpus, findings):
        each.mkdir(parents=True, exist_ok=True)
    for name, data in target.seeds().items():
        (corpus / f"seed-{name}").write_bytes(data)
    with tempfile.TemporaryDirectory() as root, prepared(target, pathlib.Path(root)) as read:

        def one_input(data: bytes) -> None:
            counter.add()
            try:
                read(data)
            except Exception as error:
                keep(findings, data, error)

        options = {
            "max_total_time": seconds, "timeout": TIME_LIMIT_S, "max_len": MAX_FILE_BYTES,
            "rss_limit_mb": 0, "artifact_prefix": f"{findings}/",
        }  # fmt: skip
        words = [f"-{key}={value}" for key, value in options.items()]
        atheris.Setup([sys.argv[0], *words, str(corpus)], one_input)
        limit_memory()
        atheris.Fuzz()


def keep(findings: pathlib.Path, data: bytes, error: BaseException) -> None:
    """Writes the bytes and the traceback of an error, unless its place is known."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = hashlib.sha256(f"{last.filename}:{last.lineno}".encode()).hexdigest()[:10]
    file = findings / f"{type(error).__name__}-{place}"
    if not file.exists():
        file.write_bytes(data)
        file.with_suffix(".txt").write_text("".join(traceback.format_exception(error)))


def replay(target: Target, file: pathlib.Path) -> None:
    """Reads one file within the limits of memory and time; raises or dies where that cannot be done."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime) + TIME_LIMIT_S
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    limit_memory()
    with tempfile.TemporaryDirectory() as root, prepared(target, pathlib.Path(root)) as read:
        read(file.read_bytes())


def fuzz_reader(name: str, seconds: float, folder: pathlib.Path) -> dict[str, Any]:
    """Fuzzes one reader for so long, and says what came of it."""
    target = TARGETS[name]
    folder.mkdir(parents=True, exist_ok=True)
    log, counter = folder / "log.txt", Counter(folder / "executions")
    start, cpu_start = time.monotonic(), children_cpu_s()
    while (left := seconds - (time.monotonic() - start)) > _LEAST_S:
        in_child(lambda left=left: fuzz(target, folder, int(left), counter), log)
    # libFuzzer measures hangs by the clock, so a process that was paused looks like one.
    spent = {
        "minutes": (time.monotonic() - start) / 60,
        "cpu_minutes": (children_cpu_s() - cpu_start) / 60,
        "executions": counter.value,
    }
    files = [path for path in sorted((folder / "findings").iterdir()) if path.suffix != ".txt"]
    findings = [path.name for path in files if in_child(lambda path=path: replay(target, path), log)]
    corpus = [path.stat().st_size for path in (folder / "corpus").iterdir()]
    return {
        **spent,
        "corpus_files": len(corpus),
        "corpus_bytes": sum(corpus),
        "findings": findings,
    }


def children_cpu_s() -> float:
    """What the children that have ended took of the processor, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def added(earlier: dict[str, Any] | None, report: dict[str, Any]) -> dict[str, Any]:
    """Minutes and executions of both; the rest of the later."""
    if earlier is None:
        return report
    return report | {name: earlier[name] + report[name] for name in ("minutes", "cpu_minutes", "executions")}


def main() -> None:
    """Fuzzes the readers one after the other; ends with 1 where there are findings."""
    options = common.parser("Fuzzing of every reader of jaxbox.io.", preset=False)
    options.add_argument("--reader", action="append", choices=list(TARGETS), help="only this; repeatable")
    options.add_argument("--minutes", type=float, default=MINUTES, help="for each reader")
    options.add_argument(
        "--folder", type=pathlib.Path, default=pathlib.Path("fuzz"), help="corpus and findings"
    )
    chosen = options.parse_args()
    readers = {}
    if chosen.json and chosen.json.is_file():
        readers = json.loads(chosen.json.read_text("utf-8"))["readers"]
    found = 0
    for name in chosen.reader or TARGETS:
        report = fuzz_reader(name, 60 * chosen.minutes, chosen.folder / name)
        found += len(report["findings"])
        readers[name] = added(readers.get(name), report)
        print(f"{name}: {report}", flush=True)
        # The report asks JAX for its devices, after which this process could not be forked.
        in_child(lambda: common.write_report({"limits": limits(), "readers": readers}, chosen), os.devnull)
    sys.exit(int(found > 0))


def limits() -> dict[str, int]:
    """What a reader was held to."""
    return {"memory_bytes": MEMORY_BYTES, "seconds": TIME_LIMIT_S, "file_bytes": MAX_FILE_BYTES}


if __name__ == "__main__":
    main()
