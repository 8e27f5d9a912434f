"""Calibrations whatever their format, checked for what no single camera shows."""

from __future__ import annotations

import logging
import tomllib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from measure.bags import is_bag, split_topic
from measure.errors import CalibrationError
from measure.model import Intrinsics
from measure.reading import parse_toml, read_toml_text
from measure.session import calibration_file
from measure.session.files import check_name
from measure.session.formats import able, format_for, formats
from measure.session.stated_rig import Sizes, StatedRig, Unit
from measure.session.tracked_body import FARTHEST_MM

_log = logging.getLogger(__name__)

OWN_FORMAT = "triball"
"""Name of our own format, among those of other programs."""

_FOCAL_SIZES = 0.05, 200.0
"""Least and largest focal length of what may be a lens, in sizes of its picture."""
_MIDDLE, _SAME_PX = (0.25, 0.5, 0.75), 0.01
_MAX_DISTORTION_RATIO, _NEAR_SHARE = 3.0, 0.01
"""Largest ratio of distorted to ideal distance from the principal point in the middle half of the
picture, and the share of the picture added to both."""
METRES_SPREAD_MM = 3.0
"""Cameras all within this many "mm" of the first were surely written in metres."""


def read_calibration(
    path: Path | str, unit: Unit | None = None, pictures: Sizes | None = None
) -> calibration_file.Calibration:
    """Read a calibration: ours or another program's, distinguished by content.

    For files of other programs: the unit of their translations, if they state none; and names of
    the cameras that are wanted, with the sizes of their pictures, if they number their cameras or
    state no sizes. CalibrationError: the file cannot be used, two cameras share a name, or the
    translations cannot be in the unit taken.
    """
    path = Path(path)
    stated = _foreign(path)
    if stated is None:
        calibration = calibration_file.read_own_calibration(path)
    else:
        calibration = stated.calibration(path, unit, pictures or {})
    check_calibration(calibration, str(path))
    return calibration


def read_intrinsics(path: Path | str) -> dict[str, Intrinsics]:
    """The lenses alone, by camera name, poses or not; CalibrationError if there are none."""
    path = Path(path)
    stated = _foreign(path)
    if stated is not None:
        return stated.lenses(path)
    stated_here = calibration_file.read_own_lenses(path)
    _check_lenses(stated_here, str(path))
    return {camera.name: camera.intrinsics for camera in stated_here.cameras}


def _foreign(path: Path) -> StatedRig | None:
    """The rig in a file of another program; None if it is ours."""
    text, toml = "", path.suffix.lower() == ".toml"
    if not is_bag(split_topic(path)[0]):
        text = read_toml_text(path, CalibrationError)
        with suppress(tomllib.TOMLDecodeError):
            if isinstance(parse_toml(text).get("cameras"), list):
                return None
            toml = True
    for read in able("read_calibration").values():
        if (rig := read(path, text)) is not None:
            return cast("StatedRig", rig)
    if toml:
        return None
    known = "; ".join(one.does for one in formats().values() if one.read_calibration)
    raise CalibrationError(
        f"{path}: holds no camera that is read; calibrations are read as this program's TOML; "
        f"{known}"
    )


def write_calibration(
    path: Path | str, calibration: calibration_file.Calibration, file_format: str = OWN_FORMAT
) -> None:
    """Write a calibration; only our own format holds covariances, shutters and provenance.

    ConfigError: no package brings a format of this name.
    """
    if file_format == OWN_FORMAT:
        calibration_file.write_own_calibration(Path(path), calibration)
        return
    write = format_for("write_calibration", file_format).write_calibration
    assert write is not None
    _warn_of_losses(path, calibration, file_format)
    write(Path(path), calibration)


def _warn_of_losses(
    path: Path | str, calibration: calibration_file.Calibration, file_format: str
) -> None:
    """Log what a format of another program cannot hold."""
    cameras = calibration.cameras
    lost = {
        "rolling shutter (readout_s)": [c.name for c in cameras if c.readout_s],
        "lateral colour": [c.name for c in cameras if any(c.intrinsics.lateral_color or ())],
    }
    for what, names in lost.items():
        if names:
            _log.warning(
                "%s: a file for %s cannot hold the %s of %s: what is measured with it will be off",
                path,
                file_format,
                what,
                ", ".join(names),
            )


def check_calibration(calibration: calibration_file.Calibration, source: str) -> None:
    """Refuse (CalibrationError) what cannot be right.

    No camera, two of one name, a lens that there cannot be, or all so close together that their
    translations must be metres, or so far apart that they cannot be mm.
    """
    _check_lenses(calibration, source)
    if len(calibration.cameras) < 2:
        return
    centers = np.stack([camera.center for camera in calibration.cameras])
    with np.errstate(over="ignore"):
        spread = float(np.linalg.norm(centers - centers[0], axis=1).max())
    if spread < METRES_SPREAD_MM:
        raise CalibrationError(
            f"{source}: the cameras stand within {spread:.3g} mm of each other: the translations "
            "look like metres; write mm, or for another program's file say calibration_unit = "
            '"m" in [session]'
        )
    if spread > FARTHEST_MM:
        raise CalibrationError(
            f"{source}: the cameras stand up to {spread:.3g} mm apart: are the translations in mm?"
        )


def _check_lenses(calibration: calibration_file.Calibration, source: str) -> None:
    """Refuse names that are none or occur twice, and lenses that there cannot be."""
    names = calibration.names
    if not names:
        raise CalibrationError(f"{source}: holds no calibrated camera")
    for name in names:
        try:
            check_name(name)
        except ValueError as problem:
            raise CalibrationError(f"{source}: a camera's name: {problem}") from None
        if names.count(name) > 1:
            raise CalibrationError(f"{source}: camera '{name}' is there {names.count(name)} times")
    for camera in calibration.cameras:
        if not _is_a_lens(camera.intrinsics):
            raise CalibrationError(
                f"{source}: camera '{camera.name}': no lens sees pictures of "
                f"{camera.intrinsics.size_wh[0]}x{camera.intrinsics.size_wh[1]} px with this "
                "matrix and distortion: are they in px, and of this camera?"
            )


def _is_a_lens(lens: Intrinsics) -> bool:
    """Whether the middle half of the picture is seen along rays that lead back to it."""
    if not _FOCAL_SIZES[0] <= lens.focal_px / max(lens.size_wh) <= _FOCAL_SIZES[1]:
        return False
    if abs(lens.matrix[0, 1]) > lens.focal_px:  # rows of pixels more than 45 deg askew
        return False
    pixels = np.array([(u, v) for u in _MIDDLE for v in _MIDDLE]) * lens.size_wh
    straight = replace(lens, distortion=np.zeros(8))
    with np.errstate(all="ignore"):
        rays = lens.unproject(pixels)
        moved = np.abs(lens.project(rays) - pixels)
        seen, ideal = (
            np.linalg.norm(places - lens.matrix[:2, 2], axis=1) + _NEAR_SHARE * max(lens.size_wh)
            for places in (pixels, straight.project(rays))
        )
        bent = np.maximum(seen / ideal, ideal / seen)
    return bool(np.all(moved < _SAME_PX) and np.all(bent < _MAX_DISTORTION_RATIO))
