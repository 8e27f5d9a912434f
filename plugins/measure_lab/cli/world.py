"""`measure world`: a calibration's world put where a body is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cyclopts import Parameter

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.errors import ConfigError
from measure_lab import api as lab


@Parameter(name="*")
@dataclass(frozen=True)
class _PlaceOptions:
    """Where to put the world.

    Attributes:
        run: a run with the body where you want the world.
        at: time of the pose, in seconds as in poses.csv.
        rest: number of a rest (`measure rests`); the longest, if no place is given.
        points: three rests of a pivoted tip instead: at the origin, on the x axis, and in the xy
            plane where y is positive.
        body: which body, of a run of several.
    """

    run: Path | None = None
    at: float | None = None
    rest: int | None = None
    points: tuple[int, int, int] | None = None
    body: str | None = None


def world(
    calibration: Path,
    /,
    *,
    where: _PlaceOptions = _PlaceOptions(),
    board: Path | None = None,
    pictures: Path | None = None,
    out: OutFile,
    overwrite: Overwrite = False,
    json: JsonFlag = False,
) -> None:
    """Set the world's origin by a body, a board or three touches.

    The world becomes the frame of the body at that instant or rest, a frame through three rests of
    a tip, or that of a board, z up from the paper. Covariances of the cameras are carried along.

    Args:
        calibration: that the run was measured with.
        board: instead of a run, a target file of a board that lies there.
        pictures: folder with a picture of the board by each camera, named like the camera.
        out: the calibration to write.
    """
    with api.output(out, overwrite) as file:
        if where.run is not None and board is None and pictures is None:
            found, place = lab.world(
                calibration, where.run, where.at, where.rest, where.points, where.body
            )
        elif where.run is None and board is not None and pictures is not None:
            found, place = lab.world_by_board(calibration, board, pictures)
        else:
            raise ConfigError("say where it is: --run RUN, or --board FILE --pictures FOLDER")
        api.write_calibration(file, found)
    pose, sd = place.transform, np.sqrt(np.diag(place.covariance))
    if json:
        there = {"quat_wxyz": pose.quat_wxyz, "translation_mm": pose.translation}
        console.print_json({"output": out, **there, "covariance": place.covariance})
        return
    at_mm = ", ".join(f"{value:.3f}" for value in pose.translation)
    console.print_text(
        f"wrote {out}: its origin is at ({at_mm}) mm of the old world, known to "
        f"{np.linalg.norm(sd[:3]):.3f} mm and {np.degrees(np.linalg.norm(sd[3:])):.3f} deg (3-D)"
    )
