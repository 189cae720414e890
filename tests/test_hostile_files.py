"""Files made to hang a reader, fill the memory or lead out of the output folder: refused at once, by name."""

import bz2
import contextlib
import io as bytes_io
import json
import os
import pathlib
import sqlite3
import struct
import subprocess
import sys
import zipfile
import zlib

import laspy
import lz4.frame
import numpy as np
import pyarrow as pa
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from pyarrow import feather
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.reader import zstd
from test_io_formats import (
    CLOUD,
    PCD_HEADER,
    PLY_HEADER,
    PLY_XYZ,
    STORES,
    TIMES,
    make_message,
    write_bag2,
    write_las,
    write_mcap,
)

from jaxbox import io
from jaxbox.io import _unpack, images

TRILLION = 10**12
GIB = 2**30


# --- files that claim or unpack to more than there is -----------------------------------------------


def write_huge_las(path):
    write_las(path)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 107, 2**32 - 1)
    path.write_bytes(data)


def write_laz_bomb(path):
    """Few bytes of points that are all the same, and a count that is just below the limit of points."""
    las = laspy.LasData(laspy.LasHeader(point_format=10, version="1.4"))
    las.x = np.zeros(50_000)
    las.write(path)
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, 247, 2**24)
    path.write_bytes(data)


def write_npy_header(file, shape, kind="<f4"):
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})


def write_huge_npy(path):
    with path.open("wb") as file:
        write_npy_header(file, (TRILLION, 4))


def write_npz_bomb(path):
    """More than a gigabyte of zeros in few megabytes: packed once, said many times."""
    header, packer = bytes_io.BytesIO(), zlib.compressobj(wbits=-15)
    write_npy_header(header, (2**26 + 2**20, 4))
    first = packer.compress(header.getvalue()) + packer.flush(zlib.Z_FULL_FLUSH)
    zeros = packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", first + 65 * zeros + packer.flush())
    data, size = bytearray(path.read_bytes()), len(header.getvalue()) + 65 * 2**24
    # In the member's own header and in the archive's list: deflated, and to how much.
    for place, method in ((0, 8), (data.index(b"PK\1\2"), 10)):
        struct.pack_into("<H", data, place + method, zipfile.ZIP_DEFLATED)
        struct.pack_into("<I", data, place + method + 14, size)
    path.write_bytes(data)


def write_npz_claim(path):
    with zipfile.ZipFile(path, "w") as archive:
        member = bytes_io.BytesIO()
        write_npy_header(member, (TRILLION, 4))
        archive.writestr("a.npy", member.getvalue())


def write_feather_bomb(path, compression):
    """A column whose bytes are few, and are said to unpack to a terabyte."""
    table = pa.table({name: np.zeros(2**16, np.float32) for name in "xyz"})
    feather.write_feather(table, path, compression=compression)
    data = path.read_bytes()
    size = struct.pack("<q", 2**18)
    assert data.count(size) >= 3, "the size stands before each buffer"
    path.write_bytes(data.replace(size, struct.pack("<q", TRILLION)))


def write_mcap_bomb(path, compression, indexed=True):
    """One chunk of zeros, far longer than any message."""
    with path.open("wb") as file:
        writer = McapWriter(
            file, compression=compression, use_statistics=indexed, use_summary_offsets=indexed
        )
        writer.start()
        schema = writer.register_schema(CLOUD, "ros2msg", b"")
        channel = writer.register_channel("/points", "cdr", schema)
        writer.add_message(channel, TIMES[0], bytes(_unpack.MAX_CHUNK_BYTES + 1), TIMES[0])
        writer.finish()


def write_bag_bomb(path, compression):
    writer = rosbag1.Writer(path)
    writer.set_compression(compression)
    with writer:
        connection = writer.add_connection("/points", CLOUD, typestore=STORES[1])
        writer.write(connection, TIMES[0], bytes(_unpack.MAX_CHUNK_BYTES + 1))


def write_bag2_bomb(path, mode):
    writer = rosbag2.Writer(path, version=9)
    writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/points", CLOUD, typestore=STORES[2])
        writer.write(connection, TIMES[0], bytes(_unpack.MAX_CHUNK_BYTES + 1))


def write_image_bomb(path):
    """A picture's head that claims 2**31 pixels."""
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 2**16, 2**15, 8, 2, 0, 0, 0)
    path.write_bytes(head + bytes(64))


def write_sparse(path):
    """A terabyte that takes no room on the disk."""
    with path.open("wb") as file:
        file.truncate(2**40)


