"""What contradicts itself ends in a refusal that names the cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.calibration import MarkerField, starts
from measure.calibration.findings import Workspace, plausibility, residual_findings
from measure.checking import Level
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import MarkerObservation
from tests.calibration.rigs import Rig, markers, rig

FIELD = MarkerField(tuple(f"m{i:02d}" for i in range(16)), markers())


@pytest.fixture(scope="module")
def world() -> Rig:
    return rig(np.random.default_rng(0))


def boards(world: Rig) -> dict[str, starts.SeenBoard]:
    return dict(world.seen)


def check(
    world: Rig, seen: dict[str, starts.SeenBoard], marks: MarkerObservation | None = None
) -> float:
    camera = world.start[0]
    start = starts.start_from_board("cam0", camera.intrinsics, seen["cam0"])
    marks = world.observations.marks["cam0"] if marks is None else marks
    return starts.check_board_against_marks(start, seen, FIELD, marks)


def test_what_agrees_passes_with_its_disagreement_in_mm(world: Rig) -> None:
    assert check(world, boards(world)) < 1.5


def test_a_board_picture_upside_down(world: Rig) -> None:
    """A detector that knows where the board begins finds the same corners."""
    seen = boards(world)
    over = np.array([1279, 719]) - seen["cam0"].corners.pixels
    seen["cam0"] = replace(seen["cam0"], corners=replace(seen["cam0"].corners, pixels=over))
    with pytest.raises(CalibrationError, match=r"cam0: board and .*its board picture is upside"):
        check(world, seen)


@pytest.mark.parametrize(("in_mm", "unit"), [(1000, "metres"), (10, "centim"), (25.4, "inches")])
def test_markers_in_another_unit(world: Rig, in_mm: float, unit: str) -> None:
    field = replace(FIELD, points=markers() / in_mm)
    marks = world.observations.marks["cam0"]
    with pytest.raises(CalibrationError, match=f"the markers' places are in {unit}"):
        starts.check_board_against_marks(world.start[0], boards(world), field, marks)


def test_a_single_marker_at_a_wrong_place_is_named(world: Rig) -> None:
    marks = world.observations.marks["cam0"]
    wrong = int(marks.ids[2])
    points = markers()
    points[wrong, 0] -= 100.0
    with pytest.raises(CalibrationError, match=f"only {FIELD.names[wrong]} does: its place or its"):
        starts.check_board_against_marks(
            world.start[0], boards(world), replace(FIELD, points=points), marks
        )


def test_marks_of_mixed_names_locate_no_camera(world: Rig) -> None:
    marks = world.observations.marks["cam0"]
    mixed = replace(marks, ids=np.random.default_rng(0).permutation(marks.ids))
    with pytest.raises(CalibrationError, match="no camera pose explains its marks"):
        starts.start_from_marks("cam0", world.start[0].intrinsics, FIELD, mixed)


def test_marks_that_miss_by_pixels_are_wrong() -> None:
    residuals = np.random.default_rng(0).normal(0, 2.5, (8, 2))
    found = residual_findings("cam0", residuals, 0.33, [f"m{i}" for i in range(8)])
    assert found[0].level is Level.WRONG
    assert "too large for sub-mm" in found[0].text
    assert not residual_findings("cam0", residuals / 10, 0.33, [f"m{i}" for i in range(8)])


def test_camera_under_floor_or_looking_away_is_wrong(world: Rig) -> None:
    camera = world.true[0]
    workspace = Workspace(np.array([0.0, 0.0, 250.0]), np.full(3, 50.0))
    assert not plausibility(world.true, workspace, 0.0)
    buried = replace(
        camera, world_from_camera=camera.world_from_camera.perturb([0, 0, -500, 0, 0, 0])
    )
    texts = [f.text for f in plausibility((buried,), workspace, 0.0)]
    assert any("under the floor" in text for text in texts)
    away = RigidTransform(-camera.world_from_camera.rotation * [1, -1, 1], camera.center)
    turned = replace(camera, world_from_camera=away)
    assert any("does not see" in f.text for f in plausibility((turned,), workspace, 0.0))
