"""The report of a run: complete, self-contained, and there also when nothing was measured."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from measurements import BODY, CAMERAS, measurement

from measure.results import Provenance, RunWriter, read_run
from measure.viewing.report.run_report import run_report

PROVENANCE = Provenance("/data/s", "a", "calibration.toml", "b", "c", {"name": "precise"}, {})


def _run(folder, count, lost=(), finish=True):
    with RunWriter(folder, PROVENANCE, BODY, CAMERAS) as writer:
        for index in range(count):
            writer.append(measurement(index, lost=index in lost))
        if finish:
            writer.finish()
    return read_run(folder)


def _figures(page):
    return len(re.findall('class="figure"', page))


def test_a_good_run_says_how_well_the_position_is_known(tmp_path):
    page = run_report(_run(tmp_path / "run", 40), errors=np.full((40, 6), 0.01))
    assert "Position known to 0.028 mm (95 %), 2 of 2 cameras carry it." in page
    assert 'class="verdict good"' in page
    for heading in ("Error against truth", "Trajectory", "Who saw what when", "Ball distances"):
        assert f"<h2>{heading}</h2>" in page
    assert _figures(page) >= 12


def test_missing_poses_make_the_verdict_doubtful(tmp_path):
    page = run_report(_run(tmp_path / "run", 40, lost={3, 4}))
    assert "2 of 40 frame sets without a pose" in page
    assert 'class="verdict doubtful"' in page


def test_an_unfinished_run_says_so(tmp_path):
    assert "the run is not finished" in run_report(_run(tmp_path / "run", 40, finish=False))


def test_a_run_without_any_pose_has_a_report_that_says_why(tmp_path):
    page = run_report(_run(tmp_path / "run", 20, lost=range(20)))
    assert "No pose in 20 frame sets. nothing seen" in page
    assert 'class="verdict bad"' in page
    assert "Trajectory" not in page


def test_the_page_is_self_contained_and_small(tmp_path):
    page = run_report(_run(tmp_path / "run", 60))
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search("src=|href=|@import|url\\(", markup)
    assert "<script src" not in page
    assert len(page.encode()) < 8_000_000


@pytest.mark.slow
def test_ten_thousand_frame_sets_still_make_a_page_below_eight_megabytes(tmp_path):
    page = run_report(_run(tmp_path / "run", 10_000))
    assert len(page.encode()) < 8_000_000
    assert "10000" in page


def test_shipped_page_names_no_other_host():
    sources = Path(__file__).resolve().parents[2] / "measure/viewing/report"
    text = "".join(path.read_text("utf-8") for path in sources.glob("*.py"))
    assert "http" not in text
