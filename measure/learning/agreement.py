"""Checks that measured and reported positions are in one unit and one frame."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError

_MIN_SPREAD_MM = 1.0  # Spread of the positions below which their unit is not checked
_MIN_SPREAD_SHARE = 1e-4
"""Least spread of the reported positions, as a share of that of the measured ones."""
_MIN_ROWS, _MIN_PLANE_SPREAD_MM = 20, 10.0
"""Fewer positions, or positions nearer to one line, do not determine a frame."""
_MIN_CORRELATION = 0.8
_MIN_MIRROR_RATIO = 3.0
"""Of the residual motion to that in a mirrored frame, from which the frame is called mirrored."""


def check_units(name: str, measured_mm: Floats, reported_mm: Floats) -> None:
    """Refuse positions (n, 3) of the same instants that are not both in mm (EstimatorError)."""
    spread = np.linalg.norm(measured_mm.std(axis=0))
    expected = np.linalg.norm(reported_mm.std(axis=0))
    if max(spread, expected) < _MIN_SPREAD_MM:
        return
    ratio = spread / max(float(expected), 1e-12)
    for factor, what in ((1e-3, "metres"), (1e-1, "centimetres"), (1e3, "micrometres")):
        if 0.3 < ratio / factor < 3.0:
            raise EstimatorError(
                f"{name}: the measured positions look like {what} (they spread {ratio:.2g} times "
                "as far as the robot's reported ones): convert them to mm"
            )
    if expected < _MIN_SPREAD_SHARE * spread:
        raise EstimatorError(
            f"{name}: the robot's log reports a tip that stands still while the measured one moves "
            f"by {spread:.1f} mm: are these the right columns, and is their unit?"
        )
    if (
        np.median(np.linalg.norm(measured_mm, axis=1))
        < 1e-1 * np.median(np.linalg.norm(reported_mm, axis=1))
        and spread < 0.3 * expected
    ):
        raise EstimatorError(
            f"{name}: measured and reported positions are of different size: use mm"
        )


def check_frames(name: str, measured_mm: Floats, reported_mm: Floats) -> None:
    """Refuse positions (n, 3) of the same instants that no rigid motion brings together.

    Compared by the rotation that brings the reported positions nearest to the measured ones (Kabsch
    1976), where the positions spread enough.

    Raises:
        EstimatorError: they do not go together, or one is mirrored.
    """
    if not determine_frame(reported_mm):
        return
    ours, theirs = (p - p.mean(axis=0) for p in (measured_mm, reported_mm))
    u, values, v = np.linalg.svd(ours.T @ theirs)
    handed = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    size = float(np.sqrt((ours**2).sum() * (theirs**2).sum()))
    turned, mirrored = float(handed @ values) / size, float(values.sum()) / size
    wrong = ""
    if mirrored < _MIN_CORRELATION:
        wrong = (
            f"do not go together (correlation {mirrored:.2f}): is the clock offset right? A tool "
            "far from the body's origin, or another frame, is found by `measure register`."
        )
    elif (
        1 - turned**2 > _MIN_MIRROR_RATIO * (1 - mirrored**2)
        and _spread(reported_mm)[2] > _MIN_PLANE_SPREAD_MM
    ):
        wrong = "are mirror images of each other: are two axes exchanged, or one reversed?"
    if wrong:
        raise EstimatorError(
            f"{name}: the measured and the reported positions {wrong} Their difference would be "
            "learnt as the robot's error"
        )


def determine_frame(positions_mm: Floats) -> bool:
    """Whether positions (n, 3) are enough, and far enough from one line, to determine a frame."""
    if len(positions_mm) < _MIN_ROWS:
        return False
    return bool(_spread(positions_mm)[1] >= _MIN_PLANE_SPREAD_MM)


def _spread(positions_mm: Floats) -> Floats:
    """Standard deviations (3,) along the principal axes, the largest first."""
    centred = positions_mm - positions_mm.mean(axis=0)
    return np.asarray(np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred)))
