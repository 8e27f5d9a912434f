"""`measure refine` from end to end: what it writes, what it says, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.errors import body_cost
from measure.cli import main
from measure.geometry import RigidTransform, align_points
from measure.model import Camera
from measure.session import Calibration, read_body, read_calibration, write_body, write_calibration
from tests.api.test_clocks import halved
from tests.checking.test_clocks import CAMERAS, moving, recorded, still
from tests.scenes import RAVEN
from tests.session.conftest import jpeg, write_recording
from tests.simulated.catalogue import scene_catalogue
from tests.simulated.sessions import rendered

_SETS = 24


def slipped(cameras: tuple[Camera, ...], mm: float, degrees: float) -> tuple[Camera, ...]:
    rng = np.random.default_rng(3)
    slip = np.repeat([mm, np.deg2rad(degrees)], 3)
    return tuple(
        replace(c, world_from_camera=c.world_from_camera.perturb(rng.normal(0, slip)))
        for c in cameras
    )


def turn_errors_deg(found: tuple[Camera, ...], true: tuple[Camera, ...]) -> float:
    """RMS of the cameras' rotation errors, apart from what all have in common."""
    turns = np.stack(
        [
            a.world_from_camera.difference(b.world_from_camera)[3:]
            for a, b in zip(found, true, strict=True)
        ]
    )
    return float(np.degrees(np.sqrt(np.mean(np.sum((turns - turns.mean(axis=0)) ** 2, axis=1)))))


