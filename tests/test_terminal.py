"""What is printed and where pictures go: no name of a file acts on the terminal, no link leads elsewhere."""

import io

import pytest
import typer
from rich.console import Console
from test_cli import make_small_sweep, run, write_points

from jaxbox.cli import console
from jaxbox.cli.report import make_table

EVIL = "a\x1b]0;owned\x07\x1b[31m\nerror: b\r\x9b2J\u202e"


def unprintable(text):
    return {c for line in text.split("\n") for c in line if not c.isprintable()}


def test_names_with_escape_sequences_and_newlines_are_printed_escaped(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / f"broken{EVIL}.bin").write_bytes(b"1234567")
    write_points(tmp_path / "in" / f"whole{EVIL}.bin", make_small_sweep(0))
    result = run("detect", tmp_path / "in", "--output", tmp_path / "out", "--no-pictures")
    assert result.exit_code == 1
    for text in (result.stdout, result.stderr):
        assert unprintable(text) == set()
        assert not [line for line in text.splitlines() if line.startswith("error: b")]
    assert r"sweep brokena\x1b]0;owned\x07\x1b[31m\nerror: b\r\x9b2J\u202e" in result.stderr
    assert r"wholea\x1b]0;owned\x07" in result.stdout
    missing = run("detect", tmp_path / f"gone{EVIL}", "--output", tmp_path / "out")
    assert unprintable(missing.stderr) == set()
    assert missing.stderr.count("\n") == 1


def test_a_name_that_is_no_text_is_printed_all_the_same(capsys):
    console.print_error("sweep a\udcff.bin: broken")
    assert capsys.readouterr().err == "error: sweep a\\udcff.bin: broken\n"


def test_cells_of_tables_are_escaped():
    stream = io.StringIO()
    Console(file=stream, width=200).print(make_table("t", ["name", "n"], [[EVIL, "1"]]))
    assert unprintable(stream.getvalue()) == set()
    assert r"\x1b]0;owned" in stream.getvalue()


@pytest.mark.parametrize("command", ["detect", "track"])
def test_a_link_for_the_folder_of_pictures_is_refused_and_nothing_is_written_through_it(tmp_path, command):
    write_points(tmp_path / "in" / "0.bin", make_small_sweep(0))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / ".jaxbox-keep").write_text("keep me")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "pictures").symlink_to(elsewhere)
    result = run(command, tmp_path / "in", "--output", tmp_path / "out", "--pictures")
    assert result.exit_code == 2, result.output
    assert "out/pictures: a link, and pictures are not written through one; remove it" in result.stderr
    assert [path.name for path in elsewhere.iterdir()] == [".jaxbox-keep"]


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 2576123 bytes.")]
)
def test_a_lack_of_memory_is_one_line_and_other_errors_of_jax_stay_errors(error, capsys):
    with pytest.raises(typer.Exit) as end, console.input_errors():
        raise error
    assert end.value.exit_code == console.ExitCode.BAD_INPUT
    assert capsys.readouterr().err.startswith("error: there is not enough memory (")
    with pytest.raises(RuntimeError, match="INTERNAL"), console.input_errors():
        raise RuntimeError("INTERNAL: no memory is short")
