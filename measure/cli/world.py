"""`measure world`: a calibration's world put where a body is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag


def world(
    calibration: Path,
    /,
    *,
    run: Path,
    at: float | None = None,
    rest: int | None = None,
    points: tuple[int, int, int] | None = None,
    output: Annotated[Path, Parameter(name=("--output", "-o"))],
    body: str | None = None,
    json: JsonFlag = False,
) -> None:
    """Put a calibration's world where a body is, or through three touched points.

    The world becomes the frame of the body at that instant or rest, or a frame through three rests
    of a tip. Covariances of the cameras are carried along.

    Args:
        calibration: that the run was measured with.
        run: a run with the body where the world shall be.
        at: time of the pose, in seconds as in poses.csv.
        rest: number of a rest (`measure rests`); the longest, if no place is given.
        points: three rests of a pivoted tip instead: at the origin, on the x axis, and beside it
            where y is positive.
        output: the calibration to write.
        body: which body, of a run of several.
    """
    from measure import api
    from measure.api.outputs import check_replaceable
    from measure.session import read_calibration, write_calibration

    check_replaceable(output, read_calibration, "calibration")
    found, place = api.world(calibration, run, at, rest, points, body)
    write_calibration(output, found)
    sd = np.sqrt(np.diag(place.covariance))
    if json:
        console.print_json(
            {
                "output": output,
                "quat_wxyz": place.transform.quat_wxyz,
                "translation_mm": place.transform.translation,
                "covariance": place.covariance,
            }
        )
        return
    at_mm = ", ".join(f"{value:.3f}" for value in place.transform.translation)
    console.print_text(
        f"wrote {output}: its origin is at ({at_mm}) mm of the old world, known to "
        f"{np.linalg.norm(sd[:3]):.3f} mm and {np.degrees(np.linalg.norm(sd[3:])):.3f} deg (3-D)"
    )
