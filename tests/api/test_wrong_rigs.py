"""Rigs that are a little wrong are named before their numbers are believed.

No pose without a flag is further off than three of its stated standard deviations.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure import api
from measure.checking import Level
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.measuring import Measurement, Status
from measure.model import Body, Camera
from measure.results import read_run
from measure.results.evaluation import evaluate
from measure.session import Calibration, open_session, read_trajectory, write_body
from measure.session import write_calibration as write
from measure.session.calibration_file import UNSTATED_SCALE_SD

pytestmark = pytest.mark.slow
Cameras = Sequence[Camera]


def turned(cameras: Cameras, deg: float) -> list[Camera]:
    """The second camera about its own vertical axis."""
    first, second, *others = cameras
    axis = second.world_from_camera.rotate(np.array([0, np.radians(deg), 0]))
    pose = second.world_from_camera.perturb([0, 0, 0, *axis])
    return [first, replace(second, world_from_camera=pose), *others]


def spread(cameras: Cameras, share: float) -> list[Camera]:
    """All cameras further from the world's origin."""
    return [
        replace(c, world_from_camera=RigidTransform(w.rotation, share * w.translation))
        for c in cameras
        for w in [c.world_from_camera]
    ]


def lens(camera: Camera, focal: float = 1.0, shift_px: float = 0.0) -> Camera:
    matrix = camera.intrinsics.matrix * np.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]])
    matrix[0, 2] += shift_px
    return replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))


def shifted(cameras: Cameras, shift_px: float) -> list[Camera]:
    """The principal points of all cameras."""
    return [lens(camera, shift_px=shift_px) for camera in cameras]


@dataclass(frozen=True)
class Rig:
    """A wrong rig, and what is said of it."""

    wrong: Callable[[Cameras, float], list[Camera]]
    amount: float
    level: Level
    said: str  # a pattern of the words of `check`
    flag: str = ""  # a pattern of a flag of most poses; empty if they may be believed


RIGS = {
    "turned by 0.1 deg": Rig(
        turned, 0.1, Level.WRONG, r"cam1 points 0\.(09|10|11) \+- 0\.01 deg beside", "cam1"
    ),
    "scale 0.3 %": Rig(
        spread, 1.003, Level.WEAK, r"the balls are 1\.00[23]\d \+- ", r"the balls are 1\.00[23]"
    ),
    "principal points 5 px": Rig(
        shifted, 5.0, Level.WRONG, r"the principal points of all cameras are \(-[45]\.\d", "."
    ),
}


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[Measurement]:
    """Filled with what `check` measures at last, a pose each: all of a short recording."""
    found: list[Measurement] = []

    def noted(*given):
        found.clear()
        for frame_set, one in api.measure_session(*given):
            found.extend([one] if one.pose is not None else [])
            yield frame_set, one

    monkeypatch.setattr(import_module("measure.api.check"), "measure_session", noted)
    return found


@pytest.mark.parametrize("name", RIGS)
def test_a_wrong_rig_is_named(still: Path, tmp_path: Path, measured, name: str) -> None:
    rig = RIGS[name]
    with open_session(still) as session:
        cameras = rig.wrong(session.cameras, rig.amount)
    write(tmp_path / "c.toml", Calibration(tuple(cameras)))
    found = api.check(still, Registry.discover(), calibration=tmp_path / "c.toml", samples=4)
    said = [f.text for f in found.findings if f.level is rig.level and re.search(rig.said, f.text)]
    assert said, found.findings
    assert not any(f.topic == "clock" for f in found.findings), found.findings
    assert found.believable == (rig.level is not Level.WRONG)
    measured = measured or poses(still, tmp_path / "c.toml")
    flagged = [any(re.search(rig.flag, flag) for flag in m.pose.flags) for m in measured]
    if rig.flag:
        assert np.mean(flagged) > 0.8
    assert max(deviations(still, measured), default=0.0) < 3


def woven(folder: Path) -> None:
    """Every second row shows the next instant."""
    for camera in ("cam0", "cam2"):
        paths = sorted((folder / camera).glob("*.jpg"))
        images = [cv2.imread(str(path)) for path in paths]
        for path, image, after in zip(paths, images, images[1:], strict=False):
            image[1::2] = after[1::2]
            cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 95])


