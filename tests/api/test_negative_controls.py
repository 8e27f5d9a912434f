"""What must not be measured with confidence, on rendered pictures through the whole profile.

A second body stands in `test_second_body.py`.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.api import RunOptions, load_profile, measure_session, run
from measure.host import Registry
from measure.measuring import Measurement, Status
from measure.model import BallColor, Body
from measure.results import read_run
from measure.session import open_session, read_trajectory, write_body, write_calibration
from measure.session.calibration_file import Calibration
from measure.simulation.scene import Scene
from tests.scenes import displaced
from tests.simulated import sessions
from tests.simulated.catalogue import scene_catalogue
from tests.simulated.degraded import (
    misstated_body,
    swapped_calibrations,
    upside_down,
    with_balls,
    without_balls,
)
from tests.simulated.sessions import part_of

RIGHT_MM = 0.5
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_catalogue()["still"]


@pytest.fixture(scope="module")
def rendered(still, tmp_path_factory) -> Path:
    """Four frame sets of `scene`, all as the files say."""
    return part_of(still, range(4), tmp_path_factory.mktemp("good") / "session")


@pytest.fixture(scope="module")
def four() -> Path:
    """A body whose balls do not lie in one plane."""
    scene = scene_catalogue()["four-balls"]
    red = replace(scene.body.balls[0], name="red", color=BallColor.named("red"))
    body = Body("four balls", (red, *scene.body.balls[1:]))
    return sessions.rendered(replace(scene, body=body), np.arange(4) / 30)


def measured(folder: Path, calibration: Path | None = None) -> list[Measurement]:
    with open_session(folder, calibration=calibration) as session:
        stages = measure_session(session, load_profile("precise"), Registry.discover())
        return [measurement for _, measurement in stages]


def errors_mm(folder: Path, found: list[Measurement]) -> list[float]:
    truth = read_trajectory(folder / "truth.csv")
    poses = [m.pose for m in found if m.pose is not None]
    return [
        float(np.linalg.norm(p.world_from_body.difference(truth.at(p.time_s))[:3])) for p in poses
    ]


def test_the_recording_itself_is_measured_with_confidence(rendered):
    found = measured(rendered)
    assert [m.status for m in found] == [Status.OK] * 4
    assert max(errors_mm(rendered, found)) < 0.15


@pytest.mark.parametrize("shown", [(), ("green", "red")], ids=len)
def test_too_few_balls_give_no_pose_and_a_reason(scene, shown):
    lacking = with_balls(scene, *shown) if shown else without_balls(scene)
    found = measured(sessions.rendered(lacking, np.arange(2) / 30))
    assert [m.status for m in found] == [Status.LOST] * 2
    assert all(m.reason for m in found)


def test_a_camera_upside_down_is_left_out_and_named(scene, rendered, tmp_path):
    given = upside_down(scene, "cam2").cameras
    write_calibration(tmp_path / "c.toml", Calibration(given))
    found = measured(rendered, tmp_path / "c.toml")
    assert all(m.status is not Status.OK for m in found)
    assert all(any("cam2" in flag for flag in m.pose.flags) for m in found if m.pose)
    assert all(error < RIGHT_MM for error in errors_mm(rendered, found))


def test_swapped_calibrations_are_never_a_confident_pose(scene, rendered, tmp_path):
    given = swapped_calibrations(scene, "cam0", "cam2").stated_cameras
    write_calibration(tmp_path / "c.toml", Calibration(given))
    assert all(m.status is not Status.OK for m in measured(rendered, tmp_path / "c.toml"))


def wrong(found: dict) -> str:
    return " / ".join(f["text"] for f in found["findings"] if f["level"] == "wrong")


def number(pattern: str, said: str) -> float:
    (found,) = set(re.findall(pattern, said))
    return float(found)


def test_wrong_radii_are_told_and_measured_with_right_ones(rendered, scene, tmp_path):
    balls = tuple(replace(b, radius_mm=1.05 * b.radius_mm) for b in scene.body.balls)
    shutil.copytree(rendered, tmp_path / "s")
    write_body(tmp_path / "s" / "body.toml", Body("wrong", balls))
    profile, options = load_profile("precise"), RunOptions(recording=False)
    told = run(tmp_path / "s", tmp_path / "run", profile, Registry.discover(), options)
    assert any("all balls look smaller than the body file says" in note.text for note in told.notes)
    assert told.ok == told.frame_sets
    found, truth = read_run(tmp_path / "run"), read_trajectory(rendered / "truth.csv")
    off = truth.at(found.times_s).translation - found.world_from_body.translation
    assert np.max(np.linalg.norm(off, axis=1)) < 0.15


@pytest.mark.parametrize(("share", "told"), [(0.994, True)])
def test_focal_lengths_all_off_alike_are_told(scene, share, told, tmp_path):
    """Poses then fit a little worse, and no camera contradicts another."""
    folder = sessions.rendered(scene, np.arange(6) / 30)
    zoom = np.array([[share, share, 1], [share, share, 1], [1, 1, 1]])
    given = [
        replace(c, intrinsics=replace(c.intrinsics, matrix=c.intrinsics.matrix * zoom))
        for c in scene.cameras
    ]
    write_calibration(tmp_path / "c.toml", Calibration(tuple(given)))
    options = RunOptions(calibration=tmp_path / "c.toml", recording=False)
    profile, registry = load_profile("precise"), Registry.discover()
    notes = [one.text for one in run(folder, tmp_path / "run", profile, registry, options).notes]
    said = [note for note in notes if "the focal lengths of all cameras are" in note]
    assert len(said) == told
    assert number(r"cameras are \+([\d.]+) ", said[0]) == pytest.approx(0.6, abs=0.2)
    assert not any("grey" in note for note in notes)


def mirrored(body: Body) -> Body:
    return Body(
        "mirrored", tuple(replace(b, center_mm=b.center_mm * [1, 1, -1]) for b in body.balls)
    )


def test_a_mirrored_layout_is_never_a_confident_pose(four, tmp_path):
    """Three of the balls fit as well as ever: it is the fourth that tells."""
    assert all(m.status is Status.OK for m in measured(four))
    with open_session(four) as session:
        body = session.body
    shutil.copytree(four, tmp_path / "s")
    write_body(tmp_path / "s" / "body.toml", mirrored(body))
    assert all(m.status is not Status.OK for m in measured(tmp_path / "s"))


@pytest.mark.parametrize("change", ["33", "exchanged"])
def test_a_wrong_body_file_is_never_a_confident_pose(scene, rendered, change, tmp_path):
    at = {b.name: b.center_mm for b in scene.body.balls}
    places = {
        "33": {name: tuple(center * 33 / 38) for name, center in at.items()},
        "exchanged": {"green": tuple(at["yellow"]), "yellow": tuple(at["green"])},
    }[change]
    shutil.copytree(rendered, tmp_path / "s")
    write_body(tmp_path / "s" / "body.toml", misstated_body(scene, places).stated_body)
    assert all(m.status is not Status.OK for m in measured(tmp_path / "s"))


def test_a_misplaced_ball_gives_no_confident_pose(four, tmp_path):
    with open_session(four) as session:
        body = session.body
    shutil.copytree(four, tmp_path / "s")
    write_body(tmp_path / "s" / "body.toml", displaced(body, "blue", [0, 3, 3]))
    assert all(m.status is not Status.OK for m in measured(tmp_path / "s"))


def test_exchanged_lenses_give_no_confident_pose(scene, rendered, tmp_path):
    by_name = {camera.name: camera for camera in scene.cameras}
    lenses = {"cam0": by_name["cam2"].intrinsics, "cam2": by_name["cam0"].intrinsics}
    given = tuple(replace(c, intrinsics=lenses.get(c.name, c.intrinsics)) for c in scene.cameras)
    write_calibration(tmp_path / "c.toml", Calibration(given))
    assert all(m.status is not Status.OK for m in measured(rendered, tmp_path / "c.toml"))


@pytest.mark.parametrize("degrees", [0.25, 180.0])
def test_a_moved_camera_of_three_gives_no_confident_pose(scene, rendered, degrees, tmp_path):
    axis = [0, 0, 1] if degrees == 180.0 else [0, 1, 0]
    turned = []
    for camera in scene.cameras[:3]:
        pose = camera.world_from_camera
        turn = pose.rotate(np.radians(degrees) * np.array(axis, dtype=np.float64))
        turned.append(
            replace(camera, world_from_camera=pose.perturb([0, 0, 0, *turn]))
            if camera.name == "cam1"
            else camera
        )
    shutil.copytree(rendered, tmp_path / "s")
    text = (tmp_path / "s" / "session.toml").read_text()
    blocks = text.split("[[cameras]]")
    (tmp_path / "s" / "session.toml").write_text("[[cameras]]".join(blocks[:4]))
    write_calibration(tmp_path / "s" / "calibration.toml", Calibration(tuple(turned)))
    found = measured(tmp_path / "s")
    assert all(m.status is not Status.OK for m in found)
