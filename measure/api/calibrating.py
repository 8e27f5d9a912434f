"""Calibrating a rig from a capture folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from measure.calibration import Method, RigCalibration, Verdict
from measure.errors import ConfigError
from measure.session import Calibration, read_body


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibration, how it came about and how good it is."""

    calibration: Calibration
    rig: RigCalibration
    verdict: Verdict


def calibrate(
    capture: Path | str,
    method: Method = "joint",
    body: Path | str | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> CalibrationResult:
    """Calibrate the cameras of a capture folder and judge the result.

    Args:
        capture: the folder, or its capture.toml.
        method: "joint" or "paper".
        body: body file to judge with; the paper's three-ball body if omitted.
        progress: told how many cameras are done, and of how many.

    Raises:
        CalibrationError: what cannot give a trustworthy calibration, with its cause.
        SessionError: a picture, video or body file that cannot be read.
        ConfigError: an unknown method.
    """
    from measure.calibration import (
        calibrate_capture,
        judge,
        open_capture,
        paper_body,
        provenance,
    )

    if method not in ("joint", "paper"):
        raise ConfigError(f"no calibration method is called '{method}'; there is joint and paper")
    opened = open_capture(capture)
    measured_with = paper_body() if body is None else read_body(body)
    rig = calibrate_capture(opened, method, progress)
    verdict = judge(rig, measured_with, opened.settings.floor_z_mm)
    values = provenance(rig, verdict, opened.settings.name)
    return CalibrationResult(Calibration(rig.cameras, values), rig, verdict)
