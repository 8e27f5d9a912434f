"""A recording measured in stretches, against one run that nobody disturbed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from measure import api
from measure.api import measuring, stretches
from measure.errors import RunError, SessionError
from measure.host import Registry
from measure.results import Run, read_run
from tests.dask_cluster import Cluster

SETS = 12
RUN_UP_SETS = 3

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def whole(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp("whole") / "run"
    quiet = api.RunOptions(recording=False)
    api.run(still, out, api.load_profile(), Registry.discover(), quiet)
    return read_run(out)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stretches and run-ups that do not reach over the whole recording."""
    monkeypatch.setattr(stretches, "LEAST_FRAME_SETS", SETS // 3)
    monkeypatch.setattr(measuring, "RUN_UP_S", (RUN_UP_SETS - 0.5) / 30)


def _last_first(
    jobs: Sequence[Callable[[], object]], _: api.Workers
) -> Iterator[tuple[int, object]]:
    """In this process, where the run-up is short."""
    return ((number, jobs[number]()) for number in reversed(range(len(jobs))))


def measured(session: Path, out: Path, workers: api.Workers, seen: list[int]) -> Run:
    options, registry = api.RunOptions(image_every=0), Registry.discover()
    method = api.load_profile(), registry, options, workers
    api.run_in_stretches(session, out, *method, progress=lambda done, _: seen.append(done))
    return read_run(out)


def agree(one: Run, other: Run) -> None:
    """Tables of the same rows, and poses that differ by a small part of their error."""
    for table in ("poses", "balls", "detections"):
        rows, others = getattr(one, table), getattr(other, table)
        assert rows["index"].to_pylist() == others["index"].to_pylist()
        assert rows.schema == others.schema
    apart = one.world_from_body.difference(other.world_from_body)
    mm, rad = (np.median(np.linalg.norm(part, axis=1)) for part in np.split(apart, 2, axis=1))
    assert mm < 0.01
    assert np.degrees(rad) < 0.02
    assert one.finished


@pytest.mark.usefixtures("short")
def test_stretches_of_any_order_agree_with_the_undisturbed_run(
    still: Path, whole: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stretches, "spread", _last_first)
    seen = list[int]()
    run = measured(still, tmp_path / "run", api.Workers(2), seen)
    assert seen == [4, 8, 12]
    agree(run, whole)
    assert (run.path / "run.rrd").stat().st_size > 100_000


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
    agree(measured(still, tmp_path / "run", api.Workers(2), seen), whole)
    assert seen == [4, *range(5, SETS + 1)]


def test_workers_that_die_are_said_and_what_was_measured_is_kept(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stretches, "LEAST_FRAME_SETS", SETS // 2)
    monkeypatch.setattr(
        stretches, "spread", lambda jobs, _: iter([(0, jobs[0]()), (1, "its process was killed")])
    )
    with pytest.raises(RunError, match="frame sets 6 and on: its process was killed"):
        measured(still, tmp_path / "run", api.Workers(1), [])
    kept = (tmp_path / "run" / "poses.csv").read_text().splitlines()
    assert len(kept) == 1 + SETS // 2


def test_a_cluster_measures_stretches_of_one_recording(
    still: Path, whole: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stretches, "LEAST_FRAME_SETS", SETS // 3)
    with Cluster(tmp_path) as cluster:
        workers = api.Workers(cluster=cluster.address)
        assert workers.available() == 2
        seen = list[int]()
        agree(measured(still, tmp_path / "run", workers, seen), whole)
    assert seen == [4, 8, 12]
