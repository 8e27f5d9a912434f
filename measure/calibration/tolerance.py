"""How exactly were the boards held? Where nobody says, the boards and the markers tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.calibration.extrinsics import RigFit, Sights, Tolerances, fit_rig
from measure.model import Camera

_CANDIDATES_MM = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_MIN_WITNESSES = 2


def fit_rig_with_boards(
    start: tuple[Camera, ...], sights: Sights, mark_sd_px: float | None = None
) -> tuple[RigFit, Tolerances]:
    """Fit the rig with the board tolerance that makes boards and markers most likely together.

    Restricted maximum likelihood (Patterson and Thompson 1971) over a fixed list of candidates; the
    turn that goes with a shift is the one that shifts the board's rim as much. Without at least two
    cameras that see both there is nothing to learn from, and the stated poses are taken as exact.

    Raises:
        CalibrationError: the sights leave a camera's pose undetermined.
    """
    both = [n for n in sights.boards if n in sights.marks and len(sights.marks[n].ids) >= 3]
    if len(both) < _MIN_WITNESSES:
        return fit_rig(start, sights, mark_sd_px=mark_sd_px), sights.tolerances
    offsets = [b.points - b.points.mean(axis=0) for b in sights.boards.values()]
    rim = float(np.sqrt(np.mean(np.concatenate(offsets) ** 2) * 3))
    best: tuple[float, RigFit, Tolerances] | None = None
    for candidate in _CANDIDATES_MM:
        tolerances = replace(
            sights.tolerances, board_mm=candidate, board_deg=float(np.rad2deg(candidate / rim))
        )
        fit = fit_rig(start, replace(sights, tolerances=tolerances), mark_sd_px=mark_sd_px)
        if best is None or fit.log_likelihood > best[0]:
            best = (fit.log_likelihood, fit, tolerances)
        elif fit.log_likelihood < best[0] - 10:
            break
    assert best is not None
    return best[1], best[2]
