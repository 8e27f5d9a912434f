"""The report of a run: complete, self-contained, and there also when nothing was measured."""

from __future__ import annotations

import base64
import html
import json
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
from measurements import BODY, CAMERAS, measurement

from measure.api.profiles import load_profile
from measure.api.run import resolved
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model import Doubt
from measure.results import Provenance, RunWriter, read_run
from measure.session import read_body
from measure.viewing.report import figures
from measure_lab.api import report
from measure_lab.run_report import accuracy_map, run_report
from measure_lab.verdict import verdict
from measure_learning.core.frames import RobotFrame, write_frame

PROVENANCE = Provenance("/data/s", "a", "calibration.toml", "b", "c", {"name": "precise"}, {})


@pytest.fixture(autouse=True)
def _coarse_maps(monkeypatch):
    """Of 3 x 3 places: a fine one takes most of a report's time."""
    monkeypatch.setattr("measure_lab.run_report._STEPS", 3)


def _run(folder, count, lost=(), finish=True, measure=None, cameras=CAMERAS, provenance=PROVENANCE):
    with RunWriter(folder, provenance, [BODY], cameras) as writer:
        for index in range(count):
            writer.append(measure(index) if measure else measurement(index, lost=index in lost))
        if finish:
            writer.finish()
    return read_run(folder)


def _figures(page):
    return len(re.findall('class="figure"', page))


def test_a_good_run_says_how_well_the_position_is_known(tmp_path):
    page = run_report([_run(tmp_path / "run", 40)], [np.full((40, 6), 0.01)])
    assert "Position known to 0.028 mm (95 %) within this rig, 2 of 2 cameras carry it." in page
    assert 'class="verdict good"' in page
    for heading in ("Error against truth", "Trajectory", "Rotation and speed", "Ball distances"):
        assert f"<h2>{heading}</h2>" in page
    assert _figures(page) >= 12


def test_a_report_names_the_recording_and_the_day(tmp_path):
    named = replace(PROVENANCE, session_name="white room")
    for name, made_from, title in (
        ("run", PROVENANCE, "Run of s"),
        ("s", PROVENANCE, "Run s"),
        ("other", named, "Run other of white room"),
    ):
        page = run_report([_run(tmp_path / name, 5, (0, 1, 2, 3, 4), provenance=made_from)])
        assert f"<title>{title}</title>" in page
        assert re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", page)


def test_a_run_in_a_folder_whose_name_is_no_text_has_a_report(tmp_path):
    folder = tmp_path / "s\udcff"
    try:
        run = _run(folder, 5)
    except OSError:
        pytest.skip("this file system knows no such names")
    assert report(run.path) == folder / "report.html"
    assert r"<title>Run s\udcff of s</title>" in (folder / "report.html").read_text("utf-8")


def test_missing_poses_make_the_verdict_doubtful(tmp_path):
    page = run_report([_run(tmp_path / "run", 40, lost={3, 4})])
    assert "2 of 40 frame sets without a pose" in page
    assert 'class="verdict doubtful"' in page


def test_an_unfinished_run_says_so(tmp_path):
    assert "the run is not finished" in run_report([_run(tmp_path / "run", 40, finish=False)])


def test_a_run_without_any_pose_has_a_report_that_says_why(tmp_path):
    page = run_report([_run(tmp_path / "run", 20, lost=range(20))])
    assert "No pose in 20 frame sets (nothing seen)." in page
    assert 'class="verdict bad"' in page
    assert "Trajectory" not in page


def test_flagged_poses_do_not_count_as_known(tmp_path):
    def doubted(index):
        doubt = Doubt("off-the-fit", ball="red", camera="cam0", off_px=8 + index % 2)
        return measurement(index).flagged(doubt)

    run = _run(tmp_path / "all", 20, measure=doubted)
    tone, sentence = verdict(run, None)
    assert tone == "bad"
    why = "(red in cam0 sits 8.0-9.0 px off the fit)"
    assert sentence == f"No pose to rely on: all of 20 frame sets are flagged {why}."
    mixed = _run(tmp_path / "most", 20, measure=lambda i: doubted(i) if i > 7 else measurement(i))
    tone, sentence = verdict(mixed, None)
    assert tone == "bad"
    assert f"the pose is doubtful in 12 of 20 frame sets {why}" in sentence


