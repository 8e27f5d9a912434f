"""From a capture folder to cameras: everything the capture offers, in order."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from measure.arrays import Floats
from measure.calibration import extrinsics, starts
from measure.calibration.boards import Board, Charuco, CornerRule, Stretched
from measure.calibration.capture import Capture, CaptureCamera
from measure.calibration.common_views import fit_common_views
from measure.calibration.intrinsics import BoardShape, LensCalibration, board_shape, calibrate_lens
from measure.calibration.markers import FoundMarkers
from measure.calibration.targets import MarkerField
from measure.calibration.views import ALL_VIEWS, MAX_VIEWS, NoBoardError, ViewSet, find_views
from measure.errors import CalibrationError, ConfigError, MeasureError, PluginError
from measure.estimation.lateral_color import lateral_color
from measure.host.registry import suggestion
from measure.model import Camera, Intrinsics
from measure.model.rig_fit import CameraFit, MarkerObservation, RigFit, RigObservations, Tolerances
from measure.neighbours import CAMERA_FITS, names, offer
from measure.processes import Progress

JOINT = "joint"  # Our own fit; others are those of packages beside this one
_COLOR_VIEWS = 12


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A calibrated rig and intermediate results."""

    cameras: tuple[Camera, ...]
    method: str  # by which the cameras were fitted
    lenses: dict[str, LensCalibration]  # by camera name, where the lens was calibrated here
    fit: RigFit | None  # of all cameras, by `method`; None of common views
    observations: RigObservations
    markers: MarkerField
    # at their rough poses, lenses as calibrated by themselves.
    cameras_before: tuple[Camera, ...] = ()
    found: dict[str, FoundMarkers] = field(default_factory=dict)
    # between board and markers at the markers, by camera name.
    disagreement_mm: dict[str, float] = field(default_factory=dict)
    # (n, 3) mm, board corners in view, where there are no markers.
    around: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    joint: Floats | None = None  # covariance of all cameras, where `fit` does not hold it
    shape: BoardShape | None = None  # of the board, as stated; None if no lens was calibrated
    first_marker: int | None = None  # of the board, where the pictures show other than was stated

    @property
    def tolerances(self) -> Tolerances:
        """As used; the board's estimated where the capture does not state it."""
        return self.observations.tolerances


def calibrate_capture(
    capture: Capture, method: str = JOINT, progress: Progress | None = None
) -> RigCalibration:
    """Calibrate all cameras of a capture: all at once, or by a `camera_fit`, of the name given."""
    if method != JOINT:
        camera_fit(method)  # refused before lenses take minutes
    check_calibrated(capture)
    stated = capture.board
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
            capture, views = _views(capture, camera, limit, first=not lenses)
            assert capture.board is not None
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
    shape, numbered = None, None
    if isinstance(capture.board, Charuco) and capture.board != stated:
        numbered = capture.board.first_marker
    if capture.board is not None and lenses:
        shape = board_shape(capture.board, lenses.values())
        if stretch := float(shape.seen[0]):
            along = math.sqrt(1 + stretch)
            capture = replace(capture, board=Stretched(capture.board, (1 / along, along)))
            lenses = _of_board(capture, lenses)
            known |= {name: lens.intrinsics for name, lens in lenses.items()}
    if capture.settings.common_views:
        rig = _relative(capture, lenses)
    else:
        rig = _locate_all(capture, method, lenses, known)
    return replace(rig, shape=shape, first_marker=numbered)


def _views(
    capture: Capture, camera: CaptureCamera, limit: int, first: bool
) -> tuple[Capture, ViewSet]:
    """The views of a camera; where the board is as stated but for its numbers, with those it has.

    That is found by the first camera: others that see other numbers see another board.
    """
    board = capture.board
    assert board is not None
    try:
        return capture, find_views(board, capture.views(camera), camera.name, limit)
    except NoBoardError as problem:
        seen = problem.other.board if problem.other else None
        if not (first and isinstance(seen, Charuco) and isinstance(board, Charuco)):
            raise
        if replace(seen, first_marker=board.first_marker) != board:
            raise
        capture = replace(capture, board=seen)
        return capture, find_views(seen, capture.views(camera), camera.name, limit)


def _of_board(capture: Capture, lenses: dict[str, LensCalibration]) -> dict[str, LensCalibration]:
    """The lenses by the views that were found, of a board of another shape."""
    out = {}
    for camera in capture.cameras:
        if (lens := lenses.get(camera.name)) is not None and capture.board is not None:
            model = camera.model or capture.settings.model
            again = calibrate_lens(capture.board, lens.views, camera.name, model)
            out[camera.name] = replace(again, lateral_color=lens.lateral_color)
    return out


def camera_fit(method: str) -> CameraFit:
    """The fit of this name, of a package beside this one; ConfigError: there is none."""
    found: CameraFit | None = offer(CAMERA_FITS, method, f"`--method {method}`")
    if found is None:
        known = suggestion(method, [JOINT, *names(CAMERA_FITS)], "method")
        raise ConfigError(f"no calibration method is called '{method}'; {known}")
    return found