CHUNKS = rosbag1.Writer.CompressionFormat
BOMBS = {
    "huge.pcd": lambda p: p.write_text(PCD_HEADER.format(n=TRILLION, data="binary")),
    "ascii.pcd": lambda p: p.write_text(PCD_HEADER.format(n=TRILLION, data="ascii") + "1 2 3\n"),
    "packed.pcd": lambda p: p.write_bytes(
        PCD_HEADER.format(n=2**24, data="binary_compressed").encode()
        + struct.pack("<II", 64, 12 * 2**24)
        + bytes(64)
    ),
    "fields.pcd": lambda p: p.write_text(
        PCD_HEADER.format(n=1, data="binary").replace("TYPE", "COUNT 1 1 1000000000\nTYPE")
    ),
    "huge.ply": lambda p: p.write_text(
        PLY_HEADER.format(data="binary_little_endian", n=TRILLION, fields=PLY_XYZ)
    ),
    "huge.las": write_huge_las,
    "bomb.laz": write_laz_bomb,
    "huge.npy": write_huge_npy,
    "bomb.npz": write_npz_bomb,
    "huge.npz": write_npz_claim,
    "lz4.feather": lambda p: write_feather_bomb(p, "lz4"),
    "zstd.feather": lambda p: write_feather_bomb(p, "zstd"),
    "lz4.mcap": lambda p: write_mcap_bomb(p, CompressionType.LZ4),
    "zstd.mcap": lambda p: write_mcap_bomb(p, CompressionType.ZSTD),
    "scanned.mcap": lambda p: write_mcap_bomb(p, CompressionType.ZSTD, indexed=False),
    "bz2.bag": lambda p: write_bag_bomb(p, CHUNKS.BZ2),
    "lz4.bag": lambda p: write_bag_bomb(p, CHUNKS.LZ4),
    "messages_db3": lambda p: write_bag2_bomb(p, rosbag2.CompressionMode.MESSAGE),
    "files_db3": lambda p: write_bag2_bomb(p, rosbag2.CompressionMode.FILE),
    "sparse.bin": write_sparse,
    "sparse.pcd.bin": write_sparse,
    "sparse.xyz": write_sparse,
    "sparse.pcd": write_sparse,
    "sparse.feather": write_sparse,
    "sparse.npy": write_sparse,
    "sparse.laz": write_sparse,
    "sparse.mcap": write_sparse,
}

# Each in one process that may take so much beyond what the libraries take.
MEMORY_BYTES = GIB
SECONDS = 10
READ_ALL = f"""
import pathlib, resource, sys, time
from jaxbox import io
from jaxbox.io import images
for name in ("laspy", "lazrs", "pyarrow", "pypcd4", "mcap.reader", "rosbags.rosbag1", "rosbags.rosbag2"):
    __import__(name)
io.read_points(sys.argv[2])  # whatever a reader imports late
pages = int(pathlib.Path("/proc/self/statm").read_text().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + {MEMORY_BYTES},) * 2)
for path in sorted(pathlib.Path(sys.argv[1]).iterdir()):
    start = time.process_time()
    try:
        images.read_image(path) if path.suffix == ".png" else [s.read_points() for s in io.open_sweeps(path)]
        answer = "read"
    except io.InputError as error:
        answer = f"refused {{error}}"
    except BaseException as error:
        answer = f"{{type(error).__name__}} {{error}}"
    print(path.name, round(time.process_time() - start, 2), answer.replace(chr(10), " "), sep="\\t")
"""


def test_files_that_claim_or_unpack_to_too_much_are_refused_within_time_and_memory(tmp_path):
    folder, good = tmp_path / "bombs", tmp_path / "good.laz"
    folder.mkdir()
    for name, write in BOMBS.items():
        write(folder / name)
    write_image_bomb(folder / "bomb.png")
    write_las(good)
    packed = sum(file.stat().st_blocks * 512 for file in folder.rglob("*") if file.is_file())
    assert packed < 2**23, "the files themselves are small"
    command = [sys.executable, "-c", READ_ALL, folder, good]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    answers = {line.split("\t")[0]: line.split("\t")[1:] for line in done.stdout.splitlines()}
    assert answers.keys() == {*BOMBS, "bomb.png"}, done.stderr[-2000:]
    assert {name: answer for name, (_, answer) in answers.items() if not answer.startswith("refused")} == {}
    assert {name: seconds for name, (seconds, _) in answers.items() if float(seconds) > SECONDS} == {}
    assert all(name.split(".")[0] in answer for name, (_, answer) in answers.items()), "each is named"


