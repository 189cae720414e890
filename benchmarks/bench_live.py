"""How long from a sweep's last packet to its boxes, and does an hour of `jaxbox live` grow?

    python -m benchmarks.bench_live [--seconds 30] [--quick] [--json FILE]
    python -m benchmarks.bench_live --minutes 60 [--json FILE]

The command line runs in a process of its own, on a drive of KITTI at ten sweeps a second: from its files,
and as packets of Velodyne sensors over the loopback interface, which another process sends. With
``--minutes`` its resident memory is read once a minute, and the sensor stops for some seconds every ten.
"""

import argparse
import collections
import contextlib
import importlib
import itertools
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks import common
from benchmarks.bench_memory import resident_mb
from jaxbox import io

DRIVE = "kitti_tracking/training/velodyne/0000"
"""Sweeps of one street, which are sent there and back again."""
SENSORS = {"vlp16": "VLP16", "hdl32e": "HDL32E"}
"""Sensors whose packets are made, by their names in `tests/lidar_packets.py`."""
CAPACITIES = {"files": 2**17, "hdl32e": 2**16, "vlp16": 2**15}
"""Points that the sweeps of each source are padded to."""
POSES = ("kiss-icp", "boxes", "none")
SECONDS, QUICK_SECONDS = 30.0, 5.0
WARM_UP = 10
"""Sweeps at the beginning that no figure is of."""
SENDING_S, SILENT_S = 600.0, 5.0
"""In a long run the sensor sends and is silent by turns."""
SETTLED_SHARE = 0.2
"""Growth is counted from this share of a long run on: pools fill up before."""
_TURN_S = 0.1
_BURST = 8
"""Packets that are sent together: sleeping is no finer."""


def send(sensor: str, port: int) -> None:
    """Sends the drive as packets, ten turns a second, until the process is ended."""
    # They are made where the tests have them made.
    sys.path.insert(0, str(common.PROJECT / "tests"))
    packets: Any = importlib.import_module("lidar_packets")
    model = getattr(packets, SENSORS[sensor])
    sweeps = io.open_sweeps(common.data_folder("kitti_tracking").parent / DRIVE)
    turns = [[packet for _, packet in packets.sweep_packets(model, *sweep.read_points())] for sweep in sweeps]
    start_s = time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outgoing:
        for number, turn in enumerate(itertools.cycle([*turns, *turns[-2:0:-1]])):
            for index, packet in enumerate(turn):
                due_s = start_s + _TURN_S * (number + index / len(turn))
                if index % _BURST == 0 and (left_s := due_s - time.monotonic()) > 0:
                    time.sleep(left_s)
                outgoing.sendto(packet, ("127.0.0.1", port))


@contextlib.contextmanager
def sending(source: str, port: int) -> Iterator[None]:
    """A process that sends, while the block runs; none where the source are files."""
    if source == "files":
        yield
        return
    command = [sys.executable, "-m", "benchmarks.bench_live", "--send", source, "--port", str(port)]
    process = subprocess.Popen(command, cwd=common.PROJECT)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