def test_report_quotes_truth_and_flags_overconfidence(tmp_path):
    run = _run(tmp_path / "run", 40)
    small, large = np.zeros((40, 6)), np.zeros((40, 6))
    small[:, 0], large[:, 0] = 0.01, 0.1
    tone, sentence = verdict(run, small)
    assert tone == "good"
    assert "Against the truth it is off by 0.010 mm RMS, 0.010 mm at most." in sentence
    tone, sentence = verdict(run, large)
    assert tone == "doubtful"
    assert "more than it claims, for only 0% of the errors lie inside" in sentence


def test_what_all_frame_sets_err_by_alike_is_said(tmp_path):
    tone, sentence = verdict(_run(tmp_path / "run", 20), None)
    assert "The calibration is taken as exact: its file states no uncertainty." in sentence
    assert "Balls are taken to sit where the body file says: it states no tolerance_mm." in sentence
    scaled = _run(tmp_path / "scaled", 20, provenance=replace(PROVENANCE, scale_sd=6e-4))
    exact = "The calibration is taken as exact but for the world's scale (0.06%): its file states"
    assert exact in verdict(scaled, None)[1]
    assert "the body file says 76" not in sentence
    assert tone == "good"
    known = [replace(c, pose_covariance=np.diag([1e-5] * 3 + [1e-10] * 3)) for c in CAMERAS]

    def longer(index):
        """Green sits 0.7 mm farther out than the body file says, give or take 0.05 mm."""
        seen = measurement(index)
        green, *rest = seen.positions
        out = 0.7 + 0.05 * np.sin(index)
        place = seen.pose.world_from_body
        moved = replace(green, center=green.center + place.rotate([out, 0.0, 0.0]))
        return replace(seen, positions=(moved, *rest))

    tone, sentence = verdict(_run(tmp_path / "long", 20, measure=longer, cameras=known), None)
    assert "taken as exact" not in sentence
    assert re.search(
        r"76\.7\d \+- 0\.\d\d mm between green and red, the body file says 76", sentence
    )
    assert tone == "doubtful"


def test_a_camera_that_never_helps_is_named(tmp_path):
    def alone(index):
        seen = measurement(index)
        return replace(seen, pose=replace(seen.pose, cameras=("cam0",)))

    _, sentence = verdict(_run(tmp_path / "run", 20, measure=alone), None)
    assert "1 of 2 cameras carry it (cam1 never)" in sentence


def test_the_accuracy_map_agrees_with_the_run_where_the_body_was(tmp_path):
    run = _run(tmp_path / "run", 40)
    there = accuracy_map(run, (0, 1))
    middle = there.sd_mm[1, 1]
    assert middle == pytest.approx(run.summary.position_sd_mm, rel=0.05)
    assert not there.from_calibration
    assert there.across_mm[1] == pytest.approx(np.mean([0, 3.9]), abs=1e-9)


def test_a_calibration_known_badly_weighs_where_pictures_do_not(tmp_path):
    """Away from the cameras the pictures' part grows; the calibration's is counted once."""
    loose = [replace(c, pose_covariance=np.diag([1e-5] * 3 + [1e-10] * 3)) for c in CAMERAS]
    run = _run(tmp_path / "run", 40, cameras=loose)
    there = accuracy_map(run, (0, 1))
    assert there.from_calibration
    assert there.sd_mm[1, 1] == pytest.approx(run.summary.position_sd_mm, rel=0.05)


def test_a_place_that_one_camera_sees_has_no_expected_accuracy(tmp_path):
    def far(index):
        seen = measurement(index)
        place = seen.pose.world_from_body
        moved = RigidTransform(place.rotation, place.translation + np.array([20.0 * index, 0, 0]))
        return replace(seen, pose=replace(seen.pose, world_from_body=moved))

    there = accuracy_map(_run(tmp_path / "run", 20, measure=far), (0, 1))
    assert np.isnan(there.sd_mm).any()
    assert np.isfinite(there.sd_mm).any()


