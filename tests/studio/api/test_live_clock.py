"""The machine's clock is set while cameras are measured."""

from __future__ import annotations

import signal
import sys
import threading
import time
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.faults.hostile_camera import HostileCamera, hostile
from measure.cli import main
from measure.results import read_run
from tests.studio.api.test_live import PERIOD_S, Receiver, words

pytestmark = pytest.mark.usefixtures("signals")


@pytest.fixture
def session(still):
    """Rendered balls, four cameras."""
    return still


@pytest.mark.slow
def test_the_machines_clock_may_be_set_back_meanwhile(session, tmp_path, monkeypatch, capsys):
    """Times go on: those of rows, those that are sent, and no camera seems to be away."""
    pictures = [
        [file.read_bytes() for file in sorted((session / f"cam{k}").glob("*.jpg"))]
        for k in range(4)
    ]
    cameras = [HostileCamera(mine, period_s=PERIOD_S) for mine in pictures]
    clock = SimpleNamespace(**vars(time))
    for module in [one for name, one in sys.modules.items() if name.startswith("measure.")]:
        if getattr(module, "time", None) is time:
            monkeypatch.setattr(module, "time", clock)
    with hostile(cameras) as found, ExitStack() as stack:
        receiver = Receiver(stack)

        def set_back():
            receiver.wait_for(5)
            clock.time = lambda: time.time() - 3600.0
            receiver.wait_for(15)
            signal.raise_signal(signal.SIGINT)

        thread = threading.Thread(target=set_back)
        thread.start()
        stack.callback(thread.join)
        addresses = {f"cam{k}": address for k, address in enumerate(found)}
        more = ("--send", f"udp://127.0.0.1:{receiver.port}", "--seconds", "90", "--no-recording")
        assert main(words("live", session, addresses, tmp_path / "run", *more)) == 0
    assert " is away" not in capsys.readouterr().err
    rows = read_run(tmp_path / "run").poses.to_pylist()
    assert np.all(np.diff([row["time_s"] for row in rows]) > 0)
    assert sum(row["status"] == "ok" for row in rows) > len(rows) / 2
    ages_s = [pose["known_s"] - pose["exposed_s"] for pose in receiver.received]
    assert 0 < min(ages_s) <= max(ages_s) < 10
