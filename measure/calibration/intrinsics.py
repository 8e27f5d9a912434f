"""The lens of one camera from views of a board, as free as the views support and no freer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

import numpy as np

from measure.arrays import Floats
from measure.calibration.board_views import (
    MODELS_OF,
    LensModel,
    SingleCameraFit,
    fit_lens,
    start_intrinsics,
)
from measure.calibration.boards import MIN_POINTS, Board, CornerRule, Corners, spacing_px
from measure.calibration.views import MIN_VIEWS, ViewSet
from measure.errors import CalibrationError
from measure.limits import CLEAR_RATIO, SIGNIFICANT_SIGMAS
from measure.model import Intrinsics, Projection

FOLDS = 5
_MIN_IMPROVEMENT_RATIO = 0.005
"""A freer model must lower the held-out error by this share to be chosen."""
MAX_FOCAL_SD = 0.03  # Focal lengths known worse than this share are refused
MAX_RMS_PX = 2.0
_WIDE_RAD = np.deg2rad(80.0)  # Field of view, corner to corner, from which a lens may be a fisheye
_CLEARLY_BETTER = 0.8
"""A fisheye is advised where it leaves less than this share of the pinhole's error."""


@dataclass(frozen=True, eq=False)
class LensCalibration:
    """A calibrated lens and why it is what it is."""

    fit: SingleCameraFit
    model: LensModel
    # RMS on views kept out of the fit, by model name, as far as they were tried.
    held_out_px: dict[str, float]
    reasons: tuple[str, ...]  # why freer models were refused, in words
    views: ViewSet  # the views used, with coverage and those left out
    # how corners are localised, whichever fits held-out views better.
    corner_rule: CornerRule = "pattern"
    lateral_color: tuple[float, float] | None = None

    @property
    def intrinsics(self) -> Intrinsics:
        """The lens with its covariance and lateral colour."""
        return replace(self.fit.intrinsics, lateral_color=self.lateral_color)


def calibrate_lens(
    board: Board, views: ViewSet, camera: str, projection: Projection | None = None
) -> LensCalibration:
    """Calibrate a lens; of no stated kind a pinhole, with advice where a fisheye fits better."""
    if projection is not None:
        return _calibrate(board, views, camera, projection)
    try:
        found = _calibrate(board, views, camera, "pinhole")
    except CalibrationError as problem:
        if advice := _fisheye_advice(board.points, views, MAX_RMS_PX):
            raise CalibrationError(f"{problem}; {advice}") from None
        raise
    advice = _fisheye_advice(board.points, found.views, found.fit.rms_px)
    return replace(found, reasons=(*found.reasons, advice)) if advice else found


def _calibrate(
    board: Board, views: ViewSet, camera: str, projection: Projection
) -> LensCalibration:
    models, by_rule = MODELS_OF[projection], dict[CornerRule, ViewSet]()
    problems = list[CalibrationError]()
    differ = any(view.by_gradient is not None for view in views.views)
    for rule in get_args(CornerRule)[: 1 + differ]:
        localised = replace(views, views=tuple(view.localised(rule) for view in views.views))
        try:
            by_rule[rule] = _agreeing(board, localised, camera, models[1])
        except CalibrationError as problem:
            problems.append(problem)
    if not by_rule:
        raise problems[0]
    rule = _better_corners(board.points, by_rule, (models[3], models[1]))
    views = by_rule[rule]
    model, held_out, reasons = _choose_model(board.points, views, models)
    fit = _fit(board.points, views, views.views, model)
    _refuse_implausible(fit, camera)
    return LensCalibration(fit, model, held_out, reasons, views, rule)


_TRIED = np.array([0.004, 0.4, 0.4])
"""Steps by which shapes are tried, a share and mm: errors of corners grow in proportion to them."""
_UNKNOWN = np.array([0.1, 10.0, 10.0])  # Standard deviations of what no picture shows
_LEAST = np.array([5e-4, 0.15, 0.15])
"""From which a board counts as not as drawn: one that is shows a third of that at most."""


@dataclass(frozen=True)
class BoardShape:
    """How a board differs from its drawing, as its pictures show."""

    # (3,) by which share its squares are longer along y than along x; and how many mm its middle
    # stands behind its edges, where x runs along them and where y does.
    values: Floats
    sds: Floats  # (3,)

    @property
    def seen(self) -> Floats:
        """The same (3,), but 0 where it is not significant."""
        clear = np.abs(self.values) > np.maximum(SIGNIFICANT_SIGMAS * self.sds, _LEAST)
        return np.where(clear, self.values, 0.0)