def test_what_is_unpacked_ends_at_the_bound(monkeypatch):
    monkeypatch.setattr(_unpack, "MAX_CHUNK_BYTES", 2**20)
    data = bytes(2**20)
    packers = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstd.compress, "none": bytes}
    for name, pack in packers.items():
        assert _unpack.unpack(pack(data), name, "here") == data
    for name in ("bz2", "lz4", "zstd"):
        with pytest.raises(io.InputError, match=r"here: \d+ bytes unpack to more than 1048576"):
            _unpack.unpack(packers[name](data + b"1"), name, "here")
    with pytest.raises(io.InputError, match="here: the compression 'xz' is not known"):
        _unpack.unpack(data, "xz", "here")


def test_what_is_within_the_bounds_is_read(tmp_path):
    for mode in ("MESSAGE", "FILE"):
        writer = rosbag2.Writer(tmp_path / mode, version=9)
        writer.set_compression(getattr(rosbag2.CompressionMode, mode), rosbag2.CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/points", CLOUD, typestore=STORES[2])
            writer.write(connection, TIMES[0], STORES[2].serialize_cdr(make_message(), CLOUD))
        assert [len(sweep.read_points()[0]) for sweep in io.open_sweeps(tmp_path / mode)] == [3]
    for compression in ("lz4", "zstd", "uncompressed"):
        table = pa.table({name: pa.array(np.arange(9.0)).dictionary_encode() for name in "xyz"})
        feather.write_feather(table, tmp_path / "a.feather", compression=compression)
        assert len(io.read_points(tmp_path / "a.feather")[0]) == 9


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_size_of_a_picture_is_read_from_its_head(tmp_path, suffix, monkeypatch):
    picture = np.zeros((6, 8, 3), np.uint8)
    images.cv2.imwrite(str(tmp_path / f"a{suffix}"), picture)
    assert io.read_image(tmp_path / f"a{suffix}").shape == (6, 8, 3)
    monkeypatch.setattr(images.cv2, "imdecode", None)
    assert images.read_image_size(tmp_path / f"a{suffix}") == (8, 6)
    monkeypatch.setattr(images, "MAX_PIXELS", 47)
    for read in (io.read_image, images.read_image_size):
        with pytest.raises(io.InputError, match="it claims 8 x 6 pixels; at most 47"):
            read(tmp_path / f"a{suffix}")


def test_pickled_arrays_are_refused_and_never_run(tmp_path):
    class Opens:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "run"),)

    np.save(tmp_path / "a.npy", np.array([Opens()], object), allow_pickle=True)
    np.savez(tmp_path / "a.npz", np.array([Opens()], object))
    (tmp_path / "b.npy").write_bytes((tmp_path / "a.npz").read_bytes())
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npy").read_bytes())
    for name in ("a.npy", "a.npz", "b.npy", "b.npz"):
        with pytest.raises(io.InputError, match=f"{name}: no readable"):
            io.read_points(tmp_path / name)
    assert not (tmp_path / "run").exists()


# --- what is not a file, and names that lead elsewhere ---------------------------------------------------


def test_pipes_devices_and_broken_links_are_refused_by_every_reader(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    (tmp_path / "nowhere").symlink_to(tmp_path / "missing")
    (tmp_path / "round").symlink_to(tmp_path / "round")
    (tmp_path / "folder").mkdir()
    for suffix in (*io.POINT_SUFFIXES, *io.RECORDING_SUFFIXES):
        for kind, message in {
            "pipe": "no plain file",
            "zeros": "no plain file",
            "nowhere": "there is no such file",
            "round": "no such file|cannot be read",
        }.items():
            path = tmp_path / f"{kind}{suffix}"
            path.symlink_to(tmp_path / kind)
            with pytest.raises(io.InputError, match=message):
                io.open_sweeps(path)[0].read_points()
            if suffix in io.POINT_SUFFIXES:
                with pytest.raises(io.InputError, match=message):
                    io.read_points(path)
    for read in (
        io.read_labels, io.read_calibration, io.read_config, io.read_image, io.read_jsonl,
        io.read_argoverse2_boxes, io.read_pandaset_boxes, io.read_semantic_labels,
        io.read_pose_file, io.read_oxts,
    ):  # fmt: skip
        with pytest.raises(io.InputError, match="no plain file"):
            read(tmp_path / "pipe")
    with pytest.raises(io.InputError, match="no plain file"):
        io.read_points(tmp_path / "folder" / ".." / "pipe.bin")


def test_a_pipe_in_the_place_of_a_bags_storage_is_refused(tmp_path):
    for storage, suffix in (("SQLITE3", ".db3"), ("MCAP", ".mcap")):
        folder = tmp_path / storage
        write_bag2(folder, ["/points"], storage)
        (folder / f"{storage}{suffix}").unlink()
        os.mkfifo(folder / f"{storage}{suffix}")
        with pytest.raises(io.InputError, match="no plain file"):
            io.open_sweeps(folder)


def test_a_database_with_a_query_in_the_place_of_a_table_is_refused(tmp_path):
    write_bag2(tmp_path / "bag", ["/points"], "SQLITE3")
    file = tmp_path / "bag" / "bag.db3"
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.execute("DROP TABLE messages")
        database.execute(
            f"CREATE VIEW messages AS {endless} SELECT i id, 1 topic_id, i timestamp, '' data FROM n"
        )
        database.commit()
    for path in (file, file.parent):
        with pytest.raises(io.InputError, match=r"bag\.db3: 'messages' is not a plain table"):
            io.open_sweeps(path)


def test_metadata_that_names_files_elsewhere_does_not_lead_there(tmp_path):
    write_bag2(tmp_path / "private", ["/secret"], "SQLITE3")
    write_bag2(tmp_path / "given", ["/points"], "SQLITE3")
    metadata = tmp_path / "given" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("given.db3", "../private/private.db3"))
    with pytest.raises(io.InputError, match="given: the bag cannot be read"):
        io.open_sweeps(tmp_path / "given")


