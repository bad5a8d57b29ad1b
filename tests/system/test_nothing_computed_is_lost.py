"""Results are delivered whatever fails: files in another place, escapes for letters, a message."""

import io
import os
import subprocess
import sys
import tempfile

import pytest

from pathjax import __main__ as program
from pathjax.errors import InputError
from pathjax.system.output import Output


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """The requested folder of the file, the current folder, and the folder for temporary files."""
    folders = [tmp_path / name for name in ("asked", "here", "temporary")]
    for folder in folders:
        folder.mkdir()
    monkeypatch.chdir(folders[1])
    monkeypatch.setattr(tempfile, "tempdir", str(folders[2]))
    return folders


def writer(*full):
    """Return a `write` that finds the given folders, and folders in them, full."""

    def write(path):
        if any(folder in path.parents for folder in full):
            raise InputError(f"{path}: cannot be written: No space left on device")
        path.write_text("whole")

    return write


def test_a_file_goes_where_it_was_asked_for(folders, capsys):
    output = Output()
    assert output.file(folders[0] / "a.txt", writer()) == folders[0] / "a.txt"
    assert not output.failed and capsys.readouterr().err == ""


def test_else_it_goes_to_the_current_folder_under_a_new_name(folders, capsys):
    asked, here, _ = folders
    (here / "a.txt").write_text("old")
    (here / "a-1.txt").write_text("old")
    output = Output()
    assert output.file(asked / "a.txt", writer(asked)) == here / "a-2.txt"
    assert output.failed
    reason = f"pathjax: {asked}/a.txt: cannot be written: No space left on device"
    assert capsys.readouterr().err == f"{reason}; {here}/a-2.txt was written instead\n"
    assert (here / "a.txt").read_text() == "old"
    # The same file, written again, replaces the earlier one, or goes to the requested place once that works.
    assert output.file(asked / "a.txt", writer(asked)) == here / "a-2.txt"
    assert output.file(asked / "a.txt", writer()) == asked / "a.txt"


@pytest.mark.parametrize("gone", [False, True])
def test_else_it_goes_to_the_folder_for_temporary_files(folders, capsys, gone):
    asked, here, temporary = folders
    if gone:
        here.rmdir()
    place = Output().file(asked / "a.txt", writer(asked, here))
    assert temporary in place.parents and place.read_text() == "whole"
    assert f"{place} was written instead" in capsys.readouterr().err


def test_what_fits_nowhere_is_said_to_be_lost(folders, capsys):
    output = Output()
    assert output.file(folders[0] / "a.txt", writer(*folders)) is None
    message = capsys.readouterr().err
    assert output.failed and "it is lost" in message
    assert all(str(folder) in message for folder in folders)
    assert not any(file for folder in folders for file in folder.iterdir())


def test_other_errors_than_those_of_the_disk_cost_no_file(folders):
    def write(path):
        if path.parent == folders[0]:
            raise MemoryError
        path.write_text("whole")

    assert Output().file(folders[0] / "a.txt", write) == folders[1] / "a.txt"


def test_text_is_escaped_for_a_terminal_that_lacks_letters(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, "ascii"))
    output = Output()
    output.text("weiß \udcff")
    assert raw.getvalue() == rb"wei\xdf \udcff" + b"\n"
    assert not output.failed


# ---- the process's own streams --------------------------------------------------------------------------------------

# Starts the program and does what commands do: write a file, print a result, and print a message.
SCRIPT = """
import sys
from pathjax import __main__ as program
from pathjax import cli
from pathjax.system.output import Output, say

def main():
    output = Output()
    with open(sys.argv[1], "w") as file:
        say("message")
        output.text("result")
        file.write("whole")
    return int(output.failed)

cli.main = main
sys.exit(program.main())
"""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize(
    "redirection, status, out, err",
    [
        ("", 0, "result\n", "pathjax: message\n"),
        ("2>&-", 0, "result\n", ""),
        ("2>/dev/full", 0, "result\n", ""),
        (">&-", 1, "", "pathjax: message\npathjax: stdout cannot be written: it is closed\n"),
        (">/dev/full", 1, "", "pathjax: message\npathjax: stdout cannot be written: No space left on device\n"),
        ("<&- >&- 2>&-", 1, "", ""),
    ],
)
def test_closed_and_full_streams_cost_nothing_but_what_goes_there(root, tmp_path, redirection, status, out, err):
    command = ["sh", "-c", f'"$@" {redirection}', "sh", sys.executable, "-c", SCRIPT, str(tmp_path / "file")]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (status, out, err)
    assert (tmp_path / "file").read_text() == "whole"


def test_a_reader_that_has_enough_is_no_news(root, tmp_path):
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "file")]
    done = subprocess.run(command, cwd=root, stdout=write, stderr=subprocess.PIPE, text=True, timeout=60)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, "pathjax: message\n")
    assert (tmp_path / "file").read_text() == "whole"


def test_a_message_that_nobody_can_hear_is_no_error():
    class Gone(io.StringIO):
        def write(self, text):
            raise OSError("the terminal is gone")

        def flush(self):
            raise OSError("the terminal is gone")

    messages = program._Messages(Gone())
    print("message", file=messages, flush=True)
    assert messages.isatty() is False
