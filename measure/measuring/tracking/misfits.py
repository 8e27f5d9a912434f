"""Reasons to doubt a pose that was found: what single balls and rays say against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.model import Fix, Pose


def misfits(
    fixes: Sequence[Fix], pose: Pose, flag_residual_mm: float, flag_rays_mm: float
) -> tuple[str, ...]:
    """Flags for a pose.

    Args:
        fixes: the located balls.
        pose: fitted to them.
        flag_residual_mm: RMS misfit of the balls to the body from which it is flagged.
        flag_rays_mm: RMS distance of the rays from their balls from which it is flagged.
    """
    found = []
    if pose.residual_mm > flag_residual_mm:
        found.append(f"the balls miss the body's shape by {pose.residual_mm:.2f} mm RMS")
    squares: dict[str, list[float]] = {}
    for fix in fixes:
        for camera, residual in zip(fix.cameras, fix.residuals_mm.tolist(), strict=True):
            squares.setdefault(camera, []).append(residual**2)
    if not squares:
        return tuple(found)
    rays_mm = float(np.sqrt(np.mean([square for each in squares.values() for square in each])))
    if rays_mm > flag_rays_mm:
        worst = max(squares, key=lambda name: float(np.mean(squares[name])))
        found.append(
            f"the rays miss the balls by {rays_mm:.2f} mm RMS, most of all those of {worst}: "
            "has a camera moved, or are the clocks apart?"
        )
    return tuple(found)