def board_shape(board: Board, lenses: Iterable[LensCalibration]) -> BoardShape:
    """By all cameras' views: lens and poses are fitted again to boards of other shapes."""
    information, gradient = np.diag(_UNKNOWN**-2), np.zeros(3)
    for lens in lenses:
        fit = partial(_residuals, board, lens)
        left = fit(np.zeros(3))
        by_shape = [(fit(step) - fit(-step)) / (2 * step.sum()) for step in np.diag(_TRIED)]
        jacobian = np.column_stack(by_shape)
        information += jacobian.T @ jacobian / np.mean(left**2)
        gradient -= jacobian.T @ left / np.mean(left**2)
    covariance = np.linalg.inv(information)
    return BoardShape(covariance @ gradient, np.sqrt(np.diag(covariance)))


def _residuals(board: Board, lens: LensCalibration, shape: Floats) -> Floats:
    """Those of all views' corners, lens and poses fitted to a board of another shape."""
    points, views = _shaped(board.points, shape), lens.views.views
    return fit_lens(lens.fit.intrinsics, points, views, lens.model).residuals.ravel()


def _shaped(points: Floats, shape: Floats) -> Floats:
    """Corners (n, 3) of a board of another shape, see `BoardShape`."""
    stretch, *bows = shape
    half = np.ptp(points[:, :2], axis=0) / 2
    across = (points[:, :2] - points[:, :2].min(axis=0) - half) / half
    out = points * [1, 1 + stretch, 1]
    out[:, 2] += (1 - across**2) @ bows
    return out


def _fit(
    points: Floats, of: ViewSet, views: tuple[Corners, ...], model: LensModel, huber: float = np.inf
) -> SingleCameraFit:
    start = start_intrinsics(of.size_wh, points, views, model.projection)
    return fit_lens(start, points, views, model, huber)


def _fisheye_advice(points: Floats, views: ViewSet, pinhole_px: float) -> str:
    """What to write if a fisheye fits views clearly better than to `pinhole_px`; else empty."""
    diagonal = float(np.hypot(*views.size_wh))
    try:
        start = start_intrinsics(views.size_wh, points, views.views, "fisheye")
        if diagonal / start.focal_px < _WIDE_RAD:
            return ""
        fit = fit_lens(start, points, views.views, MODELS_OF["fisheye"][2])
    except CalibrationError:
        return ""
    if fit.rms_px > _CLEARLY_BETTER * pinhole_px:
        return ""
    wide_rad = diagonal / fit.intrinsics.focal_px
    return (
        f"the field of view is about {np.degrees(wide_rad):.0f} deg, and a fisheye fits the views "
        f'to {fit.rms_px:.2f} px: say model = "fisheye" for this camera in capture.toml'
    )


def _agreeing(board: Board, views: ViewSet, camera: str, model: LensModel) -> ViewSet:
    """Without views, and corners of views, that do not fit the lens of the others.

    A board that is seen at a slant has corners that are localised badly: its others count. One of
    which a corner lies where another one belongs is numbered wrongly, and does not.
    """
    kept, left_out = list(views.views), dict(views.left_out)
    while True:
        fit = _fit(board.points, views, tuple(kept), model, huber=1.0)
        lengths = np.linalg.norm(fit.residuals, axis=1)
        misses = [lengths[fit.view_of == number] for number in range(len(kept))]
        of_views = np.array([np.median(own) for own in misses])
        usual = float(np.median(of_views))
        most = CLEAR_RATIO * usual + 0.1
        sound = [np.flatnonzero(own <= most) for own in misses]
        for number, (view, own) in enumerate(zip(kept, misses, strict=True)):
            if np.max(own) > spacing_px(view.pixels) / 2 or len(sound[number]) < MIN_POINTS:
                of_views[number] = np.max(own)
        worst = int(np.argmax(of_views))
        if of_views[worst] <= most:
            return replace(views, views=tuple(map(Corners.only, kept, sound)), left_out=left_out)
        much = f"by {of_views[worst]:.2f} px, the others by {usual:.2f} px"
        left_out[kept[worst].source] = "its corners miss", much
        del kept[worst]
        if len(kept) < MIN_VIEWS:
            raise CalibrationError(
                f"camera {camera}: only {len(kept)} views of the board agree with each other, the "
                f"next one misses by {of_views[worst]:.1f} px; take more pictures, nearer or less "
                "tilted; if that does not help, check the board's numbers of corners and that it "
                "is flat"
            )


