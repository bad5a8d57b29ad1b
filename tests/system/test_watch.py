"""Processes that watch each other, here as threads: all learn which one is lost; a regular end is no loss."""

import queue
import socket
import time

import pytest

from pathjax.system import watch
from pathjax.system.watch import Relay, Watch


@pytest.fixture
def star(monkeypatch):
    """(count) -> watches by process, each one's queue of messages, and the connection ends of all but process 0."""
    monkeypatch.setattr(watch, "BEAT", 0.02)
    watches, ends = [], []

    def star(number):
        pairs = {k: socket.socketpair() for k in range(1, number)}
        told = [queue.Queue() for _ in range(number)]
        watches.append(Watch({k: first for k, (first, _) in pairs.items()}, told[0].put))
        for k, (_, other) in pairs.items():
            watches.append(Watch({0: other}, told[k].put))
        ends.extend(pairs.values())
        return watches, told, {k: other for k, (_, other) in pairs.items()}

    yield star
    for each in watches:
        each.close()
    for pair in ends:
        for end in pair:
            end.close()


def test_all_learn_which_one_has_ended(star):
    _, told, ends = star(3)
    ends[2].shutdown(socket.SHUT_RDWR)
    assert [told[k].get(timeout=5) for k in (0, 1)] == ["process 2 has ended"] * 2
    assert [each.qsize() for each in told[:2]] == [0, 0]


def test_all_learn_why_one_ends(star):
    watches, told, _ = star(3)
    watches[1].end("process 1 has ended: no\nsuch file")
    assert [told[k].get(timeout=5) for k in (0, 2)] == ["process 1 has ended: no such file"] * 2


def test_one_that_is_silent_is_lost(star, monkeypatch):
    monkeypatch.setattr(watch, "PATIENCE", 10)
    watches, told, _ = star(3)
    watches[1].close()
    said = [told[k].get(timeout=5) for k in (0, 2)]
    assert all(one.startswith("process 1 has not answered for") for one in said)


def test_those_that_end_as_they_should_are_not_lost(star):
    """Nor is one that waits for another which has ended before it heard of the end."""
    watches, told, ends = star(3)
    for each in watches:
        each.end()
    for end in ends.values():
        end.shutdown(socket.SHUT_RDWR)
    for each in watches:
        each.close()
    assert not any(each.qsize() for each in told)


def test_a_relay_waits_for_who_is_to_be_there_and_outlives_him():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = free.getsockname()
    relay = Relay("{}:{}".format(*address), 5)
    host, port = relay.address.split(":")
    with socket.create_connection((host, int(port)), timeout=5) as call:
        call.sendall(b"to")
        time.sleep(0.2)
        with socket.create_server(address) as server:
            target, _ = server.accept()
        with target:
            assert target.recv(10) == b"to"
            target.sendall(b"fro")
            assert call.recv(10) == b"fro"
        call.settimeout(0.3)
        with pytest.raises(TimeoutError):
            call.recv(1)
    relay.close()


def test_a_relay_ends_with_its_caller():
    with socket.create_server(("127.0.0.1", 0)) as server:
        relay = Relay("{}:{}".format(*server.getsockname()), 5)
        host, port = relay.address.split(":")
        with socket.create_connection((host, int(port)), timeout=5) as call:
            call.sendall(b"to")
            target, _ = server.accept()
        with target:
            assert [target.recv(10) for _ in range(2)] == [b"to", b""]
    relay.close()
