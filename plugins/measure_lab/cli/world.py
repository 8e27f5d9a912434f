"""`measure world`: a calibration's world put where a body is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import RequiredOut, command
from measure.geometry import UncertainTransform
from measure_lab import api as lab

_AT = Annotated[float | None, Parameter(name="--at")]


@command(lab.world, at_s=_AT, points=tuple[int, int, int] | None, out=RequiredOut)
def world(
    made: tuple[api.Calibration, UncertainTransform], out: Path, json: JsonFlag = False
) -> None:
    """Print where the origin is now."""
    _, place = made
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
