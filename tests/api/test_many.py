"""Many recordings: the same results however they are spread, and none lost to a killed worker."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from measure.api import RunOptions, Workers, load_profile, run, run_many
from measure.errors import ConfigError
from measure.host import Registry
from measure.results import read_run
from tests.dask_cluster import Cluster, wait_for
from tests.simulated.sessions import part_of

SCRIPT = """
import sys
from pathlib import Path
from tests.api.test_many import measure

if __name__ == "__main__":
    out, *sessions = map(Path, sys.argv[1:])
    print([outcome.error for outcome in measure(sessions, out, workers=2)])
"""
FRAMES = 4
QUIET = RunOptions(recording=False)


@pytest.fixture(scope="module")
def sessions(still, tmp_path_factory) -> list[Path]:
    """Three short recordings of one scene, at different times of its motion."""
    folder = tmp_path_factory.mktemp("sessions")
    return [
        part_of(still, range(FRAMES * k, FRAMES * (k + 1)), folder / name)
        for k, name in enumerate(("a", "b", "c"))
    ]


@pytest.fixture(scope="module")
def one_by_one(sessions, tmp_path_factory) -> dict[str, str]:
    """What each recording gives when measured alone."""
    out = tmp_path_factory.mktemp("alone")
    for path in sessions:
        summary = run(path, out / path.name, load_profile(), Registry.discover(), QUIET)
        assert summary.ok + summary.flagged == FRAMES
    return poses(out)


def measure(sessions, out, workers=1, cluster=None, **kwargs):
    who = Workers(workers, cluster)
    return run_many(sessions, out, load_profile(), Registry.discover(), QUIET, who, **kwargs)


def poses(out: Path) -> dict[str, str]:
    return {p.parent.name: p.read_text() for p in sorted(out.glob("*/poses.csv"))}


def leftovers(out: Path) -> list[str]:
    return [p.name for p in out.iterdir() if p.name.startswith(".")]


@pytest.mark.slow
def test_processes_give_identical_results_and_a_broken_recording_stops_none(
    sessions, one_by_one, tmp_path
):
    first, *others = sessions
    seen, out, broken = [], tmp_path / "runs", tmp_path / "broken"
    broken.mkdir()
    outcomes = measure(
        [first, broken, *others], out, workers=2, progress=lambda *args: seen.append(args)
    )
    assert [o.session.name for o in outcomes] == ["a", "broken", "b", "c"]
    assert [bool(o.error) for o in outcomes] == [False, True, False, False]
    assert "session.toml" in outcomes[1].error
    assert outcomes[1].defect == ""
    assert poses(out) == one_by_one
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert leftovers(out) == []
    assert read_run(out / "b").summary.frame_sets == FRAMES


def test_two_recordings_of_one_name_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="two recordings are called 'x'"):
        measure([tmp_path / "1" / "x", tmp_path / "2" / "x"], tmp_path)


def test_no_scheduler_is_said_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("measure.processes._CONNECT_S", 0.3)
    with pytest.raises(ConfigError, match=r"--cluster tcp://127\.0\.0\.1:9: no scheduler"):
        measure([tmp_path / "x"], tmp_path, cluster="tcp://127.0.0.1:9")
    with pytest.raises(ConfigError, match=r"--cluster nonsense: expected .* tcp://HOST:PORT"):
        measure([tmp_path / "x"], tmp_path, cluster="nonsense")


@pytest.mark.slow
def test_a_killed_process_loses_no_recording(sessions, one_by_one, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    root = Path(__file__).resolve().parents[2]
    out = tmp_path / "runs"
    process = subprocess.Popen(
        [sys.executable, script, out, *sessions],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        text=True,
    )
    wait_for(lambda: list(out.glob("*/poses.csv")), process)
    os.kill(worker_of(process.pid), signal.SIGKILL)
    printed, _ = process.communicate(timeout=240)
    assert printed.strip() == "['', '', '']"
    assert poses(out) == one_by_one
    assert leftovers(out) == []


@pytest.mark.slow
def test_a_killed_dask_worker_loses_no_recording(sessions, one_by_one, tmp_path):
    out = tmp_path / "runs"
    with Cluster(tmp_path) as cluster:
        runner = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "measure",
                "run",
                *sessions,
                "-o",
                out,
                "--no-recording",
                "--cluster",
                cluster.address,
                "--json",
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        wait_for(lambda: list(out.glob("*/poses.csv")), runner)
        cluster.workers[0].send_signal(signal.SIGKILL)
        printed, _ = runner.communicate(timeout=240)
        assert runner.returncode == 0
        assert cluster.workers[0].poll() is not None
        assert cluster.workers[1].poll() is None
    runs = json.loads(printed)["runs"]
    assert [run["error"] for run in runs] == [None, None, None]
    assert [run["frame_sets"] for run in runs] == [FRAMES] * 3
    assert poses(out) == one_by_one


def worker_of(parent: int) -> int:
    """The process id of one pool worker: a spawned child that is not the resource tracker."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    for child in map(int, children):
        words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
        if any(b"spawn_main" in word for word in words):
            return child
    raise AssertionError("no worker")