@pytest.mark.parametrize("name", ["../../x", "/etc/x", "a/b", "..", ".", "", "a\0b"])
def test_no_sweep_has_a_name_that_leads_out_of_the_output_folder(name):
    with pytest.raises(io.InputError, match="a name without folders"):
        io.Sweep(name, pathlib.Path("a.bin"))


def test_names_and_times_that_no_result_can_hold_are_made_to_fit(tmp_path):
    odd = os.fsdecode(os.fsencode(tmp_path) + b"/\xff\x1b.bin")
    pathlib.Path(odd).write_bytes(b"")
    np.save(tmp_path / "n__LIDAR_TOP__99999999999999999999.npy", np.zeros((1, 4)))
    (sweep,) = io.open_sweeps(odd)
    assert sweep.name.encode() == b"\\xff\x1b"
    far = tmp_path / "99999999999999999999.feather"
    feather.write_feather(pa.table({name: np.zeros(1) for name in "xyz"}), far)
    assert io.open_sweeps(far)[0].timestamp_ns is None
    late = 2**64 - 1
    write_late_mcap(tmp_path / "late.mcap", late)
    assert [sweep.timestamp_ns for sweep in io.open_sweeps(tmp_path / "late.mcap")] == [None]


def write_late_mcap(path, time):
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(CLOUD, "ros2msg", b"")
        channel = writer.register_channel("/points", "cdr", schema)
        writer.add_message(channel, time, bytes(STORES[2].serialize_cdr(make_message(), CLOUD)), time)
        writer.finish()


def test_an_mcap_index_that_names_one_chunk_again_and_again_is_refused(tmp_path):
    write_mcap(tmp_path / "a.mcap", ["/points"])
    data = (tmp_path / "a.mcap").read_bytes()
    # The index of the only chunk, twice.
    footer = len(data) - 8 - 29
    (summary,) = struct.unpack_from("<Q", data, footer + 9)
    place = summary
    while data[place] != 8:
        place += 9 + struct.unpack_from("<Q", data, place + 1)[0]
    size = 9 + struct.unpack_from("<Q", data, place + 1)[0]
    (tmp_path / "a.mcap").write_bytes(data[:place] + data[place : place + size] + data[place:])
    with pytest.raises(io.InputError, match="names a chunk twice"):
        list(io.open_sweeps(tmp_path / "a.mcap"))


def test_a_link_in_the_output_folder_is_replaced_and_what_it_points_to_is_left(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("keep me")
    output = tmp_path / "out"
    output.mkdir()
    for name in ("a.txt", "detections.jsonl"):
        (output / name).symlink_to(precious)
    io.write_labels(output / "a.txt", [])
    io.write_jsonl(output / "detections.jsonl", [{"name": "a"}])
    assert precious.read_text() == "keep me"
    assert not any((output / name).is_symlink() for name in ("a.txt", "detections.jsonl"))


def test_json_without_end_is_an_input_error(tmp_path):
    deep = "[" * 100_000
    (tmp_path / "a.json").write_text(deep)
    (tmp_path / "a.jsonl").write_text(f"{deep}\n")
    (tmp_path / "digits.json").write_text("9" * 5000)
    (tmp_path / "a.toml").write_text(f"a = {deep}")
    (tmp_path / "huge.json").write_text(json.dumps([{"category": "BUS", "tx_m": 10**400}]))
    for read, name in (
        (io.read_argoverse2_boxes, "a.json"),
        (io.read_argoverse2_boxes, "digits.json"),
        (io.read_argoverse2_boxes, "huge.json"),
        (io.read_config, "a.json"),
        (io.read_config, "a.toml"),
        (io.read_jsonl, "a.jsonl"),
    ):
        with pytest.raises(io.InputError, match=name):
            read(tmp_path / name)
