"""Several processes, on one machine or on many, that share work through JAX's distributed runtime.

All run the same program and do the same, except that only the first one writes and prints. The items of a kernel are
distributed over the devices of all processes (`compile.mapping`); `render_until` distributes whole calls of kernels, so
that no device waits for another (`dealt`). Processes agree on everything that decides how work continues (time,
signals, noise so far), so that they never diverge.
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
# Seconds that processes wait for each other at the start, as in large jobs some start minutes after others; and seconds
# of silence after which JAX's own watch, which is slower than `Watch`, gives a process up.
MEETING, SILENCE = 300, 60
# Calls per device between two exchanges. All processes wait for the slowest at an exchange, so few are better; but only
# then do they notice signals.
CALLS = 2
# Bytes per exchange when a process sends what it has read from a file.
_PART = 1 << 22
# Words in the transport's errors after the loss of a process.
TRANSPORT = re.compile("gloo|nccl|peer|connection|socket|heartbeat|coordination|deadline", re.IGNORECASE)

_threads: list[Watch | Relay] = []  # of this process, if there are several


class ProcessLost(RuntimeError):
    """Another process ended, so this one cannot go on."""


def start(coordinator: str | None = None, processes: int | None = None, process: int | None = None) -> None:
    """Join the other processes. Each process of the cluster calls this before it creates its first JAX array.

    Args:
        coordinator: HOST:PORT of the first process, the same for all; None, as the other arguments, if JAX detects the
            cluster (SLURM, Open MPI, Kubernetes).
        processes: number of processes.
        process: index of this process, from 0.
    Raises:
        InputError: the others were not found, two have the same index, their code or device counts differ, or JAX's
            backend has already started.
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
    """Return the index of this process; process 0 writes and prints."""
    return jax.process_index() if jax.distributed.is_initialized() else 0


def exchanged(tree: T) -> list[T]:
    """Return the pytrees that all processes pass, by process; their arrays must have the same shapes.

    Raises:
        ProcessLost: a process has ended.
    """
    with losses():
        found = jax.tree.map(np.array, gathered(tree))
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(jax.process_count())]


def of_first(tree: T) -> T:
    """Return the pytree that the first process passes."""
    return exchanged(tree)[0] if count() > 1 else tree


def of_file(path: str | os.PathLike, read: Callable[[], T]) -> T:
    """Return `read()`; a process that lacks the file `path` gets the result of the first process.

    Raises:
        InputError: raised by `read`.
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
    """Check that digests, of 16 letters, are the same in all processes; names are for messages.

    Raises:
        InputError: a digest differs.
    """
    if count() > 1:
        own = np.stack([np.frombuffer(digest.encode(), np.uint8) for digest in digests.values()])
        for other, theirs in enumerate(exchanged(own)):
            for what, differs in zip(digests, (theirs != own).any(1), strict=True):
                if differs:
                    raise InputError(f"process {index()} has another {what} than process {other}; give all the same")


def ended(reason: str = "") -> None:
    """Tell the other processes, if any, that this process ends: regularly, or for a reason."""
    for thread in _threads:
        if isinstance(thread, Watch):
            thread.end(reason and f"process {index()} has ended: {reason}")


def _leave() -> None:
    """End regularly."""
    ended()
    jax.distributed.shutdown()  # waits for the others
    for thread in _threads:
        thread.close()


def _end(reason: str) -> None:
    time.sleep(2 * BEAT)  # if processes differ, this one finds that too, and its own message is better
    say(f"process {index()} ends, as {reason}")
    leave(1, at_once=True)


def _end_at_once_after_errors() -> None:
    """End this process at once after an uncaught error; else Python waits for the others, which wait for this one."""
    tell = sys.excepthook

    def end(kind, error, trace) -> None:
        if TRANSPORT.search(str(error)):
            _wait_for_watch()
        tell(kind, error, trace)
        ended(f"{kind.__name__}: {error}")
        leave(1, at_once=True)

    sys.excepthook = end


def _wait_for_watch() -> None:
    """Wait for `Watch` to detect which process is lost, and to end this one."""
    time.sleep(BEAT * (PATIENCE + 2))


def _package() -> str:
    """Return a digest of pathjax's code, which may differ within one version."""
    files = sorted(Path(__file__).parent.rglob("*.py"))
    content = b"".join(file.read_bytes().replace(b"\r\n", b"\n") for file in files)
    return hashlib.sha256(content).hexdigest()[:16]


@contextmanager
def losses() -> Iterator[None]:
    """Context that replaces errors of JAX's transport, which are due to an ended process, by `ProcessLost`.

    Raises:
        ProcessLost: JAX raised such an error within the context, and there are several processes.
    """
    try:
        yield
    except (ValueError, RuntimeError) as error:  # the transport raises both types
        if count() == 1 or isinstance(error, InputError | ProcessLost) or not TRANSPORT.search(str(error)):
            raise
        _wait_for_watch()
        said = str(error).partition("\n")[0]
        raise ProcessLost(f"another process cannot be reached: {said}") from None


@contextmanager
def interruptible(interrupts: Interrupts) -> Iterator[None]:
    """Context like `interrupts.raised` for one process. Several must not diverge, so they call `heard` now and then."""
    if count() == 1:
        with interrupts.raised():
            yield
    else:
        heard(interrupts)
        yield


def heard(interrupts: Interrupts) -> None:
    """Exchange whether any process has received a signal.

    Raises:
        KeyboardInterrupt: one has.
    """
    if highest(bool(interrupts.heard)):
        raise KeyboardInterrupt


def highest(number: int) -> int:
    """Return the highest of the numbers that the processes pass."""
    return int(max(exchanged(np.int32(number)))) if count() > 1 else number


def total(number: float) -> float:
    """Return the sum of the numbers that the processes pass."""
    return float(sum(exchanged(np.float32(number)))) if count() > 1 else number


def dealt(f: Callable[[T], np.ndarray], items: Iterable[T], stopped: Callable[[], object]) -> Iterator[tuple]:
    """Yield pairs (item, f(item)) in order, the same in all processes; like `concurrently`, each computing its share.

    Args:
        f: function of an item; returns arrays of the same shape for all items.
        stopped: once true in any process, results are None; with several processes the first such pair is the last.
    """
    if count() == 1:
        yield from concurrently(lambda item: None if stopped() else f(item), items)
        return
    items, each = iter(items), CALLS * calls_at_once()
    while batch := list(islice(items, each * count())):
        if highest(bool(stopped())):
            yield batch[0], None
            return
        # A process without an item repeats the first one, as all must exchange arrays of the same shape.
        mine = batch[index() :: count()] or batch[:1]
        done = np.stack([result for _, result in concurrently(f, mine)])
        room = np.zeros((-(-len(batch) // count()), *done.shape[1:]), done.dtype)
        room[: len(done)] = done
        results = exchanged(room)
        for place, item in enumerate(batch):
            yield item, results[place % count()][place // count()]


@contextmanager
def _without_stdout() -> Iterator[None]:
    """Suppress the transport's messages about connected processes, which it prints on stdout, bypassing Python."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)
