"""Processes that work for another one end with it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys

import pytest

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


def test_they_end_when_their_parent_is_killed(tmp_path):
    assert ends_with_parent(tmp_path, "measure.processes", "processes", within_s=10)


def test_those_of_a_plain_pool_do_not(tmp_path):
    assert not ends_with_parent(tmp_path, "concurrent.futures", "ProcessPoolExecutor", within_s=2)
