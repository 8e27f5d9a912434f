"""The camera that took a single picture: calibrated, or what is assumed of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from measure import model
from measure.arrays import Floats
from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.model.camera import USUAL_FOCAL
from measure.session import read_calibration

_USUAL_LOG_SD, _TAG_LOG_SD = 0.8, 0.15
"""Standard deviation of the logarithm of a focal length that is assumed: between 0.3 and 1.6 times
the longer side, most are; and of one by the picture's tags: pictures are cropped."""
_TRIED = (0.42, 0.5, 0.6, 0.72, 0.86, 1.05, 1.3, 1.8, 3.0, 8.0)
"""Focal lengths over the longer side by which balls are looked for while it is not known: outlines
are found that fit within a pixel or two."""
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_TELLING_SCORE = 0.7  # Least score of balls whose outlines tell a focal length


class FocalFrom(StrEnum):
    """Where a focal length comes from."""

    CALIBRATION = "calibration"
    GIVEN = "given"
    TAGS = "exif"
    BALLS = "balls"
    USUAL = "assumed"


@dataclass(frozen=True)
class Lens:
    """What is known of the camera that took the pictures.

    Attributes:
        calibration: of the camera, if there is one.
        camera: the camera's name in it; may be left out if it holds one only.
        focal_px: the focal length without a calibration; if omitted, it is found from the outlines
            of the balls, or assumed.
    """

    calibration: Path | None = None
    camera: str | None = None
    focal_px: float | None = None


class LensOf:
    """The camera of a picture: calibrated, or a plain one of the picture's size."""

    def __init__(self, given: Lens | model.Camera) -> None:
        lens = given if isinstance(given, Lens) else Lens()
        self._focal_px, self._calibration = lens.focal_px, lens.calibration
        self._calibrated = given if isinstance(given, model.Camera) else None
        if lens.calibration is not None:
            if lens.focal_px is not None:
                raise ConfigError("--focal-px and --calibration both give a focal length: give one")
            self._calibrated = _chosen(lens.calibration, lens.camera)
        elif lens.camera is not None:
            raise ConfigError(f"--camera {lens.camera}: give the --calibration that holds it")
        if lens.focal_px is not None and not 0 < lens.focal_px < np.inf:
            raise ConfigError(f"--focal-px {lens.focal_px}: expected a length in px above 0")

    @property
    def focal_from(self) -> FocalFrom:
        """Where the focal length comes from."""
        if self._calibrated is not None:
            return FocalFrom.CALIBRATION
        return FocalFrom.USUAL if self._focal_px is None else FocalFrom.GIVEN

    def of(self, width: int, height: int, picture: Path) -> model.Camera:
        """The camera that took a picture of this size; ConfigError if it is of another."""
        if self._calibrated is None:
            focal = self._focal_px or USUAL_FOCAL * max(width, height)
            matrix = [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]
            lens = model.Intrinsics((width, height), np.array(matrix), np.zeros(5))
            return model.Camera("camera", lens, RigidTransform.identity())
        size = self._calibrated.intrinsics.size_wh
        if size != (width, height):
            raise ConfigError(
                f"{picture}: is {width}x{height} px, but {self._calibration} holds "
                f"'{self._calibrated.name}' for {size[0]}x{size[1]}: give the camera that took it"
            )
        return self._calibrated


def _chosen(path: Path, name: str | None) -> model.Camera:
    cameras: Mapping[str, model.Camera] = {c.name: c for c in read_calibration(path).cameras}
    if name is None and len(cameras) == 1:
        (name,) = cameras
    if name is None or name not in cameras:
        given = "which camera took the pictures?" if name is None else f"it has no '{name}':"
        raise ConfigError(f"{path}: {given} give --camera, one of {', '.join(cameras)}")
    return cameras[name]


Look = Callable[[model.Camera], Sequence[model.Detection]]
"""What is seen in a picture if a camera has taken it."""


def camera_by_balls(
    camera: model.Camera, focal_35mm: float | None, look: Look
) -> tuple[model.Camera, FocalFrom]:
    """A camera of the focal length that the picture's tags tell, or else the balls in it.

    Args:
        camera: with the usual focal length.
        focal_35mm: by the picture's tags, in mm on film of 36 x 24 mm.
    """
    from measure.estimation.focal_length import focal_by_outlines

    width, height = camera.intrinsics.size_wh
    expected, log_sd, source = camera, _USUAL_LOG_SD, FocalFrom.USUAL
    if focal_35mm is not None:
        tagged = _of_focal(camera, tagged_px(focal_35mm, (width, height)))
        expected, log_sd, source = tagged, _TAG_LOG_SD, FocalFrom.TAGS
    tried = [_of_focal(camera, share * max(width, height)) for share in _TRIED]
    outlines = _outlines(map(look, (expected, *tried)))
    found = focal_by_outlines(outlines, expected.intrinsics, log_sd)
    if found is None or not found.contradicts:
        return expected, source
    # Once more by the outlines that are found with it: those before were found with other ones.
    better = _of_focal(camera, found.px)
    again = focal_by_outlines(_outlines([look(better)]), expected.intrinsics, log_sd)
    return _of_focal(camera, again.px) if again else better, FocalFrom.BALLS


def tagged_px(focal_35mm: float, size_wh: tuple[int, int]) -> float:
    """The focal length in px that a picture's tags tell, in mm on film of 36 x 24 mm."""
    return focal_35mm / _FILM_DIAGONAL_MM * math.hypot(*size_wh)


def _of_focal(camera: model.Camera, focal_px: float) -> model.Camera:
    from measure.estimation.focal_length import zoomed

    lens = camera.intrinsics
    return replace(camera, intrinsics=zoomed(lens, focal_px / lens.focal_px))


def _outlines(seen: Iterable[Sequence[model.Detection]]) -> list[Floats]:
    """The outlines (n, 2) of distinct balls: of those found several times, the completest one."""
    known = [
        (d.score * len(d.outline_px), d.center_px, d.radius_px, d.outline_px)
        for some in seen
        for d in some
        if d.outline_px is not None and d.score >= _TELLING_SCORE
    ]
    kept: list[tuple[Floats, float, Floats]] = []
    for _, center, radius, outline in sorted(known, key=lambda one: -one[0]):
        if all(np.linalg.norm(center - at) > max(radius, size) / 2 for at, size, _ in kept):
            kept.append((center, radius, outline))
    return [outline for *_, outline in kept]