def _fitted_by(
    method: str, start: tuple[Camera, ...], observed: RigObservations, mark_sd_px: float | None
) -> RigFit:
    """By a package's fit; PluginError: it fails, or answers nonsense."""
    try:
        fit = camera_fit(method)(start, observed, mark_sd_px)
        given = [camera.name for camera in fit.cameras]
        known = bool(np.isfinite(fit.covariance).all())
    except MeasureError:
        raise
    except Exception as problem:
        reason = " ".join(f"{type(problem).__name__}: {problem}".split())
        raise PluginError(f"the camera fit '{method}' fails: {reason}") from problem
    asked = [camera.name for camera in start]
    if given != asked or not known:
        what = "a covariance that is not finite" if given == asked else f"the cameras {given}"
        raise PluginError(f"the camera fit '{method}' answers nonsense: {what}, asked for {asked}")
    return fit


def check_calibrated(capture: Capture) -> None:
    """Refuse (CalibrationError) a capture whose cameras nothing locates, whatever their lenses."""
    if not capture.settings.common_views:
        starts.check_located(capture)
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
        JOINT,
        lenses,
        None,
        RigObservations(),
        capture.markers,
        cameras_before=cameras,
        around=around,
        joint=joint,
    )


def _locate_all(
    capture: Capture, method: str, lenses: dict[str, LensCalibration], known: dict[str, Intrinsics]
) -> RigCalibration:
    markers, seen = capture.markers, _boards_of(capture, lenses, known)
    placed: list[Camera] = []
    marks: dict[str, MarkerObservation] = {}
    found: dict[str, FoundMarkers] = {}
    disagreement_mm: dict[str, float] = {}
    for camera in capture.cameras:
        name, start = camera.name, None
        if name in seen:
            start = starts.start_from_board(name, known[name], seen[name])
            by_hand = starts.marker_observation(capture.marks.get(name, {}), markers)
            if by_hand is not None:  # before a search that would begin at a wrong place
                starts.check_board_against_marks(start, seen, markers, by_hand)
        start, observed, finds = starts.marks_of(camera, known[name], start, capture)
        placed.append(start)
        if finds is not None:
            found[name] = finds
        if observed is not None:
            marks[name] = observed
            if name in seen:
                disagreement_mm[name] = starts.check_board_against_marks(
                    start, seen, markers, observed
                )
    boards = {name: one.observation for name, one in seen.items()}
    places = [one.world_from_board.apply(one.points) for one in boards.values()]
    rough = RigCalibration(
        tuple(placed),
        method,
        lenses,
        None,
        RigObservations(markers.points, boards, marks),
        markers,
        cameras_before=tuple(placed),
        found=found,
        disagreement_mm=disagreement_mm,
        around=np.concatenate([np.zeros((0, 3)), *places]),
    )
    return _fitted(rough, capture)


def _boards_of(
    capture: Capture, lenses: dict[str, LensCalibration], known: dict[str, Intrinsics]
) -> dict[str, starts.SeenBoard]:
    """The boards of known pose, by camera, with the corner rule that suits the camera."""
    seen = {}
    for camera in capture.cameras:
        if camera.board_image is not None and capture.board is not None:
            calibrated, lens = lenses.get(camera.name), known[camera.name]
            rule: CornerRule = "pattern" if calibrated is None else calibrated.corner_rule
            found = _see_board(capture, camera, lens, capture.board, rule)
            seen[camera.name] = starts.oriented_board(camera, lens, found, capture)
    return seen


def _fitted(rough: RigCalibration, capture: Capture) -> RigCalibration:
    """The rig by its method, from rough poses."""
    seen, settings = rough.observations, capture.settings
    held = extrinsics.held_within(
        seen.boards, settings.board_tolerance_mm, settings.board_tolerance_deg
    )
    tolerances = Tolerances(capture.markers.tolerance_mm, *held, extrinsics.DEFAULT_COMMON_PX)
    cameras, observed = rough.cameras, replace(seen, tolerances=tolerances)
    fit: RigFit
    if rough.method == JOINT:
        stated = (settings.board_tolerance_mm, settings.board_tolerance_deg) != (None, None)
        fit, tolerances = extrinsics.fit_rig_with_boards(
            cameras, observed, settings.mark_sd_px, stated
        )
    else:
        fit = _fitted_by(rough.method, cameras, observed, settings.mark_sd_px)
    observations = replace(seen, tolerances=tolerances)
    return replace(rough, cameras=fit.cameras, fit=fit, observations=observations)


def _see_board(
    capture: Capture, camera: CaptureCamera, lens: Intrinsics, board: Board, rule: CornerRule
) -> starts.SeenBoard:
    assert camera.board_image is not None
    bgr = capture.still(camera, camera.board_image, lens)
    gray = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
    corners = board.find(gray, Path(camera.board_image).name)
    if corners is None:
        where = (
            f"camera {camera.name}: no board found in {capture.path.parent}/{camera.board_image}"
        )
        raise NoBoardError(where, board, [gray])
    return starts.SeenBoard(board, corners.localised(rule), camera.world_from_board)
