"""Signals to end the program wait for work that is being finished; the tests receive the signals that they send."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from pathjax.system.interrupts import SIGNALS, Interrupts, leave, wait_for

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="sends signals")


@pytest.fixture(params=SIGNALS)
def number(request):
    """A signal that raises KeyboardInterrupt, whatever started the tests."""
    earlier = signal.signal(request.param, signal.default_int_handler)
    yield request.param
    signal.signal(request.param, earlier)


def test_signals_are_noted_however_many_come(number):
    with Interrupts() as interrupts:
        assert not interrupts.heard
        for _ in range(3):
            signal.raise_signal(number)
            assert interrupts.heard
    assert signal.getsignal(number) is signal.default_int_handler


def test_what_is_heard_within_is_heard_around_it_and_after_it(number):
    with Interrupts() as outer:
        with Interrupts():
            pass
        assert not outer.heard
        with Interrupts() as inner:
            signal.raise_signal(number)
            assert inner.heard
        assert outer.heard
        with Interrupts() as later:
            assert later.heard


def test_work_that_may_be_given_up_is(number):
    with Interrupts() as interrupts:
        with pytest.raises(KeyboardInterrupt), interrupts.raised():
            signal.raise_signal(number)
        with pytest.raises(KeyboardInterrupt), interrupts.raised():
            pytest.fail("it began after a signal")


def test_a_signal_after_such_work_is_noted(number):
    with Interrupts() as interrupts:
        with interrupts.raised():
            pass
        signal.raise_signal(number)
    assert interrupts.heard


def test_ignored_signals_stay_ignored(number):
    signal.signal(number, signal.SIG_IGN)
    with Interrupts() as interrupts:
        signal.raise_signal(number)
    assert not interrupts.heard


def test_other_threads_change_nothing(number):
    def work():
        with Interrupts():
            handlers.append(signal.getsignal(number))

    handlers = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert handlers == [signal.default_int_handler]


# ---- calls that cannot be stopped -----------------------------------------------------------------------------------


def test_the_result_of_a_call_and_its_error_arrive():
    assert wait_for(lambda: threading.current_thread().daemon) is True
    with pytest.raises(ZeroDivisionError):
        wait_for(lambda: 1 / 0)
    assert leave(2) == 2


# Waits for a call that takes a minute, and exits as if it had failed.
STUCK = """
import time
from pathjax.system.interrupts import leave, wait_for
try:
    wait_for(lambda: print("begun", flush=True) or time.sleep(60))
except KeyboardInterrupt:
    print("left", end="")
raise SystemExit(leave(7))
"""


def test_a_signal_ends_the_waiting_and_the_program_though_the_call_goes_on(root):
    command, pipe = [sys.executable, "-c", STUCK], subprocess.PIPE
    with subprocess.Popen(command, cwd=root, stdout=pipe, text=True, start_new_session=True) as process:
        assert process.stdout.readline() == "begun\n"
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=30)
    assert (process.returncode, out) == (7, "left")


# ---- the tests themselves -------------------------------------------------------------------------------------------

SENT = signal.SIGINT, signal.SIGTERM
# Prints the signals that a process would not receive.
DEAF = f"""
import signal
print([n for n in {[int(number) for number in SENT]}
       if signal.getsignal(n) == signal.SIG_IGN or n in signal.pthread_sigmask(signal.SIG_BLOCK, ())])
"""
# Starts a command with these signals ignored or blocked, as some shells and test runners start background processes.
BACKGROUND = f"""
import os, signal, sys
for number in {[int(number) for number in SENT]}:
    signal.signal(number, signal.SIG_IGN)
    if sys.argv[1] == "block":
        signal.pthread_sigmask(signal.SIG_BLOCK, [number])
os.execv(sys.argv[2], sys.argv[2:])
"""


def test_signals_that_tests_send_are_heard_here_and_in_processes_that_are_started():
    assert all(signal.getsignal(number) != signal.SIG_IGN for number in SENT)
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(SENT)
    assert subprocess.run([sys.executable, "-c", DEAF], capture_output=True, text=True).stdout == "[]\n"


@pytest.mark.parametrize("how", ["ignore", "block"])
def test_they_are_heard_where_the_tests_run_in_the_background(root, how):
    chosen = f"{__file__}::test_signals_that_tests_send_are_heard_here_and_in_processes_that_are_started"
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", chosen]
    command = [sys.executable, "-c", BACKGROUND, how, *command]
    plain = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(command, cwd=root, env=plain, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout
    assert "1 passed" in done.stdout
