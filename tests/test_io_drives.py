"""The file that says which drive each frame is of."""

import pytest

from jaxbox.io import InputError, read_drives


def write(folder, text):
    path = folder / "drives.txt"
    path.write_text(text)
    return path


def test_each_frame_gets_its_drive_in_the_order_asked_for(tmp_path):
    path = write(tmp_path, "# of the object benchmark\n\n000001 a\n000002\tb  # a note\n000003 a\n")
    assert list(read_drives(path, ["000003", "000002"]).items()) == [("000003", "a"), ("000002", "b")]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("000001 a\n000002\n", "line 2: 1 words"),
        ("000001 a b\n", "line 1: 3 words"),
        ("000001 a\n\n000001 a\n", "line 3: frame 000001 stands there twice"),
        ("000009 a\n", "no drive for 2 of 2 frames, the first is 000001"),
    ],
)
def test_a_bad_file_is_named_with_its_line_or_frame(tmp_path, text, expected):
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=expected) as error:
        read_drives(path, ["000001", "000002"])
    assert str(path) in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_drives(tmp_path / "none.txt", [])
