"""`measure calibrate` of a session in which the body is waved: what it finds and refuses."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from measure.api import calibrating_by_body
from measure.cli import main
from measure.geometry import align_points
from measure.session import read_calibration


def without_calibration(render: Path, folder: Path) -> Path:
    """A copy of a session that names neither calibration nor truth."""
    shutil.copytree(render, folder)
    (folder / "calibration.toml").unlink()
    text = (folder / "session.toml").read_text("utf-8")
    text = re.sub(r"^(calibration|truth) = .*\n", "", text, flags=re.MULTILINE)
    (folder / "session.toml").write_text(text, "utf-8")
    return folder


def lenses_alone(calibration: Path, to: Path) -> Path:
    """The calibration's lenses without any pose."""
    lines = calibration.read_text("utf-8").splitlines(keepends=True)
    to.write_text("".join(x for x in lines if not x.startswith(("quat_", "translation_"))), "utf-8")
    return to


def calibrated(session: Path, out: Path, *options: object) -> int:
    body = session / "body.toml"
    return main(
        ["calibrate", str(session), "--body", str(body), "-o", str(out), *map(str, options)]
    )


@pytest.fixture
def still(renders, tmp_path) -> Path:
    return without_calibration(renders / "still", tmp_path / "still")


@pytest.mark.slow
@pytest.mark.parametrize("searched", [60, 16], ids=["all at once", "a few, then those beside"])
def test_all_cameras_are_found_without_a_board_or_a_first_calibration(
    still, renders, tmp_path, capsys, monkeypatch, searched
):
    """Of 30 frame sets; a longer recording's cameras are found by some of them first."""
    monkeypatch.setattr(calibrating_by_body, "_SEARCHED", searched)
    true = renders / "still" / "calibration.toml"
    lenses = lenses_alone(true, tmp_path / "lenses.toml")
    out = tmp_path / "found.toml"
    assert calibrated(still, out, "--lenses", lenses, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["method"] == "body"
    assert told["judgement"]["trustworthy"]
    found, expected = read_calibration(out), read_calibration(true)
    assert found.names == expected.names
    # The world is the first camera's frame.
    assert np.linalg.norm(found.cameras[0].center) < 1e-3
    # A place in the workspace is seen where it should be, once the worlds are laid on each other.
    centers, true_centers = (
        np.stack([camera.center for camera in one.cameras]) for one in (found, expected)
    )
    world = align_points(true_centers, centers)
    assert np.linalg.norm(world.apply(centers) - true_centers, axis=1).max() < 4.0
    joint = np.array(told["joint_covariance"])
    assert joint.shape == (24, 24)
    # Balls within 0.05 mm of their places, 62 mm from their middle (root of the sum of squares).
    assert found.scale_sd >= 0.05 / 62.1
    assert out.with_suffix(".html").stat().st_size > 10_000


@pytest.mark.slow
def test_a_small_motion_leaves_unknown_lenses_open(still, tmp_path, capsys):
    assert calibrated(still, tmp_path / "found.toml") == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert "this motion leaves the lenses open: the focal length of cam" in told
    assert "wave the body nearer to cam" in told
    assert "--lenses" in told
    assert not (tmp_path / "found.toml").exists()


@pytest.mark.slow
def test_a_wide_motion_tells_unknown_lenses(shared, tmp_path, capsys):
    """A body waved through 270 x 200 x 150 mm: focal lengths are right as far as is stated."""
    render = shared / "renders" / "waved"
    session = without_calibration(render, tmp_path / "waved")
    assert calibrated(session, tmp_path / "found.toml", "--json") == 0
    capsys.readouterr()
    found = read_calibration(tmp_path / "found.toml")
    for camera, true in zip(
        found.cameras, read_calibration(render / "calibration.toml").cameras, strict=True
    ):
        lens, expected = camera.intrinsics, np.diag(true.intrinsics.matrix)[:2]
        sds = np.sqrt(np.diag(lens.covariance)[:2])
        off = np.diag(lens.matrix)[:2] - expected
        assert np.all(np.abs(off) < 3 * sds)
        assert np.all(sds < 0.01 * expected)


def test_a_body_at_rest_is_refused(still, renders, tmp_path, capsys):
    for name in ("cam0", "cam1", "cam2", "cam3"):
        first, *others = sorted((still / name).iterdir())
        for other in others:
            shutil.copy(first, other)
    true = renders / "still" / "calibration.toml"
    assert calibrated(still, tmp_path / "found.toml", "--lenses", true) == 2
    assert "mm only: carry it through the whole workspace" in capsys.readouterr().err


def test_a_body_of_other_colours_is_refused_in_one_line(still, renders, tmp_path, capsys):
    body = still / "body.toml"
    text = body.read_text("utf-8")
    for color, other in (("green", "blue"), ("yellow", "purple"), ("red", "cyan")):
        text = text.replace(f'color = "{color}"', f'color = "{other}"')
    body.write_text(text, "utf-8")
    true = renders / "still" / "calibration.toml"
    assert calibrated(still, tmp_path / "found.toml", "--lenses", true) == 2
    (told,) = [x for x in capsys.readouterr().err.splitlines() if not x.startswith("calibrating")]
    assert "are the body file's colours those of the balls" in told


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda text: text.replace('name = "cam2"', 'name = "other"'), "camera 'cam2' of"),
        (lambda text: text.replace("[1280, 720]", "[640, 360]"), "1280x720 px, but its lens"),
    ],
)
def test_lenses_of_other_cameras_are_refused(still, renders, tmp_path, capsys, change, told):
    lenses = tmp_path / "lenses.toml"
    text = (renders / "still" / "calibration.toml").read_text("utf-8")
    lenses.write_text(change(text), "utf-8")
    assert calibrated(still, tmp_path / "found.toml", "--lenses", lenses) == 2
    assert told in capsys.readouterr().err


def test_options_of_the_other_kind_are_refused(still, renders, tmp_path, capsys):
    out = tmp_path / "found.toml"
    assert calibrated(still, out, "--method", "paper") == 2
    assert "a waved body calibrates all cameras at once" in capsys.readouterr().err
    capture = str(renders / "E_calibration")
    lenses = str(renders / "still" / "calibration.toml")
    assert main(["calibrate", capture, "-o", str(out), "--lenses", lenses]) == 2
    assert "capture.toml names the lenses" in capsys.readouterr().err
