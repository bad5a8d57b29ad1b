"""`pathjax help` shows the pages of the manual."""

from __future__ import annotations

import os
import pty
import subprocess
import sys

import pytest

from pathjax.cli import main


def test_without_a_topic_the_pages_are_listed_with_what_they_are_about(root, capsys):
    assert main(["help"]) == 0
    first, *lines = capsys.readouterr().out.splitlines()
    assert "pathjax help TOPIC" in first
    assert [line.split()[0] for line in lines] == sorted(page.stem for page in root.glob("pathjax/manual/*.md"))
    assert "scenes           what a scene file may hold" in lines
    assert all(len(line.split()) > 2 and len(line) <= 80 for line in lines)


def test_a_page_comes_as_its_markdown_where_stdout_is_no_terminal(root, capsys):
    assert main(["help", "scenes"]) == 0
    assert capsys.readouterr().out == (root / "pathjax" / "manual" / "scenes.md").read_text()


@pytest.mark.parametrize(("topic", "says"), [("scene", 'did you mean "scenes"?'), ("weather", "use one of adding-")])
def test_an_unknown_topic_is_refused_with_the_nearest(topic, says, capsys):
    assert main(["help", topic]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and f'there is no page "{topic}"' in captured.err and says in captured.err


def test_a_terminal_shows_the_page_rendered(root):
    ours, theirs = pty.openpty()
    environment = os.environ | {"PYTHONPATH": str(root), "TERM": "xterm", "COLUMNS": "80"}
    command = [sys.executable, "-m", "pathjax", "help", "errors"]
    process = subprocess.Popen(command, stdout=theirs, env=environment)
    os.close(theirs)
    shown = b""
    try:
        while part := os.read(ours, 1 << 16):
            shown += part
    except OSError:  # raised by Linux when the other side is closed
        pass
    os.close(ours)
    assert process.wait() == 0
    text = shown.decode()
    assert "Of a pixel" in text and "\x1b[" in text
    assert "## Of a pixel" not in text and "**" not in text
