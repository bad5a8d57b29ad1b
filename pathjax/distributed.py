"""Several processes, on one machine or on many, that share their work by JAX's distributed runtime.

All of them run the same program and do the same, but for what is written, which is the first one's. The items of a
kernel are dealt to the devices of all (`compile.mapping`); `render_until` deals out whole calls of kernels, so that no
device waits for another (`dealt`). Whatever decides how work goes on (time, signals, the noise so far) is agreed upon,
so that they never part.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import pickle
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np

from pathjax.compile import calls_at_once, concurrently
from pathjax.compile.jax_compat import found_cluster, gathered
from pathjax.errors import InputError
from pathjax.system.interrupts import Interrupts, leave
from pathjax.system.meeting import meet
from pathjax.system.output import say
from pathjax.system.watch import BEAT, PATIENCE, Relay, Watch

T = TypeVar("T")
# Seconds for which processes wait for each other at first, as of a large job some begin minutes after others; and then,
# by JAX's own watch, which is the slower one.
MEETING, SILENCE = 300, 60
# Calls of each device between two exchanges: all wait for the slowest, so the fewer exchanges the better; but signals
# are heard then.
_CALLS = 2
# Bytes that are sent at once, by each process, of what one has read.
_PART = 1 << 22
# Words of what the transport raises when it has lost a process.
TRANSPORT = re.compile("gloo|nccl|peer|connection|socket|heartbeat|coordination|deadline", re.IGNORECASE)

_threads: list[Watch | Relay] = []  # while there are several processes


class ProcessLost(RuntimeError):
    """Another process ended, so this one cannot go on."""


def start(coordinator: str | None = None, processes: int | None = None, process: int | None = None) -> None:
    """Join the other processes; before JAX's first array. Each process of the cluster calls it.

    Args:
        coordinator: HOST:PORT at which the first process is found, the same for all; None, like what follows, where
            JAX finds the cluster by itself (SLURM, Open MPI, Kubernetes).
        processes: how many there are; process: which of them this is, from 0.
    Raises:
        InputError: the others were not found, two have one number, their code or numbers of devices differ, or JAX's
            backend has started already.
    """
    facts = {"code of pathjax": _package(), "version of JAX": jax.__version__}
    try:
        devices = None
        if coordinator is None:
            coordinator, processes, process, devices = found_cluster(MEETING)
            if None in (coordinator, processes, process):
                raise InputError(
                    "no cluster is found here (SLURM, Open MPI, Kubernetes); give the address of the first process, "
                    "how many there are and which of them this is"
                )
        peers = meet(coordinator, processes, process, facts, MEETING)
        _threads.append(Watch(peers, _end))
        if process:
            _threads.append(Relay(coordinator, MEETING))
            coordinator = _threads[-1].address
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        patience = {"initialization_timeout": MEETING, "heartbeat_timeout_seconds": SILENCE}
        jax.distributed.initialize(coordinator, processes, process, devices, **patience)
    except InputError:
        raise
    except (RuntimeError, ValueError, OSError) as error:
        said = str(error).partition("\n")[0]
        raise InputError(f"this process could not join the others ({said}); start each of them anew") from None
    atexit.register(_leave)
    _end_at_once_after_errors()
    devices = Counter(device.process_index for device in jax.devices())
    for other, number in sorted(devices.items()):
        if number != devices[0]:
            raise InputError(
                f"process {other} has {number} devices and process 0 has {devices[0]}; give all as many, of CPUs by "
                "JAX_NUM_CPU_DEVICES in the environment"
            )
    with _without_stdout():
        exchanged(np.int32(0))


def count() -> int:
    """Return the number of processes."""
    return jax.process_count() if jax.distributed.is_initialized() else 1


def index() -> int:
    """Return the number of this process; 0 is the one that writes and prints."""
    return jax.process_index() if jax.distributed.is_initialized() else 0


def exchanged(tree: T) -> list[T]:
    """What each process gives, by process; arrays of the same shapes.

    Raises:
        ProcessLost: one has ended.
    """
    with losses():
        found = jax.tree.map(np.array, gathered(tree))
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(jax.process_count())]


def of_first(tree: T) -> T:
    """What the first process gives."""
    return exchanged(tree)[0] if count() > 1 else tree


def of_file(path: str | os.PathLike, read: Callable[[], T]) -> T:
    """What `read` gives of a file; a process that has no such file gets what the first one has read.

    Raises:
        InputError: of `read`.
    """
    lacking = not Path(path).exists()
    if not highest(lacking):
        return read()
    content = read() if not index() or not lacking else None
    sent = b"" if index() else pickle.dumps(content)
    parts = (sent[first : first + _PART].ljust(_PART, b"\0") for first in range(0, highest(len(sent)), _PART))
    came = b"".join(of_first(np.frombuffer(part, np.uint8)).tobytes() for part in parts)
    return pickle.loads(came) if lacking else content


def same(digests: Mapping[str, str]) -> None:
    """Compare what processes have: names, and digests of 16 letters.

    Raises:
        InputError: they differ.
    """
    if count() > 1:
        own = np.stack([np.frombuffer(digest.encode(), np.uint8) for digest in digests.values()])
        for other, theirs in enumerate(exchanged(own)):
            for what, differs in zip(digests, (theirs != own).any(1), strict=True):
                if differs:
                    raise InputError(f"process {index()} has another {what} than process {other}; give all the same")


def ended(reason: str = "") -> None:
    """Tell the others, if there are any, that this process ends: as it should, or why not."""
    for thread in _threads:
        if isinstance(thread, Watch):
            thread.end(reason and f"process {index()} has ended: {reason}")


def _leave() -> None:
    """End as it should."""
    ended()
    jax.distributed.shutdown()  # waits for the others
    for thread in _threads:
        thread.close()


def _end(reason: str) -> None:
    time.sleep(2 * BEAT)  # what differs between processes each of them finds out by itself, and says it better
    say(f"process {index()} ends, as {reason}")
    leave(1, at_once=True)


def _end_at_once_after_errors() -> None:
    """Let an error that ends this process end it: else Python waits for the others, which wait for this one."""
    tell = sys.excepthook

    def end(kind, error, trace) -> None:
        if TRANSPORT.search(str(error)):
            _wait_for_watch()
        tell(kind, error, trace)
        ended(f"{kind.__name__}: {error}")
        leave(1, at_once=True)

    sys.excepthook = end


def _wait_for_watch() -> None:
    """Wait while it finds out which process is lost, and ends this one."""
    time.sleep(BEAT * (PATIENCE + 2))


def _package() -> str:
    """Digest of the code of pathjax, which may be of one version and yet not the same."""
    files = sorted(Path(__file__).parent.rglob("*.py"))
    content = b"".join(file.read_bytes().replace(b"\r\n", b"\n") for file in files)
    return hashlib.sha256(content).hexdigest()[:16]


@contextmanager
def losses() -> Iterator[None]:
    """A context in which errors of JAX are told apart from those of a process that has ended.

    Raises:
        ProcessLost: for what JAX raises within it, if there are several processes and one has ended.
    """
    try:
        yield
    except (ValueError, RuntimeError) as error:  # of either type the transport has it
        if count() == 1 or isinstance(error, InputError | ProcessLost) or not TRANSPORT.search(str(error)):
            raise
        _wait_for_watch()
        said = str(error).partition("\n")[0]
        raise ProcessLost(f"another process cannot be reached: {said}") from None


@contextmanager
def interruptible(interrupts: Interrupts) -> Iterator[None]:
    """`interrupts.raised` in one process. Several, which must not part, ask `heard` now and then."""
    if count() == 1:
        with interrupts.raised():
            yield
    else:
        heard(interrupts)
        yield


def heard(interrupts: Interrupts) -> None:
    """Find out whether a signal came to any process.

    Raises:
        KeyboardInterrupt: one did.
    """
    if highest(bool(interrupts.heard)):
        raise KeyboardInterrupt


def highest(number: int) -> int:
    """Return the highest of the numbers that the processes give."""
    return int(max(exchanged(np.int32(number)))) if count() > 1 else number


def total(number: float) -> float:
    """Sum of the numbers that processes give."""
    return float(sum(exchanged(np.float32(number)))) if count() > 1 else number


def dealt(f: Callable[[T], np.ndarray], items: Iterable[T], stopped: Callable[[], object]) -> Iterator[tuple]:
    """`concurrently`, of which each process does its share: pairs (item, f(item)) in order, the same in all.

    Args:
        f: of an item, an array of one shape for all items.
        stopped: once it is true in any process, the result is None, and no more is asked for.
    """
    if count() == 1:
        yield from concurrently(lambda item: None if stopped() else f(item), items)
        return
    items, each = iter(items), _CALLS * calls_at_once()
    while batch := list(islice(items, each * count())):
        if highest(bool(stopped())):
            yield batch[0], None
            return
        # Who has nothing to do repeats what another one does, since all give arrays of one shape.
        mine = batch[index() :: count()] or batch[:1]
        done = np.stack([result for _, result in concurrently(f, mine)])
        room = np.zeros((-(-len(batch) // count()), *done.shape[1:]), done.dtype)
        room[: len(done)] = done
        results = exchanged(room)
        for place, item in enumerate(batch):
            yield item, results[place % count()][place // count()]


@contextmanager
def _without_stdout() -> Iterator[None]:
    """Leave out what the transport prints on stdout, past Python's own, of the processes that it has found."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)
