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


def meet(
    address: str, processes: int, process: int, facts: Mapping[str, str], seconds: float
) -> dict[int, socket.socket]:
    """Return when all processes have come; others may listen at the address then.

    Args:
        address: HOST:PORT of process 0.
        facts: what must be the same in all, by what it is.
        seconds: for which they wait for each other.
    Returns:
        connections, by the number of the process at the other end: of the first one with all others, of each of them
        with the first.
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
    if process:
        return {0: _call(host, int(port), address, own, until)}
    return _welcome(int(port), address, own, until)


def _welcome(port: int, address: str, own: dict, until: float) -> dict[int, socket.socket]:
    """Connections with all others, who are told what keeps the processes from working together, if anything does."""
    try:
        dual = socket.has_dualstack_ipv6()
        family = socket.AF_INET6 if dual else socket.AF_INET
        server = socket.create_server(("", port), family=family, dualstack_ipv6=dual, backlog=512)
    except OSError as error:
        raise InputError(
            f"process 0 cannot be found at {address}: {error.strerror}; if no other process has the number 0 too, stop "
            "what uses the port, or name another"
        ) from None
    with server, ExitStack() as opened:
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
            call.settimeout(_SLOWEST)
            try:
                other = json.loads(_line(call))
                problem = _problem(own, came, other)
            except (OSError, ValueError, KeyError, TypeError):  # somebody else, who is not of us
                call.close()
                continue
            came[other["process"]] = other
            calls.append((other["process"], opened.enter_context(call)))
        for _, call in calls:
            with suppress(OSError):
                call.sendall((json.dumps(problem) + "\n").encode())
        if problem:
            raise InputError(problem)
        opened.pop_all()
    return dict(calls)


def _line(call: socket.socket) -> bytes:
    """The next line, and nothing of what follows."""
    return call.makefile("rb", buffering=0).readline(_LONGEST)


def _problem(own: dict, came: dict, other: dict) -> str:
    number = other["process"]
    if number in came:
        where = " and ".join(sorted({came[number]["host"], other["host"]}))
        return f"two processes have the number {number}, on {where}; give each its own"
    for what, fact in own["facts"].items():
        if other["facts"].get(what) != fact:
            return f"process {number} has another {what} than process 0; give all the same"
    return ""


def _call(host: str, port: int, address: str, own: dict, until: float) -> socket.socket:
    """The connection with the first process, which has said that nothing keeps them from working together."""
    why = "it does not answer"
    while (left := until - time.monotonic()) > 0:
        with ExitStack() as opened:
            try:
                call = opened.enter_context(socket.create_connection((host, port), timeout=left))
                call.sendall((json.dumps(own) + "\n").encode())
                call.settimeout(max(until + _SLOWEST - time.monotonic(), 0.01))
                problem = json.loads(_line(call))
            except (OSError, ValueError) as error:
                why = getattr(error, "strerror", None) or why
                time.sleep(_PAUSE)
                continue
            if problem:
                raise InputError(problem)
            opened.pop_all()
            return call
    raise InputError(
        f"process {own['process']} found no process 0 at {address} ({why}); start all of them, with that address"
    )
