"""Processes that meet before they work together, here as threads: what keeps them apart is told to each of them."""

import socket
from concurrent.futures import ThreadPoolExecutor

import pytest

from pathjax.errors import InputError
from pathjax.system.meeting import meet


@pytest.fixture
def address():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def meeting(address, numbers, *, count=None, facts=None, seconds=10):
    """What each process is told, or the numbers of those that it is connected with then. facts: of each."""
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


def test_two_have_one_number(address):
    told = meeting(address, [0, 1, 1], count=3)
    assert all("two processes have the number 1" in each for each in told)


def test_two_are_the_first(address):
    told = meeting(address, [0, 0], count=2, seconds=0.5)
    assert sorted("cannot be found" in each for each in told) == [False, True]


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