def _better_corners(
    points: Floats, by_rule: Mapping[CornerRule, ViewSet], models: tuple[LensModel, ...]
) -> CornerRule:
    """The rule by which held-out views that agree by each of them fit better."""
    common = set.intersection(*({v.source for v in some.views} for some in by_rule.values()))
    candidates = {
        rule: replace(found, views=tuple(v for v in found.views if v.source in common))
        for rule, found in by_rule.items()
    }
    errors: dict[CornerRule, float] = {}
    for model in models if len(by_rule) > 1 and len(common) >= MIN_VIEWS else ():
        try:
            errors = {r: _held_out_rms(points, v, model) for r, v in candidates.items()}
            break
        except CalibrationError:  # too few views for so free a model: compare with a stiffer one
            continue
    return min(errors or by_rule, key=lambda name: errors.get(name, -len(by_rule[name].views)))


def _choose_model(
    points: Floats, views: ViewSet, models: tuple[LensModel, ...]
) -> tuple[LensModel, dict[str, float], tuple[str, ...]]:
    """The stiffest model that no freer one beats on held-out views."""
    held_out: dict[str, float] = {}
    reasons: list[str] = []
    best: LensModel | None = None
    for model in models:
        try:
            error = _held_out_rms(points, views, model)
        except CalibrationError as problem:
            reasons.append(f"lens model {model.name} refused: {problem}")
            continue
        held_out[model.name] = error
        if best is None or error < held_out[best.name] * (1 - _MIN_IMPROVEMENT_RATIO):
            best = model
        else:
            added = " ".join(model.parameters.split()[len(best.free) :])
            reasons.append(
                f"lens model {model.name} refused: {added} changes the held-out error from "
                f"{held_out[best.name]:.4f} to {error:.4f} px"
            )
    if best is None:
        raise CalibrationError("; ".join(reasons))
    return best, held_out, tuple(reasons)


def _held_out_rms(points: Floats, views: ViewSet, model: LensModel) -> float:
    """RMS of views that the lens was not fitted to (their board pose alone is), by folds."""
    squares, count = 0.0, 0
    for fold in range(min(FOLDS, len(views.views))):
        kept = tuple(v for i, v in enumerate(views.views) if i % FOLDS != fold)
        lens = _fit(points, views, kept, model).intrinsics
        for view in views.views[fold::FOLDS]:
            error = fit_pose_only(lens, points, view).residuals
            squares, count = squares + float(np.sum(error**2)), count + len(error)
    return float(np.sqrt(squares / count))


def fit_pose_only(lens: Intrinsics, points: Floats, view: Corners) -> SingleCameraFit:
    """The fit of a view's board pose under a known lens."""
    return fit_lens(lens, points, (view,), LensModel("fixed", ()))


def _refuse_implausible(fit: SingleCameraFit, camera: str) -> None:
    covariance = fit.intrinsics.covariance
    assert covariance is not None
    focal = fit.intrinsics.focal_px
    sd = float(np.sqrt(max(covariance[0, 0], covariance[1, 1])))
    if not sd < MAX_FOCAL_SD * focal:
        raise CalibrationError(
            f"camera {camera}: the views leave the focal length at {focal:.0f} +- {sd:.0f} px; "
            "tilt the board by 30 to 45 degrees in several directions"
        )
    if fit.rms_px > MAX_RMS_PX:
        raise CalibrationError(
            f"camera {camera}: the board's corners miss by {fit.rms_px:.1f} px RMS; check the "
            "board's numbers of corners, that it is flat, and that focus and zoom did not change"
        )
    fx, fy = fit.intrinsics.matrix[0, 0], fit.intrinsics.matrix[1, 1]
    if not 0.8 < fx / fy < 1.25:
        raise CalibrationError(
            f"camera {camera}: fx / fy = {fx / fy:.3f} is no camera's: are the board's squares "
            "square, and were the pictures resized?"
        )
