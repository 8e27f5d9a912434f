"""Calibrations whatever their format, checked for what no single camera shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.errors import CalibrationError
from measure.session.calibration_file import Calibration, read_own_calibration

METRES_SPREAD = 3.0
"""Cameras all within this many "mm" were surely written in metres."""


def read_calibration(path: Path | str) -> Calibration:
    """Read a calibration file.

    Raises:
        CalibrationError: the file cannot be used, two cameras share a name, or the translations
            are in metres.
    """
    calibration = read_own_calibration(Path(path))
    check_calibration(calibration, str(path))
    return calibration


def check_calibration(calibration: Calibration, source: str) -> None:
    """Refuse what cannot be right.

    Raises:
        CalibrationError: two cameras share a name, or stand so close together that their
            translations must be metres.
    """
    names = calibration.names
    for name in names:
        if names.count(name) > 1:
            raise CalibrationError(f"{source}: camera '{name}' is there {names.count(name)} times")
    if len(names) < 2:
        return
    centers = np.stack([camera.center for camera in calibration.cameras])
    spread = float(np.linalg.norm(centers - centers[0], axis=1).max())
    if spread < METRES_SPREAD:
        raise CalibrationError(
            f"{source}: the cameras stand within {spread:.3g} mm of each other: "
            "translation_mm must be in mm (these look like metres)"
        )
