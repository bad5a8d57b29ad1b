"""Fixtures that run the command line, in this process or in a separate one."""

import os
import subprocess
import sys

import pytest

from pathjax import cli


@pytest.fixture(scope="session")
def environment(root):
    """Environment variables with which another process imports this pathjax, installed or not."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))}


@pytest.fixture
def run(root, tmp_path, monkeypatch, capfd):
    """(arguments) -> exit status, stdout, stderr of `pathjax`, run in this process and in the checkout."""
    monkeypatch.chdir(root)

    def run(*arguments):
        capfd.readouterr()
        try:
            status = cli.main([str(a) for a in arguments])
        except SystemExit as error:  # argparse
            status = error.code
        return status, *capfd.readouterr()

    return run


@pytest.fixture
def refused(run, tmp_path):
    """Assert exit status 2, one message with all the given parts, and nothing written; returns the message."""

    def refused(*arguments, says=()):
        before = sorted(tmp_path.rglob("*"))
        status, out, err = run(*arguments)
        assert status == 2
        assert out == ""
        assert "Traceback" not in err
        for part in says:
            assert part in err
        assert sorted(tmp_path.rglob("*")) == before
        return err

    return refused


@pytest.fixture
def process(root, environment):
    """Start `python -m pathjax` in the checkout."""

    def start(*arguments):
        command, pipe = [sys.executable, "-m", "pathjax", *map(str, arguments)], subprocess.PIPE
        return subprocess.Popen(command, cwd=root, env=environment, stdout=pipe, stderr=pipe, text=True)

    return start
