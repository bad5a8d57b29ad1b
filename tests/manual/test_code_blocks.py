"""Every code block of the README and the manual runs as written, page by page, in the order of the page.

The blocks of a page share a folder, which holds `scenes/`, and the Python names. Blocks of
- `python` are executed;
- `console` are commands, after `$`, and their output, where `...` stands for parts that may differ; `echo $?` shows the
  exit status of a command that fails;
- `xml` are files, named by the comment in their first line.
"""

from __future__ import annotations

import doctest
import re
import shlex

import jax
import pytest

from pathjax import bsdfs, emitters, textures
from pathjax.cli import main

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture
def folder(root, tmp_path, monkeypatch):
    """The current folder: empty but for `scenes/`, as a reader would see the checkout."""
    (tmp_path / "scenes").symlink_to(root / "scenes")
    monkeypatch.chdir(tmp_path)
    for room in (bsdfs, textures, emitters):
        monkeypatch.setattr(room, "KINDS", dict(room.KINDS))
    x64 = jax.config.jax_enable_x64
    yield tmp_path
    jax.config.update("jax_enable_x64", x64)


@pytest.fixture
def run(capfd):
    """(command line) -> exit status, and its output on stdout, or else on stderr."""

    def run(command):
        program, *arguments = shlex.split(command)
        assert program == "pathjax", command
        capfd.readouterr()
        try:
            status = main(arguments)
        except SystemExit as error:  # argparse
            status = error.code
        out, err = capfd.readouterr()
        return status, out or (err if status else "")

    return run


def session(text):
    """Yield pairs of a command and the output that is shown."""
    assert text.startswith("$ "), text
    for entry in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, _, shown = entry.partition("\n")
        yield command, shown


def check_session(text, run):
    entries = list(session(text))
    for place, (command, shown) in enumerate(entries):
        if command == "echo $?":
            continue
        follows = entries[place + 1] if place + 1 < len(entries) else ("", "")
        refused = shown.startswith("pathjax: ")
        expected = int(follows[1]) if follows[0] == "echo $?" else 2 if refused else 0
        status, printed = run(command)
        assert status == expected, f"{command}\n{printed}"
        same = doctest.OutputChecker().check_output(shown, printed, doctest.ELLIPSIS)
        assert same, f"{command}\nprints\n{printed}\nand the page shows\n{shown}"


def test_code_blocks_run(page, folder, run):
    text, names = page.read_text(encoding="utf-8"), {}
    for block in BLOCK.finditer(text):
        language, code = block.groups()
        line = text[: block.start(2)].count("\n")
        if language == "python":
            exec(compile("\n" * line + code, str(page), "exec"), names)
        elif language == "console":
            check_session(code, run)
        elif language == "xml":
            name = re.match(r"<!-- (\S+) -->\n", code)
            assert name, f"{page.name}:{line}: the first line names no file"
            (folder / name[1]).write_text(code)
        else:
            pytest.fail(f'{page.name}:{line}: nothing runs a block of "{language}"')


def test_every_fence_is_a_block(page):
    """An indented or unclosed fence would not be run."""
    text = page.read_text(encoding="utf-8")
    assert text.count("```") == 2 * len(BLOCK.findall(text))


def test_the_command_lines_of_the_readme(root, folder, run):
    """Indented lines: .ci/run runs the installation and the tests, and this test the render."""
    lines = re.findall(r"^    (\S.*)$", BLOCK.sub("", (root / "README.md").read_text()), re.MULTILINE)
    render, test = (line.split(" && ") for line in lines)
    for steps, what in ((render, "."), (test, "-e '.[test]'")):
        assert steps[:2] == ["python3 -m venv .venv", f".venv/bin/pip install -q {what}"]
    assert test[2:] == [".venv/bin/python -m pytest"]
    (command,) = render[2:]
    assert run(command.removeprefix(".venv/bin/")) == (0, "")
    assert (folder / "cornell.png").exists()
