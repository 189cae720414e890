"""Every reader on its own library's files, on changed copies of them, and on what the fuzzer once found."""

import importlib
import pathlib
import sys
import zlib

import numpy as np
import pytest

from jaxbox import io

PROJECT = pathlib.Path(__file__).parents[1]
sys.path.insert(0, str(PROJECT))
fuzz_targets = importlib.import_module("quality.fuzz_targets")
sys.path.remove(str(PROJECT))

TARGETS = fuzz_targets.TARGETS
COPIES = 25
"""Changed copies a reader; `python -m quality.fuzz_readers` makes as many as there is time for."""
CORPUS = pathlib.Path(__file__).parent / "corpus"
FOUND = sorted(path for path in CORPUS.glob("*/*"))


@pytest.mark.parametrize("name", TARGETS)
def test_the_seeds_are_read_and_changed_copies_are_read_or_refused(tmp_path, name):
    target = TARGETS[name]
    seeds = list(target.seeds().values())
    with fuzz_targets.prepared(target, tmp_path) as read:
        assert all(read(data) for data in seeds)
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        for index in range(COPIES):
            read(fuzz_targets.mutated(seeds[index % len(seeds)], rng))


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_the_fuzzer_found_is_read_or_refused(tmp_path, path):
    with fuzz_targets.prepared(TARGETS[path.parent.name], tmp_path) as read:
        # Any other error than that of bad input, and any warning, is raised.
        assert read(path.read_bytes()) in (True, False)


def test_the_corpus_belongs_to_readers_that_there_are():
    assert {path.parent.name for path in FOUND} <= TARGETS.keys()
    assert len(FOUND) >= 10


def test_every_format_and_result_that_is_read_back_is_fuzzed():
    suffixes = {"".join(pathlib.Path(target.file_name).suffixes) for target in TARGETS.values()}
    one_reader = {".csv": ".xyz", ".txt": ".xyz"}
    # Its library is in no environment with the others, and may end the process: docs/formats.md.
    recordings = [suffix for suffix in io.RECORDING_SUFFIXES if suffix != ".osf"]
    for suffix in (*io.POINT_SUFFIXES, *recordings, ".toml", ".jsonl", ".parquet"):
        assert one_reader.get(suffix, suffix) in suffixes