def relative_error_mm(
    found: tuple[Camera, ...], true: tuple[Camera, ...], poses: list[RigidTransform]
) -> float:
    """What wrong cameras do to a body's places (RMS), apart from what moves them all together."""
    shifts = body_cost(found, true, RAVEN, poses)
    places = np.stack([pose.translation for pose in poses])
    left = align_points(places, places + shifts).apply(places + shifts) - places
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session whose pictures show nothing: what they are measured to show is made up."""
    folder = write_recording(tmp_path / "rec", cameras=4, frames=2).path
    for picture in folder.glob("cam*/*.jpg"):
        picture.write_bytes(jpeg(0, (1280, 720)))
    write_body(folder / "body.toml", RAVEN)
    first = Calibration(slipped(tuple(CAMERAS.values()), 0.3, 0.05))
    write_calibration(folder / "calibration.toml", first)
    return folder


def seen(monkeypatch: pytest.MonkeyPatch, path: object, count: int) -> None:
    """Every measuring of a session gives the body on this path."""
    measured = list(recorded(path, count=count))
    monkeypatch.setattr(
        "measure.api.refining.measure_all", lambda opened, *_: (measured, opened.body)
    )


def test_it_writes_what_it_found_and_says_so(session, tmp_path, monkeypatch, capsys) -> None:
    seen(monkeypatch, moving, 60)
    out = tmp_path / "refined.toml"
    assert main(["refine", str(session), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "rms_before_px" in said
    assert "clock of cam1" in said
    assert "not beyond doubt, not applied" in said
    assert "the first calibration does not say how its cameras' errors hang together" in said
    found, true = read_calibration(out), tuple(CAMERAS.values())
    first = read_calibration(session / "calibration.toml").cameras
    assert turn_errors_deg(found.cameras, true) < 0.5 * turn_errors_deg(first, true)
    assert found.provenance["clocks_applied"] is False
    assert all(camera.pose_covariance is not None for camera in found.cameras)


def test_the_body_is_written_as_it_was_learnt(session, tmp_path, monkeypatch) -> None:
    seen(monkeypatch, moving, 60)
    shifts = np.array([[0.3, -0.2, 0.1], [-0.2, 0.3, 0.2], [0.1, 0.1, -0.3]])
    stated = replace(RAVEN.with_centers(RAVEN.centers + shifts), tolerance_mm=0.25)
    write_body(session / "body.toml", stated)
    out, body = tmp_path / "refined.toml", tmp_path / "learnt.toml"
    words = ["refine", str(session), "-o", str(out), "--body-output", str(body)]
    assert main(words) == 0
    found = read_body(body)
    assert found.tolerance_mm == 0.25
    before, after = (
        [b.distances()[pair] - mm for pair, mm in RAVEN.distances().items()]
        for b in (stated, found)
    )
    assert np.max(np.abs(after)) < 0.06 < 0.3 < np.max(np.abs(before))
    assert main([*words[:-1], str(out), "--overwrite"]) == 2  # two things in one file


def test_json_tells_the_same(session, tmp_path, monkeypatch, capsys) -> None:
    seen(monkeypatch, moving, 40)
    out = tmp_path / "refined.toml"
    assert main(["refine", str(session), "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["frame_sets"] == 40
    assert told["held_out_px"][1] < told["held_out_px"][0]


def test_other_programs_can_have_it(session, tmp_path, monkeypatch) -> None:
    seen(monkeypatch, moving, 40)
    ours, theirs = tmp_path / "refined.toml", tmp_path / "refined.yml"
    assert main(["refine", str(session), "-o", str(ours)]) == 0
    assert main(["refine", str(session), "-o", str(theirs), "--format", "opencv"]) == 0
    for a, b in zip(*(read_calibration(f).cameras for f in (ours, theirs)), strict=True):
        assert np.abs(a.world_from_camera.difference(b.world_from_camera)).max() < 1e-6


def test_a_nudged_camera_is_freed_alone(session, tmp_path, monkeypatch, capsys) -> None:
    """And the others stay as they are."""
    seen(monkeypatch, moving, 45)
    true = tuple(CAMERAS.values())
    nudge = np.array([2.0, -3.0, 3.0, 0.003, 0.002, -0.004])
    moved = replace(true[2], world_from_camera=true[2].world_from_camera.perturb(nudge))
    first = Calibration((*true[:2], moved, true[3]))
    write_calibration(session / "calibration.toml", first)
    at = [moving(np.array(0.1 * i)) for i in range(45)]
    for number, more in enumerate([[], ["--only", "cam2"]]):
        out = tmp_path / f"refined{number}.toml"
        assert main(["refine", str(session), "-o", str(out), *more]) == 0
        assert "cam2 alone freed (moved); cam0, cam1, cam3 stay" in capsys.readouterr().out
        found = read_calibration(out)
        for k in (0, 1, 3):
            off = found.cameras[k].world_from_camera.difference(true[k].world_from_camera)
            assert np.abs(off).max() < 1e-9
        assert relative_error_mm(found.cameras, true, at) < 0.03
        assert relative_error_mm(first.cameras, true, at) > 0.1
        assert found.provenance["freed"] == ["cam2"]
    for name, said in (("cam9", "did you mean"), ("cam", "did you mean")):
        assert main(["refine", str(session), "-o", str(tmp_path / "x"), "--only", name]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("path", "count", "reason"),
    [
        (still, 30, "the body moved"),
        (moving, 8, "8 of 8 frame sets have an unflagged pose, and at least 10 are needed: record"),
    ],
)
def test_a_recording_that_cannot_support_it_is_refused(
    session, tmp_path, monkeypatch, capsys, path, count, reason
) -> None:
    seen(monkeypatch, path, count)
    out = tmp_path / "refined.toml"
    assert main(["refine", str(session), "-o", str(out)]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert reason in said[0]
    assert not out.exists()


def true_cameras() -> tuple[Camera, ...]:
    """Of small pictures, which are rendered and searched in a quarter of the time."""
    return tuple(halved(camera) for camera in scene_catalogue()["still"].cameras)


@pytest.mark.slow
def test_pictures_of_a_moving_body_bring_the_cameras_together(tmp_path) -> None:
    """Before cameras that are not quite where the file says."""
    out, true = tmp_path / "refined.toml", true_cameras()
    scene = replace(scene_catalogue()["still"], cameras=true)
    scene = replace(scene, stated_cameras=slipped(true, 0.5, 0.1))
    session = rendered(scene, np.arange(_SETS) * 0.1)
    assert main(["refine", str(session), "-o", str(out)]) == 0
    first, found = (read_calibration(f).cameras for f in (session / "calibration.toml", out))
    at = scene_catalogue()["still"].trajectory.at(np.arange(_SETS) * 0.1)
    before, after = (
        relative_error_mm(c, true, [at[i] for i in range(_SETS)]) for c in (first, found)
    )
    assert after < 0.5 * before
    assert turn_errors_deg(found, true) < turn_errors_deg(first, true)
    errors = np.concatenate(
        [
            a.world_from_camera.difference(b.world_from_camera)
            for a, b in zip(found, true, strict=True)
        ]
    )
    covariance = np.asarray(read_calibration(out).provenance["joint_covariance"])
    assert errors @ np.linalg.solve(covariance, errors) / len(errors) < 2.5


@pytest.mark.parametrize(
    ("place", "why"),
    [(".", "is a folder; give the file to write"), ("file/c.toml", "file is no folder")],
)
def test_an_unwritable_output_is_refused_before_measuring(
    session, tmp_path, monkeypatch, capsys, place, why
) -> None:
    def never(*_, **__):
        raise AssertionError("it was measured first")

    monkeypatch.setattr("measure.api.refining.measure_all", never)
    (tmp_path / "file").write_text("")
    assert main(["refine", str(session), "-o", str(tmp_path / place)]) == 2
    err = capsys.readouterr().err
    assert why in err
    assert err.count("\n") == 1
