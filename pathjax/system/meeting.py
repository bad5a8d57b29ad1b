"""Connects processes that are to work together at the address of the first, and checks that they can."""

from __future__ import annotations

import json
import selectors
import socket
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress

from pathjax.errors import InputError
from pathjax.system.output import say

# Most bytes of a message, and most seconds for which a caller may keep the first process waiting.
_LONGEST, _SLOWEST = 1 << 16, 5.0
_PAUSE = 0.1
# Seconds of waiting after which a message says who is missing; and seconds for which the first process tells latecomers
# the problem.
_TOLD, _LATE = 10.0, 5.0
# Immediate reply of the first process to each caller, which from then on notices if the first process ends.
_SEEN = "seen"


def meet(
    address: str, processes: int, process: int, facts: Mapping[str, str], seconds: float
) -> dict[int, socket.socket]:
    """Return when all processes have connected; the address is free again then.

    Args:
        address: HOST:PORT of process 0.
        processes: number of processes.
        process: index of this process.
        facts: name -> value that must be the same in all processes.
        seconds: for which processes wait for each other.
    Returns:
        connections by the index of the process at the other end: the first process has one with each other process, and
        these have one with the first.
    Raises:
        InputError: the address is malformed or in use; nobody answers; processes are missing, one has ended meanwhile,
            two have the same index, or they differ in a fact.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise InputError(f"{address!r} is no address of the form HOST:PORT")
    facts = {"number of processes": str(processes), **facts}
    own = {"process": process, "host": socket.gethostname(), "facts": facts}
    if process:
        return {0: _call(host, int(port), address, own, seconds)}
    return _accept(host, int(port), address, own, seconds)


def _accept(host: str, port: int, address: str, own: dict, seconds: float) -> dict[int, socket.socket]:
    """Accept connections from all other processes, and tell them the problem if they cannot work together."""
    try:
        dual = socket.has_dualstack_ipv6()
        family = socket.AF_INET6 if dual else socket.AF_INET
        server = socket.create_server(("", port), family=family, dualstack_ipv6=dual, backlog=512)
    except OSError as error:
        problem = ""
        with suppress(OSError, ValueError), socket.create_connection((host, port), timeout=_SLOWEST) as call:
            _send(call, own)  # another process with the number 0 notices, and tells all processes
            if json.loads(_line(call)) == _SEEN:
                problem = json.loads(_line(call))
        unusable = f"process 0 cannot be found at {address}: {error.strerror}"
        raise InputError(problem or f"{unusable}; stop what uses the port, or name another") from None
    with server, selectors.DefaultSelector() as selector, ExitStack() as opened:
        selector.register(server, selectors.EVENT_READ, 0)
        came, calls, problem = {0: own}, [], ""
        count = int(own["facts"]["number of processes"])
        until, told = time.monotonic() + seconds, time.monotonic() + _TOLD
        while not problem and len(came) < count:
            missing = ", ".join(str(number) for number in range(count) if number not in came)
            if (now := time.monotonic()) >= until:
                problem = f"of {count} processes {missing} did not come to {address}; start all of them"
                break
            if now >= told:
                say(f"process 0 waits at {address} for {missing}, {until - now:.0f} s more")
                told = until
            # No process sends anything before all have connected: a readable connection is one that has ended.
            readable = {key.data for key, _ in selector.select(min(told, until) - now)}
            if gone := sorted(readable - {0}):
                problem = f"process {gone[0]} has ended before all had come"
            elif readable:
                call, _ = server.accept()
                call.settimeout(_SLOWEST)
                try:
                    other = json.loads(_line(call))
                    problem = _problem(own, came, other)
                    _send(call, _SEEN)
                except (OSError, ValueError, KeyError, TypeError):  # another program
                    call.close()
                    continue
                number = other["process"]
                came[number] = other
                calls.append((number, opened.enter_context(call)))
                selector.register(call, selectors.EVENT_READ, number)
        for _, call in calls:
            with suppress(OSError):
                _send(call, problem)
        if problem:
            _turn_away(server, problem, count - len(came), min(until, time.monotonic() + _LATE))
            raise InputError(problem)
        opened.pop_all()
    return dict(calls)


def _turn_away(server: socket.socket, problem: str, missing: int, until: float) -> None:
    """Tell the problem to latecomers, too, which would otherwise keep looking for the first process."""
    for _ in range(missing):
        with suppress(OSError):
            server.settimeout(max(until - time.monotonic(), 0.01))
            with server.accept()[0] as call:
                call.settimeout(_SLOWEST)
                _line(call)
                _send(call, _SEEN)
                _send(call, problem)


def _send(call: socket.socket, what: object) -> None:
    call.sendall((json.dumps(what) + "\n").encode())


def _line(call: socket.socket) -> bytes:
    """Read the next line, and nothing of what follows."""
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


def _call(host: str, port: int, address: str, own: dict, seconds: float) -> socket.socket:
    """Connect with the first process, and return once it has confirmed that all processes can work together."""
    why, begun, told = "it does not answer", time.monotonic(), False
    while (left := begun + seconds - time.monotonic()) > 0:
        if left <= seconds - _TOLD and not told:
            say(f"process {own['process']} finds no process 0 at {address} ({why}), and tries for {left:.0f} s more")
            told = True
        with ExitStack() as opened:
            try:
                call = opened.enter_context(socket.create_connection((host, port), timeout=left))
                _send(call, own)
                why = "who is there is another program, or has met all others already"
                if json.loads(_line(call)) != _SEEN:
                    raise ValueError
            except (OSError, ValueError) as error:
                why = getattr(error, "strerror", None) or why
                time.sleep(_PAUSE)
                continue
            # As long as the first process, which may have started later, waits for the others.
            call.settimeout(seconds + _SLOWEST)
            try:
                problem = json.loads(_line(call))
            except (OSError, ValueError):
                problem = f"process 0, at {address}, has ended before all had come"
            if problem:
                raise InputError(problem)
            opened.pop_all()
            return call
    raise InputError(
        f"process {own['process']} found no process 0 at {address} ({why}); start all of them, with that address"
    )
