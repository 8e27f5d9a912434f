"""`python -m benchmarks`: what can be asked for, and the page it makes."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from benchmarks import any_robot
from benchmarks.__main__ import main
from benchmarks.altered import ALTERATIONS, altered_copy
from benchmarks.recordings import RELIT, UNUSUAL, rendered_scenes
from benchmarks.tables import typical
from benchmarks.tags import FAMILIES, cube, fitted, measured
from measure.session import open_session
from measure.simulation.catalogue import webcam_scene
from measure_learning.robots import find_schema
from tests.simulated.catalogue import relit_scenes, scene_catalogue
from tests.simulated.sessions import part_of
from tests.simulated.unusual import unusual_scenes


def typed(monkeypatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmarks", *words])
    main()


def test_every_scene_is_a_recording() -> None:
    own = [f"own {name}" for name in scene_catalogue()]
    relit = [RELIT + name for name in relit_scenes()]
    unusual = [UNUSUAL + name for name in unusual_scenes()]
    assert list(rendered_scenes()) == own + relit + unusual


def test_unusual_scenes_make_one_table_of_the_default_method(monkeypatch, capsys, tmp_path) -> None:
    page, cache = tmp_path / "page.md", tmp_path / "cache"
    asked = ("--only", "unusual two", "--frames", "2", "--cache", cache, "--out", page)
    typed(monkeypatch, *map(str, asked))
    shown = capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert shown.strip() in text
    assert text.count("\n## ") == 1
    rows = [line for line in shown.splitlines() if line.startswith("| two-cameras |")]
    assert len(rows) == 1
    cells = [cell.strip() for cell in rows[0].strip("|").split("|")]
    assert cells[1] == "precise profile"
    assert 0 < float(cells[3]) < 0.5  # position, mm
    assert [path.name for path in cache.iterdir()] == ["unusual-two-cameras-2"]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--only", "nonsense"), "no recording is called so; there are "),
        (("--only", "nonsense"), "unusual desk-lamp"),
        (("--methods", "nonsense"), "no method is called so; there are paper profile"),
        (("--frames", "1"), "at least 2 are needed"),
    ],
)
def test_what_does_not_exist_is_refused(monkeypatch, capsys, words, complaint) -> None:
    with pytest.raises(SystemExit) as end:
        typed(monkeypatch, *words)
    assert end.value.code == 2
    assert complaint in capsys.readouterr().err


def test_a_session_that_is_not_there_is_one_line(monkeypatch, capsys, tmp_path) -> None:
    from benchmarks.acquisition import main as acquire
    from benchmarks.command import run_command

    monkeypatch.setattr(sys, "argv", ["benchmarks.acquisition", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit) as end:
        run_command(acquire)
    assert end.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith("benchmarks: ")
    assert "nowhere: no such file" in err
    assert err.count("\n") == 1


def test_typical_rows_are_geometric_means_and_mean_shares() -> None:
    figures = ("0.100", "0.010", "0.040", "40", "0", "0", "10", "100", "5.0", "2.0")
    other = ("0.400", "0.040", "0.010", "10", "0", "50", "0", "50", "5.0", "8.0")
    paper = ("0.900", "0.900", "0.900", "90", "0", "0", "0", "0", "9.0", "9.0")
    rows = [("a", "ours", *figures), ("a", "paper", *paper), ("b", "ours", *other)]
    assert typical(rows) == [
        (
            "typical of 2",
            "ours",
            "0.200",
            "0.020",
            "0.020",
            "20",
            "0",
            "25",
            "5",
            "75",
            "5.0",
            "4.0",
        ),
        ("typical of 1", "paper", *paper),
    ]


def test_the_arm_of_the_benchmark_is_a_ur5e_that_errs() -> None:
    """The truth differs from the published arm by about what links and gears were drawn with."""
    arm, published = any_robot.make_arm(), find_schema("ur5e").chain
    q = np.deg2rad(any_robot.HOME_DEG)[None]
    off = np.linalg.norm(arm.pose(q).translation - published.tip_mm(q))
    assert 0.3 < off < 10


def test_the_pose_of_a_cube_follows_from_exact_corners():
    scene = webcam_scene()
    pose = scene.trajectory.at(0.3)
    faces = cube("ArUco 5x5")
    seen = [
        (camera, face.corners(), camera.project(pose.apply(face.corners())))
        for camera in scene.cameras
        for face in faces[:3]
    ]
    found = fitted(seen)
    np.testing.assert_allclose(found.difference(pose), 0, atol=1e-5)
    assert fitted([]) is None


@pytest.mark.parametrize("family", [*FAMILIES][:1])
def test_tags_are_found_where_they_are_drawn(family):
    """One picture a camera: half a pixel of a wrong convention would be .15 mm."""
    found = measured(webcam_scene(), family, np.array([0.1]), 0.0, 0.0)
    assert found.missing == 0
    assert found.position_mm < 0.05
    assert found.rotation_deg < 0.15


@pytest.fixture(scope="module")
def recording(still, tmp_path_factory):
    return part_of(still, range(2), tmp_path_factory.mktemp("altered") / "still")


def _first(folder):
    return cv2.imread(str(sorted(folder.glob("cam0/*.jpg"))[0])).astype(int)


@pytest.mark.parametrize("how", [*ALTERATIONS][::3])
def test_only_pictures_change(recording, tmp_path, how):
    before = _first(recording)
    altered_copy(recording, tmp_path / how, how)
    assert np.array_equal(_first(recording), before)
    assert np.mean(np.abs(_first(tmp_path / how) - before)) > (0.01 if how == "lateral" else 0.5)
    for name in ("truth.csv", "calibration.toml", "body.toml", "cam0.csv"):
        assert (tmp_path / how / name).read_bytes() == (recording / name).read_bytes()
    with open_session(tmp_path / how) as session:
        assert sum(1 for _ in session.frame_sets()) == 2


def test_a_copy_that_is_there_is_kept_and_a_half_made_one_is_not(recording, tmp_path):
    kept, half_made = tmp_path / "kept", tmp_path / "new.part"
    kept.mkdir()
    half_made.mkdir()
    (half_made / "left over").touch()
    altered_copy(recording, kept, "dim")
    altered_copy(recording, tmp_path / "new", "dim")
    assert not list(kept.iterdir())
    assert not (tmp_path / "new" / "left over").exists()
    assert not half_made.exists()
