"""Programs that are measured in separate processes.

Each module but this one is a script, `python PEER.py REQUEST.json`. A request is a JSON object; its "output" names the
.npz file for arrays. The script prints a report, a JSON object, on stdout. Exit status: 0 done, 1 it failed, 2 the
request is wrong, 3 the program to measure is missing; the last line on stderr then says why.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np


class PeerMissing(RuntimeError):
    """The program to measure is not installed; the message says what to do."""


class RequestError(ValueError):
    """The request asks for something that does not exist."""


class PeerFailed(RuntimeError):
    """The process ended without a report."""


def call(peer: str, request: dict) -> tuple[dict, dict[str, np.ndarray]]:
    """Run a script of this folder.

    Args:
        peer: name of the script.
        request: as documented at the top of the script; without "output" the arrays go through a temporary file.
    Returns:
        The report, and the arrays by name.
    Raises:
        PeerMissing, RequestError, PeerFailed: with the last line that the process wrote to stderr.
    """
    with tempfile.TemporaryDirectory() as folder:
        request = {"output": str(Path(folder, "output.npz")), **request}
        file = Path(folder, "request.json")
        file.write_text(json.dumps(request))
        # The process must import this pathjax from any working directory and, by -P, no module beside the script.
        places = [str(Path(__file__).resolve().parents[3]), os.environ.get("PYTHONPATH")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, places))}
        command = [sys.executable, "-P", str(Path(__file__).with_name(f"{peer}.py").resolve()), str(file)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment)
        if done.returncode:
            message = done.stderr.strip().splitlines()[-1:] or [f"it ended with status {done.returncode}"]
            raise {2: RequestError, 3: PeerMissing}.get(done.returncode, PeerFailed)(message[0])
        with np.load(request["output"]) as arrays:
            return json.loads(done.stdout), dict(arrays)