class LiveProcess:
    """`jaxbox live`, whose lines are read as they come: a context."""

    def __init__(self, source: str, port: int, *options: str) -> None:
        """Names what is run; nothing is begun."""
        where = f"udp://127.0.0.1:{port}"
        if source == "files":
            where = str(common.data_folder("kitti_tracking").parent / DRIVE)
        self._command = [
            *(sys.executable, "-m", "jaxbox", "live", where, "--json", "--loop", *options),
            *("--capacity", str(CAPACITIES[source])),
        ]
        self.latencies_ms: collections.deque[float] = collections.deque()
        """Of the sweeps since somebody took them."""
        self.last: dict[str, Any] = {}
        """The last line."""

    def __enter__(self) -> "LiveProcess":
        """Starts it."""
        environment = os.environ | {"PYTHONUNBUFFERED": "1"}
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, text=True, env=environment, cwd=common.PROJECT
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Ends it, as Ctrl-C does, which is not heard where this program is in the background."""
        self._process.terminate()
        self._process.wait()
        self._reader.join()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def check(self) -> None:
        """Ends the benchmark where the process has ended by itself."""
        if self._process.poll() is not None:
            raise SystemExit(f"jaxbox live ended with exit code {self._process.returncode}")

    def take(self) -> list[float]:
        """The latencies since they were last taken, ms."""
        return [self.latencies_ms.popleft() for _ in range(len(self.latencies_ms))]

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            record = json.loads(line)
            if "latency_ms" in record:
                self.latencies_ms.append(record["latency_ms"])
                record.pop("boxes")
            self.last = record


def measure(source: str, options: Sequence[str], seconds: float) -> dict[str, Any]:
    """Latencies of one source for so long, after the detector is compiled."""
    port = free_port()
    with LiveProcess(source, port, *options) as process, sending(source, port):
        while len(process.latencies_ms) < WARM_UP:
            process.check()
            time.sleep(_TURN_S)
        process.take()
        before = process.last["num_skipped"]
        time.sleep(seconds)
        process.check()
        latencies, skipped = process.take(), process.last["num_skipped"] - before
    return common.spread(latencies) | {"max": max(latencies), "skipped": skipped}


def endure(source: str, minutes: float) -> dict[str, Any]:
    """Memory and latencies minute by minute, of a sensor that stops now and then."""
    port, samples, stops = free_port(), [], 0
    with LiveProcess(source, port, "--foxglove", "--foxglove-port", "0") as process:
        end_s = time.monotonic() + 60 * minutes
        while time.monotonic() < end_s:
            with sending(source, port):
                until_s = min(time.monotonic() + SENDING_S, end_s)
                while (left_s := until_s - time.monotonic()) > 0:
                    time.sleep(min(60.0, left_s))
                    process.check()
                    samples.append(_sample(process, len(samples)))
                    print(samples[-1], flush=True)
            if time.monotonic() < end_s:
                stops += 1
                time.sleep(SILENT_S)
    memory = np.array([sample["resident_mb"] for sample in samples])
    settled = slice(int(SETTLED_SHARE * len(memory)), None)
    slope = np.polyfit(np.arange(len(memory))[settled], memory[settled], 1)[0] if len(memory) > 4 else 0.0
    return {
        "source": source,
        "minutes": minutes,
        "stops": stops,
        "growth_mb_per_hour": float(60 * slope),
        "peak_mb": max(sample["peak_mb"] for sample in samples),
        "samples": samples,
        "summary": process.last.get("summary"),
    }


def _sample(process: LiveProcess, minute: int) -> dict[str, Any]:
    latencies = process.take()
    now_mb, peak_mb = resident_mb(process.pid) or (float("nan"), float("nan"))
    return {
        "minute": minute + 1,
        "resident_mb": round(now_mb, 1),
        "peak_mb": round(peak_mb, 1),
        "sweeps": len(latencies),
        "skipped": process.last.get("num_skipped", 0),
        "p50_ms": round(float(np.percentile(latencies, 50)), 1) if latencies else None,
        "p99_ms": round(float(np.percentile(latencies, 99)), 1) if latencies else None,
    }


def free_port() -> int:
    """A UDP port that nobody listens at."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def rows(seconds: float) -> Iterator[dict[str, Any]]:
    """Every source, with the poses of each kind and without tracks."""
    for source in CAPACITIES:
        for poses in POSES:
            yield {"source": source, "poses": poses} | measure(source, ("--poses", poses), seconds)
        yield {"source": source, "poses": "no tracks"} | measure(source, ("--no-track",), seconds)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the figures and writes the report."""
    parser = common.parser(__doc__ or "", preset=False, quick=f"{QUICK_SECONDS:g} s each")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each source")
    parser.add_argument("--minutes", type=float, help="one long run instead")
    parser.add_argument("--source", choices=[*SENSORS, "files"], default="hdl32e", help="of the long run")
    parser.add_argument("--send", choices=list(SENSORS), help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.send:
        send(options.send, options.port)
        return
    if options.minutes:
        common.write_report(endure(options.source, options.minutes), options)
        return
    found = []
    for row in rows(QUICK_SECONDS if options.quick else options.seconds):
        found.append(row)
        print(row, flush=True)
    header = ["source", "poses", "median", "p90", "p99", "max", "runs", "skipped"]
    common.print_table(header, [[row[name] for name in header] for row in found])
    common.write_report({"rows": found}, options)


if __name__ == "__main__":
    main()
