"""Processes that are to work together meet at the address of the first, and learn what would keep them from it."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress

from pathjax.errors import InputError

# Bytes of a message at most, and seconds for which a caller may keep the first process waiting.
_LONGEST, _SLOWEST = 1 << 16, 5.0
_PAUSE = 0.1


def meet(address: str, processes: int, process: int, facts: Mapping[str, str], seconds: float) -> None:
    """Return when all processes have come; the address is free again then.

    Args:
        address: HOST:PORT of process 0.
        facts: what must be the same in all, by what it is.
        seconds: for which they wait for each other.
    Raises:
        InputError: the address is none, or in use; nobody is there; processes are missing, two have one number, or they
            differ in a fact.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise InputError(f"{address!r} is no address of the form HOST:PORT")
    facts = {"number of processes": str(processes), **facts}
    own = {"process": process, "host": socket.gethostname(), "facts": facts}
    until = time.monotonic() + seconds
    problem = _welcome(int(port), address, own, until) if process == 0 else _call(host, int(port), address, own, until)
    if problem:
        raise InputError(problem)


def _welcome(port: int, address: str, own: dict, until: float) -> str:
    """What keeps the processes from working together, as the first one finds out; empty: nothing."""
    try:
        dual = socket.has_dualstack_ipv6()
        family = socket.AF_INET6 if dual else socket.AF_INET
        server = socket.create_server(("", port), family=family, dualstack_ipv6=dual, backlog=512)
    except OSError as error:
        return f"process 0 cannot be found at {address}: {error.strerror}; stop what uses the port, or name another"
    with server, ExitStack() as open_calls:
        came, calls, problem = {0: own}, [], ""
        count = int(own["facts"]["number of processes"])
        while not problem and len(came) < count:
            server.settimeout(max(until - time.monotonic(), 0.01))
            try:
                call, _ = server.accept()
            except TimeoutError:
                missing = ", ".join(str(number) for number in range(count) if number not in came)
                problem = f"of {count} processes {missing} did not come to {address}; start all of them"
                break
            open_calls.enter_context(call)
            call.settimeout(_SLOWEST)
            with suppress(OSError, ValueError, KeyError, TypeError):  # somebody else, who is not of us
                other = json.loads(call.makefile().readline(_LONGEST))
                problem = _problem(own, came, other)
                came[other["process"]] = other
                calls.append(call)
        for call in calls:
            with suppress(OSError):
                call.sendall((json.dumps(problem) + "\n").encode())
    return problem


def _problem(own: dict, came: dict, other: dict) -> str:
    number = other["process"]
    if number in came:
        where = " and ".join(sorted({came[number]["host"], other["host"]}))
        return f"two processes have the number {number}, on {where}; give each its own"
    for what, fact in own["facts"].items():
        if other["facts"].get(what) != fact:
            return f"process {number} has another {what} than process 0; give all the same"
    return ""


def _call(host: str, port: int, address: str, own: dict, until: float) -> str:
    """What the first process answers; empty: nothing keeps them from working together."""
    why = "it does not answer"
    while (left := until - time.monotonic()) > 0:
        try:
            with socket.create_connection((host, port), timeout=left) as call:
                call.sendall((json.dumps(own) + "\n").encode())
                call.settimeout(max(until + _SLOWEST - time.monotonic(), 0.01))
                return json.loads(call.makefile().readline(_LONGEST))
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or why
        time.sleep(_PAUSE)
    return f"process {own['process']} found no process 0 at {address} ({why}); start all of them, with that address"
