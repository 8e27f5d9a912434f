"""A real dask cluster on this machine, one of whose workers a test may kill."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self


class Cluster:
    """A dask scheduler and two single-threaded workers, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        file = folder / "scheduler.json"
        common = ["--scheduler-file", str(file), "--no-dashboard", "--host", "127.0.0.1"]
        self.scheduler = _start("scheduler", *common, "--port", "0", log=folder / "scheduler.log")
        wait_for(lambda: file.exists() and file.stat().st_size, self.scheduler)  # is written
        common += ["--nthreads", "1", "--no-nanny", "--local-directory", str(folder)]
        self.workers = [_start("worker", *common, log=folder / f"worker{k}.log") for k in range(2)]
        self.address = json.loads(file.read_text())["address"]

    def __enter__(self) -> Self:
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        return self

    def __exit__(self, *_: object) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


def _start(part: str, *words: str, log: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", f"distributed.cli.dask_{part}", *words]
    with log.open("wb") as out:
        return subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)


def wait_for(done: Callable[[], Any], process: subprocess.Popen, timeout_s: float = 120.0) -> None:
    """Until `done()`, while a process is working."""
    end = time.monotonic() + timeout_s
    while not done():
        assert process.poll() is None, "it ended before anything was done"
        assert time.monotonic() < end
        time.sleep(0.02)
