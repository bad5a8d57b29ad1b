"""Processes that work together watch each other: when one is lost, the others end with a message that names it.

The first process has a connection with each other process, which stays open from their meeting on. A connection ends
with its process; a process that has stopped, or whose machine has, is silent.

JAX ends a process that has lost the first one, too, but at once and without naming it. So JAX talks to the first
process through a `Relay`, which stays open.
"""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress

# Seconds between two heartbeats, and how many may be missed: a process in a long NumPy call cannot send any.
BEAT, PATIENCE = 0.5, 20
_BEAT, _END = b"", b"end"
_LONGEST = 1 << 12


class Watch:
    """A thread that listens to the other processes, and calls `lost`, once, with the reason when one is lost."""

    def __init__(self, peers: Mapping[int, socket.socket], lost: Callable[[str], object]):
        self._peers, self._lost = dict(peers), lost
        self._watched = dict(peers)  # peers that have not ended regularly
        self._heard = dict.fromkeys(peers, b"")  # incomplete last line of each peer
        self._silent = dict.fromkeys(peers, 0)  # own beats since the peer's last message
        self._speaking = threading.Lock()
        self._selector = selectors.DefaultSelector()
        for number, peer in peers.items():
            peer.setblocking(False)
            self._selector.register(peer, selectors.EVENT_READ, number)
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop watching: a thread that still runs when Python exits may crash it."""
        self._watched.clear()
        self._thread.join()
        self._selector.close()

    def end(self, reason: str = "") -> None:
        """Tell the others that this process ends: regularly, or for a reason."""
        self._send(" ".join(reason.split()).encode() or _END)

    def _watch(self) -> None:
        try:
            while self._watched:
                self._send(_BEAT)
                self._listen()
        except _Loss as loss:
            self.end(str(loss))
            self._lost(str(loss))

    def _listen(self) -> None:
        until = time.monotonic() + BEAT
        while self._watched and (left := until - time.monotonic()) > 0:
            for key, _ in self._selector.select(left):
                self._receive(key.data, self._peers[key.data])
        for number in list(self._watched):
            # Counted in beats, not seconds, as this process may have been stopped itself.
            self._silent[number] += 1
            if self._silent[number] > PATIENCE:
                raise _Loss(f"process {number} has not answered for {BEAT * PATIENCE:g} s")

    def _receive(self, number: int, peer: socket.socket) -> None:
        try:
            said = peer.recv(_LONGEST)
        except BlockingIOError:
            return
        except OSError:
            said = b""
        if not said:
            raise _Loss(f"process {number} has ended")
        self._silent[number] = 0
        *lines, self._heard[number] = (self._heard[number] + said).split(b"\n")
        for line in lines:
            if line not in (_BEAT, _END):
                raise _Loss(line.decode(errors="replace"))
        if _END in lines:
            self._selector.unregister(peer)
            self._watched.pop(number, None)

    def _send(self, line: bytes) -> None:
        with self._speaking:
            for peer in self._peers.values():
                with suppress(OSError):  # a peer that does not listen is detected by its silence
                    peer.sendall(line + b"\n")


class _Loss(Exception):
    """A process is lost; the message says which and why."""


class Relay:
    """A local address that connects its callers with another address.

    When the other side ends, the connection with the caller stays open.
    """

    def __init__(self, target: str, seconds: float):
        """target: HOST:PORT. seconds: for which a caller waits until the target answers."""
        host, _, port = target.rpartition(":")
        self._target, self._seconds, self._closed = (host, int(port)), seconds, False
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = "{}:{}".format(*self._server.getsockname())
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closed = True
        self._thread.join()

    def _serve(self) -> None:
        others: dict[socket.socket, socket.socket] = {}  # source -> target of its data
        calls: list[socket.socket] = []  # kept open by these references
        with selectors.DefaultSelector() as selector:
            selector.register(self._server, selectors.EVENT_READ)
            while not self._closed:
                for source in [key.fileobj for key, _ in selector.select(BEAT)]:
                    if source is self._server:
                        call, _ = self._server.accept()
                        if target := self._connected():
                            calls.append(call)
                            others |= {call: target, target: call}
                            selector.register(call, selectors.EVENT_READ)
                            selector.register(target, selectors.EVENT_READ)
                    elif source in others and not _passed(source, others[source]):
                        selector.unregister(source)
                        target = others.pop(source)
                        if source in calls and target in others:
                            del others[target]
                            selector.unregister(target)
                            target.close()

    def _connected(self) -> socket.socket | None:
        until = time.monotonic() + self._seconds
        while not self._closed and time.monotonic() < until:
            with suppress(OSError):
                target = socket.create_connection(self._target, timeout=BEAT)
                target.settimeout(None)
                return target
            time.sleep(BEAT / 10)
        return None


def _passed(source: socket.socket, target: socket.socket) -> bool:
    """Pass on the data that has arrived; False: the source has ended."""
    try:
        said = source.recv(1 << 16)
        target.sendall(said)
        return bool(said)
    except OSError:
        return False