def test_the_command_that_repeats_a_run_uses_what_the_run_used(tmp_path):
    profile = load_profile().with_setting("detector", "rays", 40)
    made = replace(PROVENANCE, profile=resolved(profile, Registry.discover()))
    page = run_report([_run(tmp_path / "run", 10, provenance=made)])
    (command,) = re.findall(r"<pre>(measure run .*?)</pre>", page)
    words = shlex.split(html.unescape(command))
    options = dict(zip(words[3::2], words[4::2], strict=True))
    assert words[2] == "s"
    assert options["--calibration"] == "calibration.toml"
    again = load_profile(str(tmp_path / options["--profile"]))
    assert again.settings["detector"]["rays"] == 40
    assert resolved(again, Registry.discover()) == made.profile
    assert read_body(tmp_path / options["--body"]).names == BODY.names


def _traces(page, kind):
    """The traces of one kind of all figures of a page."""
    every = [trace for spec in _specs(page) for trace in spec["data"]]
    return [trace for trace in every if trace["type"] == kind]


def _specs(page):
    """The figures of a page as plotly takes them."""
    specs = re.findall(r'class="spec"[^>]*>(.*?)</script>', page, flags=re.DOTALL)
    return [json.loads(spec) for spec in specs]


def _values(packed):
    """Numbers as plotly writes them."""
    if isinstance(packed, dict):
        return np.frombuffer(base64.b64decode(packed["bdata"]), packed["dtype"])
    return np.array([np.nan if value is None else value for value in packed], dtype=float)


def _flagged_once(index):
    made = measurement(index, lost=index == 4)
    return made.flagged("red sits 9 px off") if index == 7 else made


def test_flagged_and_lost_poses_are_gaps_in_the_trajectory(tmp_path):
    page = run_report([_run(tmp_path / "run", 12, measure=_flagged_once)])
    by_name = {trace["name"]: trace for trace in _traces(page, "scatter3d")}
    way = _values(by_name["body"]["x"])
    assert np.flatnonzero(~np.isfinite(way)).tolist() == [4, 7]
    assert len(_values(by_name["flagged"]["x"])) == 1
    assert re.search(r"<td[^>]*>red sits 9 px off</td><td>1</td>", page)


def test_poses_are_shown_in_the_axes_of_a_robots_base(tmp_path):
    """The pictures do not change, uncertainty turns along, and what has no pose still has none."""
    run = _run(tmp_path / "run", 12, lost=(4,))
    base_from_world = RigidTransform.from_rotvec([0.3, -1.1, 0.6], [500.0, -80, 20])
    moved = run.in_frame(base_from_world)
    np.testing.assert_array_equal(moved.has_pose, run.has_pose)
    for before, after in zip(run.cameras, moved.cameras, strict=True):
        for k in range(11):
            seen = [
                camera.project(one.world_from_body[k].apply(BODY.centers))
                for camera, one in ((before, run), (after, moved))
            ]
            np.testing.assert_allclose(*seen, atol=1e-6)
    turn = np.kron(np.eye(2), base_from_world.rotation)
    np.testing.assert_allclose(moved.covariances, turn @ run.covariances @ turn.T, atol=1e-12)
    assert np.linalg.norm(moved.world_from_body.translation - run.world_from_body.translation) > 100
    poses = base_from_world.inverse(), RigidTransform.identity()
    file = tmp_path / "frame.toml"
    write_frame(file, RobotFrame("ur5e", *poses, {"run": 0.0}, np.eye(12), (), {}))
    for frame in (file, None):
        page = report(run.path, tmp_path / "page.html", overwrite=True, frame=frame)
        said = "In axes of the robot's base" in html.unescape(page.read_text("utf-8"))
        assert said == (frame is not None)


def test_the_page_is_self_contained_and_small(tmp_path):
    page = run_report([_run(tmp_path / "run", 60)])
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"src=|href=(?!\"#)|@import|url\(", markup)
    assert "<script src" not in page
    assert len(page.encode()) < 8_000_000


def test_a_spike_does_not_flatten_a_plot():
    values = 1 + 0.01 * np.sin(np.arange(100.0))
    assert figures.over_time(np.arange(100.0), {"SD": values}, "SD [mm]").layout.yaxis.range is None
    values[50] = 20.0
    drawn = figures.over_time(np.arange(100.0), {"SD": values}, "SD [mm]")
    low, high = drawn.layout.yaxis.range
    assert 0.98 < low < 0.99 < 1.01 < high < 1.02
    assert "spikes are cut off" in drawn.layout.annotations[0].text
