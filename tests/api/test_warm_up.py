"""What is slow at the start is done before the first frame, and said if it takes long."""

from __future__ import annotations

import importlib
import logging
import time

import numba
from measurements import BODY, CAMERAS
from numba.core import event

from measure.api import RunOptions, load_profile, second_compiler, warming_up
from measure.host import Registry
from tests.session.conftest import write_recording


def _add_one(x):
    return x + 1


def _wait_for(count, caplog):
    """A thread tells; it may be late on a busy machine."""
    until_s = time.monotonic() + 20.0
    while caplog.text.count("compiling") < count and time.monotonic() < until_s:
        time.sleep(0.02)


def test_only_a_long_warm_up_is_explained(monkeypatch, caplog):
    monkeypatch.setattr(warming_up, "PATIENCE_S", 0.05)
    with caplog.at_level(logging.WARNING):
        with warming_up.compilation_notice():
            pass
        time.sleep(0.1)
        assert caplog.text == ""
        with warming_up.compilation_notice():
            time.sleep(0.2)
        assert caplog.text == "", "nothing was compiled: it was something else that took long"
        with warming_up.compilation_notice():
            numba.njit(_add_one)(1)
            _wait_for(1, caplog)
    assert "compiling" in caplog.text
    assert "done" not in caplog.text


def test_processes_share_what_the_first_has_compiled(monkeypatch, tmp_path):
    """Sessions that cannot be opened are passed over: their jobs say why."""
    many = importlib.import_module("measure.api.many")
    warmed = []
    monkeypatch.setattr(many, "warm_pipeline", lambda *what: warmed.append(what[2]))
    good = write_recording(tmp_path / "good").path
    jobs = [
        many._RecordingJob(path, tmp_path / "run", None, None, RunOptions(), tmp_path / "begun")
        for path in (tmp_path / "none", good, good)
    ]
    many._compile_once(jobs)
    assert [len(body.balls) for body in warmed] == [3]


def _begun_when_compiling(work):
    compiler = second_compiler.SecondCompiler(work)
    with event.install_listener("numba:compile", compiler):
        assert compiler.process is None, "nothing is compiled yet"
        numba.njit(_add_one)(1)
    return compiler


def _work():
    return load_profile("paper"), Registry.discover(), BODY, CAMERAS


def test_second_process_compiles_every_stage():
    compiler = _begun_when_compiling(_work())
    compiler.process.wait(60)
    compiler.end()
    assert compiler.process.returncode == 0


def test_a_second_process_is_not_left_behind():
    compiler = _begun_when_compiling(_work())
    compiler.end()
    assert compiler.process.returncode not in (None, 0)


def test_one_core_or_unpicklable_stages_start_no_second_process(monkeypatch):
    assert _begun_when_compiling((lambda: None,)).process is None
    monkeypatch.setattr(second_compiler, "usable_cores", lambda: 1)
    alone = _begun_when_compiling(_work())
    alone.end()
    assert alone.process is None
