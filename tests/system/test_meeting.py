"""Processes that connect before they work together, here as threads: each of them learns what prevents it."""

import json
import os
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

import pytest

from pathjax.errors import InputError
from pathjax.system.meeting import meet


@pytest.fixture
def address():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


@pytest.fixture(autouse=True)
def soon_late(monkeypatch):
    monkeypatch.setattr("pathjax.system.meeting._LATE", 0.5)


def meeting(address, numbers, *, count=None, facts=None, seconds=10):
    """Return each process's error message, or the indices of the processes connected to it. facts: one each."""
    count, facts = count or len(numbers), facts or [{}] * len(numbers)

    def one(number, facts):
        try:
            peers = meet(address, count, number, facts, seconds)
            for peer in peers.values():
                peer.close()
            return sorted(peers)
        except InputError as error:
            return str(error)

    with ThreadPoolExecutor(len(numbers)) as threads:
        return list(threads.map(one, numbers, facts))


@contextmanager
def came(address, number, *, count):
    """Connect a process that the first one acknowledges."""
    host, port = address.split(":")
    until = time.monotonic() + 10
    while True:
        try:
            call = socket.create_connection((host, int(port)), timeout=5)
            break
        except ConnectionRefusedError:
            assert time.monotonic() < until
    with call:
        own = {"process": number, "host": "here", "facts": {"number of processes": str(count)}}
        call.sendall((json.dumps(own) + "\n").encode())
        assert call.recv(100) == b'"seen"\n'
        yield


def test_all_come_in_any_order_and_the_address_is_free_again(address):
    for numbers in ([0, 1, 2], [2, 1, 0], [0]):
        others = sorted(set(numbers) - {0})
        assert meeting(address, numbers) == [[0] if number else others for number in numbers]


def test_nobody_is_at_the_address(address):
    (told,) = meeting(address, [1], count=2, seconds=0.3)
    assert f"process 1 found no process 0 at {address} (Connection refused)" in told


def test_some_do_not_come(address):
    told = meeting(address, [0, 2], count=4, seconds=0.5)
    assert all("of 4 processes 1, 3 did not come" in each for each in told)


def test_one_who_came_and_ended_is_told_at_once(address):
    """Before all have come, the present processes are told, without waiting for the others."""
    host, port = address.split(":")
    with ThreadPoolExecutor(1) as thread:
        others = thread.submit(meeting, address, [0, 3], count=4, seconds=60)
        with came(address, 1, count=4):
            pass
        assert others.result(timeout=10) == ["process 1 has ended before all had come"] * 2


def test_the_first_one_ended(address):
    host, port = address.split(":")
    with socket.create_server((host, int(port))) as server, ThreadPoolExecutor(1) as thread:
        other = thread.submit(meeting, address, [1], count=3, seconds=60)
        call, _ = server.accept()
        call.sendall(b'"seen"\n')
        call.close()
        assert other.result(timeout=10) == [f"process 0, at {address}, has ended before all had come"]


def test_another_program_is_at_the_address(address):
    """After a useless answer a process asks again, since the program may make room for the first process."""
    host, port = address.split(":")
    with socket.create_server((host, int(port))) as server, ThreadPoolExecutor(1) as thread:
        other = thread.submit(meeting, address, [1], count=2, seconds=1)
        server.settimeout(2)
        with suppress(TimeoutError):
            while True:
                call, _ = server.accept()
                call.recv(1000)  # otherwise the process sees a reset connection
                call.sendall(b"SSH-2.0\r\n")
                call.close()
        assert "another program, or has met all others already" in other.result()[0]


def test_who_waits_long_is_told_for_whom(address, monkeypatch, capsys):
    monkeypatch.setattr("pathjax.system.meeting._TOLD", 0.2)
    meeting(address, [0, 1], count=3, seconds=0.5)
    assert f"process 0 waits at {address} for 2, " in capsys.readouterr().err
    meeting(address, [1], count=3, seconds=0.5)
    assert f"process 1 finds no process 0 at {address} (Connection refused)" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="counts files")
def test_a_process_with_many_open_files_meets_others(address):
    """The first of a thousand processes has that many."""
    import resource

    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(limits[0], min(2048, limits[1])), limits[1]))
    opened = [os.open(os.devnull, os.O_RDONLY) for _ in range(1100)]
    try:
        assert meeting(address, [0, 1]) == [[1], [0]]
    finally:
        for each in opened:
            os.close(each)
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_two_have_one_number(address):
    told = meeting(address, [0, 1, 1], count=3)
    assert all("two processes have the number 1" in each for each in told)


def test_two_are_the_first(address):
    told = meeting(address, [0, 0], count=2)
    assert all("two processes have the number 0" in each for each in told)


def test_another_program_has_the_port(address):
    host, port = address.split(":")
    with socket.create_server((host, int(port))) as server:
        server.settimeout(5)
        with ThreadPoolExecutor(1) as thread:
            told = thread.submit(meeting, address, [0], count=2)
            server.accept()[0].close()
            assert "stop what uses the port" in told.result()[0]


def test_facts_differ(address):
    told = meeting(address, [0, 1], facts=[{"version": "1"}, {"version": "2"}])
    assert told == ["process 1 has another version than process 0; give all the same"] * 2


@pytest.mark.parametrize("wrong", ["localhost", ":1234", "host:port", "host:99999"])
def test_wrong_addresses(wrong):
    with pytest.raises(InputError, match="HOST:PORT"):
        meet(wrong, 2, 1, {}, 1)


def test_strangers_are_not_counted(address):
    host, port = address.split(":")

    def stranger():
        while True:
            try:
                with socket.create_connection((host, int(port)), timeout=5) as call:
                    call.sendall(b"GET / HTTP/1.1\r\n\r\n")
                return
            except ConnectionRefusedError:
                pass

    with ThreadPoolExecutor(1) as thread:
        first = thread.submit(meeting, address, [0], count=2)
        stranger()
        assert meeting(address, [1], count=2) == [[0]]
        assert first.result() == [[1]]
