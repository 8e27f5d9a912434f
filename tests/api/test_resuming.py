"""A run that is killed and resumed, against one that nobody disturbed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure import api
from measure.api import measuring
from measure.cli import main
from measure.host import Registry
from measure.results import Run, read_run

SETS, KEPT = 12, 7
RUN_UP_SETS = 3

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def whole(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run that nobody disturbed."""
    out = tmp_path_factory.mktemp("whole") / "run"
    api.run(still, out, api.load_profile(), Registry.discover())
    return read_run(out)


@pytest.fixture
def killed(still: Path, tmp_path: Path) -> Path:
    """One that ended after `KEPT` frame sets."""

    def stop(done: int, _: int | None) -> None:
        if done == KEPT:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        api.run(still, tmp_path / "run", api.load_profile(), Registry.discover(), progress=stop)
    return tmp_path / "run"


def off(one: Run, other: Run) -> tuple[float, float]:
    """Median differences after the gap, mm and degrees; both runs have all frame sets."""
    assert len(one.poses) == len(other.poses) == SETS
    apart = one.world_from_body.difference(other.world_from_body)[KEPT:]
    mm, rad = (np.median(np.linalg.norm(part, axis=1)) for part in np.split(apart, 2, axis=1))
    return float(mm), float(np.degrees(rad))


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
    mm, deg = off(resumed, whole)
    assert mm < 0.01
    assert deg < 0.02


def test_the_comparison_notices_a_run_that_goes_on_in_the_wrong_place(whole: Run) -> None:
    rows = whole.poses.to_pylist()
    late = [*rows[:KEPT], *rows[KEPT - 1 : -1]]
    moved = replace(whole, poses=whole.poses.from_pylist(late, whole.poses.schema))
    mm, _ = off(moved, whole)
    assert mm > 0.01