def arrived(folder: Path) -> None:
    """Pictures of a camera arrive two at once."""
    times_s = [0.066 * (k // 2 + 1) + 0.0003 * (k % 2) for k in range(12)]
    lines = [f"{k},{time_s:.6f}" for k, time_s in enumerate(times_s)]
    (folder / "cam1.csv").write_text("\n".join(["frame,time_s", *lines]) + "\n")


@pytest.mark.parametrize(
    ("fault", "said", "silent"),
    [
        (woven, "wrong: pictures of cam0, cam2 are woven of two instants", ("cam0", "cam2")),
        (arrived, "wrong: cam1: pictures arrive in bursts of 2 every 66 ms", ("cam1",)),
    ],
)
def test_what_pictures_and_stamps_are_is_noted_by_a_run(
    still: Path, tmp_path: Path, fault: Callable[[Path], None], said: str, silent: Sequence[str]
) -> None:
    """And asked no more whether the camera was moved or its clock is off."""
    shutil.copytree(still, tmp_path / "still")
    fault(tmp_path / "still")
    options = api.RunOptions(recording=False)
    out, registry = tmp_path / "run", Registry.discover()
    summary = api.run(tmp_path / "still", out, api.load_profile(), registry, options)
    assert [note for note in summary.notes if str(note).startswith(said)]
    wrong = [one.text for one in summary.findings if one.level is Level.WRONG]
    assert len([text for text in wrong if any(name in text for name in silent)]) == 1
    assert list(map(str, read_run(out).summary.notes)) == list(map(str, summary.notes))
    flags = sum(n for doubt, n in summary.reasons.items() if doubt.code == "interlaced")
    assert (flags > summary.frame_sets / 2) == (fault is woven)


def test_a_right_rig_has_nothing_wrong(still: Path, measured) -> None:
    found = api.check(still, Registry.discover(), samples=4)
    assert [f.text for f in found.findings if f.level is Level.WRONG] == []
    assert [f.text for f in found.findings if f.topic in ("calibration", "clock")] == []
    assert len(measured) == 12
    assert [m.status for m in measured] == [Status.OK] * len(measured)
    assert max(deviations(still, measured)) < 3


def test_a_scale_too_small_to_be_seen_stands_beside_the_covariance(
    still: Path, tmp_path: Path
) -> None:
    """No pose shows it: 95 % regions hold with the scale that the run states, and not without."""
    with open_session(still) as session:
        write(tmp_path / "c.toml", Calibration(tuple(spread(session.cameras, 1.001))))
    options = api.RunOptions(calibration=tmp_path / "c.toml", recording=False)
    api.run(still, tmp_path / "run", api.load_profile(), Registry.discover(), options)
    run = read_run(tmp_path / "run")
    assert run.scale_sd == UNSTATED_SCALE_SD
    found = evaluate(run, read_trajectory(still / "truth.csv"))
    assert found.position_consistency.inside_95 <= 0.2
    assert found.scaled_consistency.inside_95 >= 0.9
    assert run.summary.scale_sd_mm == pytest.approx(0.15, abs=0.02)


def test_a_ball_far_out_of_its_place_is_no_error_of_scale(still: Path, tmp_path: Path) -> None:
    """Two of three balls agree in all cameras then, at a distance that is 5 % off."""
    with open_session(still) as session:
        body = session.body
    off = body.with_centers(body.centers + np.array([[-4.1, -0.4, -2.2], [0, 0, 0], [0, 0, 0]]))
    write_body(tmp_path / "body.toml", off)
    found = api.check(still, Registry.discover(), body=tmp_path / "body.toml")
    first, *_ = [f.text for f in found.findings if f.level is Level.WRONG]
    assert re.match(r"ball green is not where the body file says, but 4\.\d\d \+- 0\.\d\d", first)
    assert "cannot tell" not in first


def test_a_body_that_is_its_own_twin_is_named(still: Path, tmp_path: Path) -> None:
    """With red and green exchanged every pose is wrong by half a turn, and fits as well."""
    with open_session(still) as session:
        body = session.body
    green, yellow, red = body.balls
    exchanged = (
        replace(green, center_mm=red.center_mm),
        yellow,
        replace(red, center_mm=green.center_mm),
    )
    write_body(tmp_path / "twin.toml", Body("twin", exchanged))
    registry = Registry.discover()
    twin = api.check(still, registry, body=tmp_path / "twin.toml", samples=4, clock_samples=0)
    assert twins(str(f) for f in twin.findings) == 1
    options = api.RunOptions(body=[tmp_path / "twin.toml"], recording=False)
    summary = api.run(still, tmp_path / "run", api.load_profile(), registry, options)
    assert summary.ok == summary.frame_sets
    assert twins(map(str, summary.notes)) == 1


def twins(lines) -> int:
    return sum(
        "note: with green and red exchanged in the body file its pose would be turned by 180 deg"
        in line
        for line in lines
    )


def poses(folder: Path, calibration: Path | None = None):
    with open_session(folder, calibration) as session:
        found = api.measure_session(session, api.load_profile(), Registry.discover())
        return [m for _, m in found if m.pose is not None]


def deviations(folder: Path, measured) -> list[float]:
    """Errors of the poses without flags, in their stated standard deviations (RMS of the axes)."""
    truth = read_trajectory(folder / "truth.csv")
    believed = [m.pose for m in measured if m.status is Status.OK]
    out = []
    for pose in believed:
        off = pose.world_from_body.difference(truth.at(np.array([pose.time_s]))[0])
        for part in (slice(0, 3), slice(3, 6)):
            own = pose.covariance[part, part]
            out.append(float(np.sqrt(off[part] @ np.linalg.solve(own, off[part]) / 3)))
    return out
