"""Recordings that are measured in parts, many at once or after a kill, against undisturbed runs."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure import api
from measure.api import RunOptions, Workers, load_profile, measuring, run, run_many, stretches
from measure.cli import main
from measure.errors import ConfigError, RunError, SessionError
from measure.host import Registry
from measure.results import Run, read_run
from tests.dask_cluster import Cluster, wait_for
from tests.simulated.sessions import part_of

pytestmark = pytest.mark.slow

FRAMES = 3
SETS, KEPT = 9, 5
RUN_UP_SETS = 3
QUIET = RunOptions(recording=False)
PRECISE, QUICK = "precise", "paper"
"""The kernels of the second load and run in a third of the time."""


@pytest.fixture(scope="module")
def still(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its first frame sets."""
    return part_of(still, range(SETS), tmp_path_factory.mktemp("still") / "still")


@pytest.fixture(scope="module")
def whole(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run that nobody disturbed."""
    return undisturbed(still, tmp_path_factory.mktemp("whole") / "run", PRECISE)


def undisturbed(session: Path, out: Path, profile: str) -> Run:
    run(session, out, load_profile(profile), Registry.discover(), QUIET)
    return read_run(out)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stretches and run-ups that do not reach over the whole recording."""
    monkeypatch.setattr(stretches, "LEAST_FRAME_SETS", SETS // 3)
    monkeypatch.setattr(measuring, "RUN_UP_S", (RUN_UP_SETS - 0.5) / 30)


def _last_first(jobs: Sequence[Callable[[], object]], _: Workers) -> Iterator[tuple[int, object]]:
    """In this process, where the run-up is short."""
    return ((number, jobs[number]()) for number in reversed(range(len(jobs))))


def measured(
    session: Path, out: Path, workers: Workers, seen: list[int], profile: str = QUICK
) -> Run:
    options, registry = api.RunOptions(images="none"), Registry.discover()
    method = load_profile(profile), registry, options, workers
    api.run_in_stretches(session, out, *method, progress=lambda done, _: seen.append(done))
    return read_run(out)


def off(one: Run, other: Run, start: int = 0) -> tuple[float, float]:
    """Median differences from a frame set on, mm and degrees; both runs have all of them."""
    assert len(one.poses) == len(other.poses) == SETS
    apart = one.world_from_body.difference(other.world_from_body)[start:]
    mm, rad = (np.median(np.linalg.norm(part, axis=1)) for part in np.split(apart, 2, axis=1))
    return float(mm), float(np.degrees(rad))


def agree(one: Run, other: Run) -> None:
    """Tables of the same rows, and poses that differ by a small part of their error."""
    for table in ("poses", "balls", "detections"):
        rows, others = getattr(one, table), getattr(other, table)
        assert rows["index"].to_pylist() == others["index"].to_pylist()
        assert rows.schema == others.schema
    mm, deg = off(one, other)
    assert mm < 0.01
    assert deg < 0.02
    assert one.finished


@pytest.mark.usefixtures("short")
def test_what_no_stretch_can_measure_is_measured_in_turn(
    still: Path, whole: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = stretches._Stretch._rows

    def fails_midway(self: stretches._Stretch) -> object:
        if self.start == SETS // 3:
            raise SessionError("its disk was away")
        return rows(self)

    monkeypatch.setattr(stretches, "spread", _last_first)
    monkeypatch.setattr(stretches._Stretch, "_rows", fails_midway)
    seen = list[int]()
    agree(measured(still, tmp_path / "run", Workers(2), seen, PRECISE), whole)
    assert seen == [SETS // 3, *range(SETS // 3 + 1, SETS + 1)]


def test_workers_that_die_are_said_and_what_was_measured_is_kept(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stretches, "LEAST_FRAME_SETS", SETS // 2)
    monkeypatch.setattr(
        stretches, "spread", lambda jobs, _: iter([(0, jobs[0]()), (1, "its process was killed")])
    )
    with pytest.raises(RunError, match="frame sets 4 and on: its process was killed"):
        measured(still, tmp_path / "run", Workers(1), [])
    kept = (tmp_path / "run" / "poses.csv").read_text().splitlines()
    assert len(kept) == 1 + 4


@pytest.fixture
def killed(still: Path, tmp_path: Path) -> Path:
    """One that ended after `KEPT` frame sets."""

    def stop(done: int, _: int | None) -> None:
        if done == KEPT:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        api.run(still, tmp_path / "run", api.load_profile(), Registry.discover(), progress=stop)
    return tmp_path / "run"


def test_a_resumed_run_agrees_with_the_undisturbed_one_and_measures_what_is_left(
    still: Path,
    killed: Path,
    whole: Run,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With a run-up that does not reach back to the start: nothing is compared with itself."""
    begun, measure = list[int](), measuring.measure_frame_sets

    def watched(pipelines: object, frame_sets: object) -> object:
        for frame_set, measured in measure(pipelines, frame_sets):
            begun.append(frame_set.index)
            yield frame_set, measured

    monkeypatch.setattr(measuring, "measure_frame_sets", watched)
    monkeypatch.setattr(measuring, "RUN_UP_S", (RUN_UP_SETS - 0.5) / 30)
    kept = (killed / "poses.csv").read_bytes()
    assert main(["run", str(still), "-o", str(killed), "--resume"]) == 0
    assert f"resumed at frame set {KEPT} of {SETS}" in capsys.readouterr().err
    assert begun == list(range(KEPT - RUN_UP_SETS + 1, SETS))
    assert (killed / "poses.csv").read_bytes().startswith(kept)
    resumed = read_run(killed)
    assert resumed.finished
    assert resumed.poses["index"].to_pylist() == list(range(SETS))
    mm, deg = off(resumed, whole, KEPT)
    assert mm < 0.01
    assert deg < 0.02


def test_the_comparison_notices_a_run_that_goes_on_in_the_wrong_place(whole: Run) -> None:
    rows = whole.poses.to_pylist()
    late = [*rows[:KEPT], *rows[KEPT - 1 : -1]]
    moved = replace(whole, poses=whole.poses.from_pylist(late, whole.poses.schema))
    mm, _ = off(moved, whole, KEPT)
    assert mm > 0.01


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
        summary = run(path, out / path.name, load_profile(QUICK), Registry.discover(), QUIET)
        assert summary.ok + summary.flagged == FRAMES
    return poses(out)


def measure(sessions, out, workers=1, cluster=None, **kwargs):
    method = load_profile(QUICK), Registry.discover(), QUIET, Workers(workers, cluster)
    return run_many(sessions, out, *method, **kwargs)


def poses(out: Path) -> dict[str, str]:
    return {p.parent.name: p.read_text() for p in sorted(out.glob("*/poses.csv"))}


def leftovers(out: Path) -> list[str]:
    return [p.name for p in out.iterdir() if p.name.startswith(".")]


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


@pytest.fixture(scope="module")
def cluster(tmp_path_factory) -> Iterator[Cluster]:
    """Two workers; the last test that uses them kills one."""
    with Cluster(tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


def test_a_cluster_measures_stretches_of_one_recording(cluster, still, tmp_path, monkeypatch):
    monkeypatch.setattr(stretches, "LEAST_FRAME_SETS", SETS // 3)
    workers = Workers(cluster=cluster.address)
    assert workers.available() == 2
    seen = list[int]()
    run = measured(still, tmp_path / "run", workers, seen)
    agree(run, undisturbed(still, tmp_path / "whole", QUICK))
    assert seen == [3, 6, 9]
    assert (run.path / "run.rrd").stat().st_size > 100_000


def test_a_killed_dask_worker_loses_no_recording(cluster, sessions, one_by_one, tmp_path):
    out = tmp_path / "runs"
    command = [sys.executable, "-m", "measure", "run", *sessions, "-o", out, "--no-recording"]
    how = ["--profile", QUICK, "--cluster", cluster.address, "--json"]
    runner = subprocess.Popen([*command, *how], stdout=subprocess.PIPE, text=True)
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
