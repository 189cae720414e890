"""The file that says which drive each frame is of."""

import pytest

from jaxbox.io import InputError, find_drives, read_drives


def write(folder, text):
    path = folder / "drives.txt"
    path.write_text(text)
    return path


def test_each_frame_gets_its_drive_in_the_order_asked_for(tmp_path):
    path = write(tmp_path, "# of the object benchmark\n\n000001 a 17\n000002\tb  # a note\n000003 a\n")
    assert list(read_drives(path, ["000003", "000002"]).items()) == [("000003", "a"), ("000002", "b")]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("000001 a\n000002\n", "line 2: 1 words"),
        ("000001 a 7 b\n", "line 1: 4 words"),
        (
            "000001 a\n\n000001 a\n",
            r"line 3: frame 000001 has a drive already, by .*drives\.txt, line 1; remove",
        ),
        ("000009 a\n", "no drive for 2 of 2 frames, the first is 000001"),
    ],
)
def test_a_bad_file_is_named_with_its_line_or_frame(tmp_path, text, expected):
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=expected) as error:
        read_drives(path, ["000001", "000002"])
    assert str(path) in str(error.value)


def test_several_files_are_one_table(tmp_path):
    for name, text in (("one", "000001 a\n"), ("two", "000002 b\n")):
        (tmp_path / name).mkdir()
        write(tmp_path / name, text)
    files = [find_drives(tmp_path / name) for name in ("one", "two")]
    assert read_drives(files, ["000001", "000002"]) == {"000001": "a", "000002": "b"}
    write(tmp_path / "two", "000001 b\n")
    twice = f"{files[1]}, line 1: frame 000001 has a drive already, by {files[0]}, line 1; remove one"
    with pytest.raises(InputError, match=twice):
        read_drives(files, ["000001"])
    assert read_drives([files[1], str(files[1])], ["000001"]) == {"000001": "b"}


def test_the_file_is_found_in_the_folder_or_beside_it(tmp_path):
    (tmp_path / "training" / "velodyne").mkdir(parents=True)
    assert find_drives(tmp_path / "training") is None
    path = write(tmp_path, "000001 a\n")
    assert find_drives(tmp_path) == find_drives(tmp_path / "training") == path
    assert find_drives(tmp_path / "training" / "velodyne") is None


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_drives(tmp_path / "none.txt", [])
