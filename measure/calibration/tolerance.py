"""Tolerances of board poses and of found marks, estimated from the residuals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from measure.calibration.extrinsics import RigFit, fit_rig
from measure.calibration.observations import BoardObservation, RigObservations, Tolerances
from measure.model import Camera

_BOARD_MM = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_COMMON_PX = (0.2, 0.4)
"""Candidates for the offset common to the found marks of a picture, px. Zero is not among them:
light from above shifts the dots of all cameras upwards, which no residual shows."""
DEFAULT_COMMON_PX = 0.2
"""Taken for that offset where no boards determine it."""
_PAST_PEAK_LOG_LIKELIHOOD = 10.0
"""The search ends at a candidate whose log likelihood is lower than the best by this."""
_MIN_CAMERAS_WITH_BOTH = 2


def fit_rig_with_boards(
    start: tuple[Camera, ...],
    observations: RigObservations,
    mark_sd_px: float | None = None,
    boards_stated: bool = False,
) -> tuple[RigFit, Tolerances]:
    """Fit the rig with the tolerances that make boards and markers most likely together.

    Restricted maximum likelihood (Patterson and Thompson 1971) over a fixed list of board
    tolerances, where none is stated, and over one of common offsets of found marks, where there are
    any. Without at least two cameras that see both there is nothing to learn from: the stated poses
    are taken as exact and the offset as it stands.

    Raises:
        CalibrationError: the observations leave a camera's pose undetermined.
    """
    both = [
        n
        for n in observations.boards
        if n in observations.marks and len(observations.marks[n].ids) >= 3
    ]
    if len(both) < _MIN_CAMERAS_WITH_BOTH:
        return fit_rig(start, observations, mark_sd_px=mark_sd_px), observations.tolerances
    boards = [observations.tolerances]
    if not boards_stated:
        held = [held_within(observations.boards, mm) for mm in _BOARD_MM]
        boards = [replace(boards[0], board_mm=mm, board_deg=deg) for mm, deg in held]
    best = _likeliest(start, observations, boards, mark_sd_px)
    if any(marks.searched for marks in observations.marks.values()):
        offsets = [replace(best[1], common_px=px) for px in _COMMON_PX]
        best = _likeliest(start, observations, offsets, mark_sd_px)
        if len(boards) > 1:
            boards = [replace(b, common_px=best[1].common_px) for b in boards]
            best = _likeliest(start, observations, boards, mark_sd_px)
    return best


def held_within(
    boards: Mapping[str, BoardObservation], shift_mm: float | None, turn_deg: float | None = None
) -> tuple[float, float]:
    """How far boards may be shifted (mm) and turned (degrees) from where they are stated to be.

    Where only one of the two is stated, the other moves a board's rim as much; where neither is,
    the boards are exact.
    """
    if not boards:
        return 0.0, 0.0
    offsets = [b.points - b.points.mean(axis=0) for b in boards.values()]
    rim_mm = float(np.sqrt(np.mean(np.concatenate(offsets) ** 2) * 3))
    if shift_mm is None:
        shift_mm = rim_mm * float(np.deg2rad(turn_deg or 0.0))
    if turn_deg is None:
        turn_deg = float(np.rad2deg(shift_mm / rim_mm))
    return shift_mm, turn_deg


def _likeliest(
    start: tuple[Camera, ...],
    observations: RigObservations,
    candidates: list[Tolerances],
    mark_sd_px: float | None,
) -> tuple[RigFit, Tolerances]:
    best: tuple[RigFit, Tolerances] | None = None
    for tolerances in candidates:
        fit = fit_rig(start, replace(observations, tolerances=tolerances), mark_sd_px=mark_sd_px)
        if best is None or fit.log_likelihood > best[0].log_likelihood:
            best = fit, tolerances
        elif fit.log_likelihood < best[0].log_likelihood - _PAST_PEAK_LOG_LIKELIHOOD:
            break
    assert best is not None
    return best
