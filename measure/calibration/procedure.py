"""From a capture folder to cameras: everything the capture offers, in order."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from measure.arrays import Floats
from measure.calibration import extrinsics, rig_problem
from measure.calibration.boards import Board, CornerRule, Stretched
from measure.calibration.capture import Capture, CaptureCamera
from measure.calibration.common_views import Joint, fit_common_views
from measure.calibration.intrinsics import BoardShape, LensCalibration, board_shape, calibrate_lens
from measure.calibration.markers import FoundMarkers
from measure.calibration.starts import (
    check_board_against_marks,
    check_located,
    marker_observation,
    marks_of,
    oriented_board,
    start_from_board,
)
from measure.calibration.targets import MarkerField
from measure.calibration.views import ALL_VIEWS, MAX_VIEWS, charuco_slip, find_views
from measure.errors import CalibrationError
from measure.estimation.lateral_color import lateral_color
from measure.model import Camera, Intrinsics
from measure.processes import Progress

Method = Literal["joint", "paper"]
_COLOR_VIEWS = 12


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A calibrated rig and intermediate results."""

    cameras: tuple[Camera, ...]
    method: Method
    lenses: dict[str, LensCalibration]  # by camera name, where the lens was calibrated here
    fit: extrinsics.RigFit | None  # of all cameras, by `method`; None of common views
    observations: rig_problem.RigObservations
    markers: MarkerField
    # at their rough poses, lenses as calibrated by themselves.
    cameras_before: tuple[Camera, ...] = ()
    found: dict[str, FoundMarkers] = field(default_factory=dict)
    # between board and markers at the markers, by camera name.
    disagreement_mm: dict[str, float] = field(default_factory=dict)
    # (n, 3) mm, board corners in view, where there are no markers.
    around: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    joint: Joint | None = None  # covariance of all cameras, where `fit` does not hold it
    shape: BoardShape | None = None  # of the board, as stated; None if no lens was calibrated

    @property
    def tolerances(self) -> rig_problem.Tolerances:
        """As used; the board's estimated where the capture does not state it."""
        return self.observations.tolerances


def calibrate_capture(
    capture: Capture, method: Method = "joint", progress: Progress | None = None
) -> RigCalibration:
    """Calibrate all cameras of a capture: all at once ("joint"), or by equation 3 ("paper")."""
    check_calibrated(capture)
    lenses: dict[str, LensCalibration] = {}
    known: dict[str, Intrinsics] = {}
    # All common views are kept, similar ones too: the other camera may need them.
    limit = ALL_VIEWS if capture.settings.common_views else MAX_VIEWS
    for done, camera in enumerate(capture.cameras):
        if progress is not None:
            progress(done, len(capture.cameras))
        if camera.name in capture.lenses:
            known[camera.name] = capture.lenses[camera.name]
        else:
            assert capture.board is not None
            views = find_views(capture.board, capture.views(camera), camera.name, limit)
            model = camera.model or capture.settings.model
            lens = calibrate_lens(capture.board, views, camera.name, model)
            # Of red and blue, by pictures of the board, which is grey
            center = lens.fit.intrinsics.matrix[:2, 2]
            used = {view.source for view in lens.views.views[:_COLOR_VIEWS]}
            found = lateral_color(
                (picture, center) for name, picture in capture.views(camera) if name in used
            )
            color = None if found is None else (float(found.red_blue[0]), float(found.red_blue[1]))
            lenses[camera.name] = replace(lens, lateral_color=color)
            known[camera.name] = lenses[camera.name].intrinsics
    shape = None
    if capture.board is not None and lenses:
        shape = board_shape(capture.board, lenses.values())
        if stretch := float(shape.seen[0]):
            along = math.sqrt(1 + stretch)
            capture = replace(capture, board=Stretched(capture.board, (1 / along, along)))
            lenses = _of_board(capture, lenses)
            known |= {name: lens.intrinsics for name, lens in lenses.items()}
    if capture.settings.common_views:
        return replace(_relative(capture, lenses), shape=shape)
    return replace(_locate_all(capture, method, lenses, known), shape=shape)


def _of_board(capture: Capture, lenses: dict[str, LensCalibration]) -> dict[str, LensCalibration]:
    """The lenses by the views that were found, of a board of another shape."""
    out = {}
    for camera in capture.cameras:
        if (lens := lenses.get(camera.name)) is not None and capture.board is not None:
            model = camera.model or capture.settings.model
            again = calibrate_lens(capture.board, lens.views, camera.name, model)
            out[camera.name] = replace(again, lateral_color=lens.lateral_color)
    return out


