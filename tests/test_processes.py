"""Processes that work for another one end with it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from measure.api import Workers
from measure.api.spreading import spread
from measure.processes import until_stopped

SCRIPT = """
import os, time
from {module} import {name}

if __name__ == "__main__":
    with {name}(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 20).result()
"""
pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="nothing can be killed here")


def ends_with_parent(tmp_path, module, name, within_s):
    """Whether a pool's process does, when the process that has the pool is killed."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(module=module, name=name))
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE) as parent:
        worker = int(parent.stdout.readline())
        os.kill(parent.pid, signal.SIGKILL)
        # It ends, and can be read from, once nobody is left who might write.
        ended, _, _ = select.select([parent.stdout], [], [], within_s)
        if not ended:
            os.kill(worker, signal.SIGKILL)
    return bool(ended)


def once_killed(mark, other):
    if not mark.exists():
        mark.touch()
        while not other.exists():
            time.sleep(0.01)
        if mark.name == "a":
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(60)  # ended with its pool
    return mark.name


def test_a_job_whose_process_is_killed_is_begun_again(tmp_path):
    jobs = [partial(once_killed, tmp_path / name, tmp_path / other) for name, other in ("ab", "ba")]
    assert dict(spread(jobs, Workers(2))) == {0: "a", 1: "b"}


def test_they_end_when_their_parent_is_killed(tmp_path):
    assert ends_with_parent(tmp_path, "measure.processes", "processes", within_s=10)


def test_those_of_a_plain_pool_do_not(tmp_path):
    assert not ends_with_parent(tmp_path, "concurrent.futures", "ProcessPoolExecutor", within_s=2)


UNWOUND = """
import os, sys, time
from pathlib import Path
from measure.processes import Terminated, processes, unwound_by_signals


def hold(folder):
    try:
        (folder / "lock").touch()
        time.sleep(60)
    finally:
        (folder / "lock").unlink()


if __name__ == "__main__":
    try:
        with unwound_by_signals(), processes(1) as pool:
            print(pool.submit(os.getpid).result(), flush=True)
            pool.submit(hold, Path(sys.argv[1])).result()
    except Terminated as end:
        sys.exit(128 + end.signal)
"""


def test_they_give_up_what_they_hold_when_their_parent_is_terminated(tmp_path):
    script, lock = tmp_path / "script.py", tmp_path / "lock"
    script.write_text(UNWOUND)
    command = [sys.executable, script, tmp_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as parent:
        worker = int(parent.stdout.readline())
        while not lock.exists():
            assert parent.poll() is None
            time.sleep(0.01)
        parent.terminate()
        _, said = parent.communicate(timeout=30)
    assert (parent.returncode, said) == (143, b"")
    assert not lock.exists()
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_lets_work_end_in_order(name):
    number = getattr(signal, name)
    before = signal.getsignal(number)
    with until_stopped() as stop:
        signal.raise_signal(number)
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)  # the second ends it at once
    assert signal.getsignal(number) is before


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_a_signal_that_is_ignored_stops_nothing(name):
    number = getattr(signal, name)
    signal.signal(number, signal.SIG_IGN)
    with until_stopped() as stop:
        signal.raise_signal(number)
        assert not stop.is_set()
        signal.raise_signal(signal.SIGTERM)
        assert stop.is_set()
    assert signal.getsignal(number) is signal.SIG_IGN


CLOSED = """
import fcntl, signal, sys, termios, time
from contextlib import nullcontext
from pathlib import Path
from threading import Event
from measure.processes import Terminated, until_stopped, unwound_by_signals

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it, for all that it begins
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
out = Path(sys.argv[1])
try:
    with unwound_by_signals(), {} as stop:
        out.with_suffix(".begun").touch()
        while not stop.is_set():
            time.sleep(0.01)
except Terminated:
    pass
print("a line for nobody", flush=True)
print("another", file=sys.stderr, flush=True)
out.touch()
"""


@pytest.mark.parametrize("stop", ["until_stopped()", "nullcontext(Event())"])
def test_a_closed_terminal_lets_work_end_in_order(tmp_path, stop):
    """Every line that is written to it would be an error."""
    pty = pytest.importorskip("pty")
    terminal, theirs = pty.openpty()
    script, out = tmp_path / "script.py", tmp_path / "out"
    script.write_text(CLOSED.format(stop))
    streams = {"stdin": theirs, "stdout": theirs, "stderr": theirs}
    with subprocess.Popen([sys.executable, script, out], start_new_session=True, **streams) as one:
        os.close(theirs)
        while not out.with_suffix(".begun").exists():
            assert one.poll() is None
            time.sleep(0.01)
        os.close(terminal)
        try:
            assert one.wait(30) == 0
        finally:
            one.kill()
    assert out.exists()
