"""`measure world`: a calibration's world put where a body is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.errors import ConfigError


def world(
    calibration: Path,
    /,
    *,
    run: Path | None = None,
    board: Path | None = None,
    pictures: Path | None = None,
    at: float | None = None,
    rest: int | None = None,
    points: tuple[int, int, int] | None = None,
    out: OutFile,
    overwrite: Overwrite = False,
    body: str | None = None,
    json: JsonFlag = False,
) -> None:
    """Put a calibration's world where a body or a board is, or through three touches.

    The world becomes the frame of the body at that instant or rest, a frame through three rests of
    a tip, or that of a board, z up from the paper. Covariances of the cameras are carried along.

    Args:
        calibration: that the run was measured with.
        run: a run with the body where the world shall be.
        board: instead of a run, a target file of a board that lies there.
        pictures: folder with a picture of the board by each camera, named like the camera.
        at: time of the pose, in seconds as in poses.csv.
        rest: number of a rest (`measure rests`); the longest, if no place is given.
        points: three rests of a pivoted tip instead: at the origin, on the x axis, and beside it
            where y is positive.
        out: the calibration to write.
        body: which body, of a run of several.
    """
    with api.output(out, overwrite) as file:
        if run is not None and board is None and pictures is None:
            found, place = api.world(calibration, run, at, rest, points, body)
        elif run is None and board is not None and pictures is not None:
            found, place = api.world_by_board(calibration, board, pictures)
        else:
            raise ConfigError("say where it is: --run RUN, or --board FILE --pictures FOLDER")
        api.write_calibration(file, found)
    pose, sd = place.transform, np.sqrt(np.diag(place.covariance))
    if json:
        where = {"quat_wxyz": pose.quat_wxyz, "translation_mm": pose.translation}
        console.print_json({"output": out, **where, "covariance": place.covariance})
        return
    at_mm = ", ".join(f"{value:.3f}" for value in pose.translation)
    console.print_text(
        f"wrote {out}: its origin is at ({at_mm}) mm of the old world, known to "
        f"{np.linalg.norm(sd[:3]):.3f} mm and {np.degrees(np.linalg.norm(sd[3:])):.3f} deg (3-D)"
    )