def check_calibrated(capture: Capture) -> None:
    """Refuse (CalibrationError) a capture whose cameras nothing locates, whatever their lenses."""
    if not capture.settings.common_views:
        check_located(capture)
    elif missing := [c.name for c in capture.cameras if c.intrinsics is None]:
        raise CalibrationError(
            f"{capture.path}: common_views needs pictures of the board for every camera (none for "
            f"{', '.join(missing)})"
        )


def _relative(capture: Capture, lenses: dict[str, LensCalibration]) -> RigCalibration:
    """Cameras relative to the first, from pictures of one board taken at the same instants."""
    assert capture.board is not None
    cameras, around, joint = fit_common_views(capture.board, lenses)
    return RigCalibration(
        cameras,
        "joint",
        lenses,
        None,
        rig_problem.RigObservations(),
        capture.markers,
        cameras_before=cameras,
        around=around,
        joint=joint,
    )


def _locate_all(
    capture: Capture,
    method: Method,
    lenses: dict[str, LensCalibration],
    known: dict[str, Intrinsics],
) -> RigCalibration:
    markers, seen = capture.markers, _boards_of(capture, lenses, known)
    starts: list[Camera] = []
    marks: dict[str, rig_problem.MarkerObservation] = {}
    found: dict[str, FoundMarkers] = {}
    disagreement_mm: dict[str, float] = {}
    for camera in capture.cameras:
        name, start = camera.name, None
        if name in seen:
            start = start_from_board(name, known[name], seen[name])
            by_hand = marker_observation(capture.marks.get(name, {}), markers)
            if by_hand is not None:  # before a search that would begin at a wrong place
                check_board_against_marks(start, seen, markers, by_hand)
        start, observed, finds = marks_of(camera, known[name], start, capture)
        starts.append(start)
        if finds is not None:
            found[name] = finds
        if observed is not None:
            marks[name] = observed
            if name in seen:
                disagreement_mm[name] = check_board_against_marks(start, seen, markers, observed)
    places = [one.world_from_board.apply(one.points) for one in seen.values()]
    rough = RigCalibration(
        tuple(starts),
        method,
        lenses,
        None,
        rig_problem.RigObservations(markers.points, seen, marks),
        markers,
        cameras_before=tuple(starts),
        found=found,
        disagreement_mm=disagreement_mm,
        around=np.concatenate([np.zeros((0, 3)), *places]),
    )
    return _fitted(rough, capture)


def _boards_of(
    capture: Capture, lenses: dict[str, LensCalibration], known: dict[str, Intrinsics]
) -> dict[str, rig_problem.BoardObservation]:
    """The boards of known pose, by camera, with the corner rule that suits the camera."""
    seen = {}
    for camera in capture.cameras:
        if camera.board_image is not None and capture.board is not None:
            calibrated, lens = lenses.get(camera.name), known[camera.name]
            rule: CornerRule = "pattern" if calibrated is None else calibrated.corner_rule
            found = _see_board(capture, camera, lens, capture.board, rule)
            seen[camera.name] = oriented_board(camera, lens, found, capture)
    return seen


def _fitted(rough: RigCalibration, capture: Capture) -> RigCalibration:
    """The rig by its method, from rough poses."""
    seen, settings = rough.observations, capture.settings
    held = extrinsics.held_within(
        seen.boards, settings.board_tolerance_mm, settings.board_tolerance_deg
    )
    tolerances = rig_problem.Tolerances(
        capture.markers.tolerance_mm, *held, extrinsics.DEFAULT_COMMON_PX
    )
    cameras, observed = rough.cameras, replace(seen, tolerances=tolerances)
    if rough.method == "paper":
        fit = extrinsics.fit_rig_by_paper(cameras, observed, settings.mark_sd_px)
    else:
        stated = (settings.board_tolerance_mm, settings.board_tolerance_deg) != (None, None)
        fit, tolerances = extrinsics.fit_rig_with_boards(
            cameras, observed, settings.mark_sd_px, stated
        )
    observations = replace(seen, tolerances=tolerances)
    return replace(rough, cameras=fit.cameras, fit=fit, observations=observations)


def _see_board(
    capture: Capture, camera: CaptureCamera, lens: Intrinsics, board: Board, rule: CornerRule
) -> rig_problem.BoardObservation:
    assert camera.board_image is not None
    bgr = capture.still(camera, camera.board_image, lens)
    gray = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
    corners = board.find(gray, Path(camera.board_image).name)
    if corners is None:
        raise CalibrationError(
            f"camera {camera.name}: no board found in {capture.path.parent / camera.board_image}; "
            + (
                charuco_slip(board, [gray])
                or "all of it must be in view, as board.toml says, sharp"
            )
        )
    return rig_problem.BoardObservation(board, corners.localised(rule), camera.world_from_board)
