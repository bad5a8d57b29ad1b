"""The command line: parses, calls, prints. Results go to stdout, progress and messages to stderr.

Each command is a module of the same name, whose `run(options, output)` returns the exit status: 0 done, 1 the work
failed (for `compare`: the images differ), 2 the command or a file is wrong.
"""

from __future__ import annotations

import contextlib
import importlib
import warnings

from pathjax import distributed
from pathjax.cli.arguments import parser
from pathjax.errors import InputError, InputWarning
from pathjax.system.interrupts import leave
from pathjax.system.output import Output, say

DONE, FAILED, WRONG = 0, 1, 2


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit status."""
    options, output = parser().parse_args(arguments), Output()
    with _warnings_as_messages():
        try:
            _join(options)
            # Import only the requested command: the solvers of `fit` alone take half a second.
            command = importlib.import_module(f"pathjax.cli.{options.command}")
            with distributed.losses():
                status = command.run(options, output)
        except InputError as error:
            say(str(error))
            distributed.ended(str(error))
            status = WRONG
        except distributed.ProcessLost as error:
            say(f"process {distributed.index()} ends, as {error}")
            status = FAILED
        except KeyboardInterrupt:
            say("interrupted" if output.written else "interrupted; nothing was written")
            status = FAILED
    status = FAILED if output.failed and status == DONE else status
    # Otherwise JAX waits at exit for processes that have ended, or that go on without this one.
    return leave(status, at_once=status != DONE and distributed.count() > 1)


def _join(options) -> None:
    """Join the other processes, if any."""
    given = {name: getattr(options, name, None) for name in ("coordinator", "processes", "process")}
    if all(value is None for value in given.values()):
        return
    if given["coordinator"] == "auto":
        given = {}
    elif None in given.values():
        raise InputError("--coordinator, --processes and --process belong together; give all three")
    elif given["process"] >= given["processes"]:
        raise InputError(f"--process {given['process']} of {given['processes']}: they are counted from 0")
    distributed.start(**given)
    from pathjax.scene.alike import fingerprint  # as late as what the command imports

    distributed.same({"command": fingerprint(options.command)})


@contextlib.contextmanager
def _warnings_as_messages():
    """Print an InputWarning as a message; never raise it, whatever Python's warning filters say."""
    with warnings.catch_warnings():
        warnings.simplefilter("default", InputWarning)
        plain = warnings.showwarning

        def show(message, category, *place):
            if issubclass(category, InputWarning):
                say(str(message))
            else:
                plain(message, category, *place)

        warnings.showwarning = show
        yield
