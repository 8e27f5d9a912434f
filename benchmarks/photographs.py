"""Real balls on photographs, with outlines marked by hand: who finds them, and how well."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baselines import FitEllipse, MaskCentroid, OpenCvHough, OpenCvHoughAlt
from measure.arrays import Floats
from measure.geometry import RigidTransform, chi_square_quantile
from measure.host import Detector
from measure.host.settings import Settings
from measure.model import Ball, BallColor, Body, Camera, Detection, Expectation, Image, Intrinsics
from measure.session import read_picture
from measure_plugins.detectors._known_balls import OutlineConfig
from measure_plugins.detectors.outline import OutlineDetector

MakeDetector = Callable[[Body, Camera], Detector]
BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"
HEAD = ("method", "found %", "centre px", "in 95 %", "expected: found %", "centre px", "in 95 %")
_MARKS = ("photographs", "dvrk_red_spheres")
"""Folders with outlines marked by hand."""
_FINE = ("posts", "sorter")
"""Names of marks that are good to about 0.15 px; the others are to about 0.4 px."""
_USUAL_FOCAL = 0.72
_RADIUS_MM = 20.0
_ASIDE_PX = (1.27, -1.27)
_FOUND_WITHIN = 0.25
"""Distance from the true centre, in radii, within which a ball is found."""


@dataclass(frozen=True, eq=False)
class MarkedBall:
    """A ball on a photograph.

    Attributes:
        name: of the mark.
        file: the photograph.
        color: of the ball.
        camera: that took it: as well as is known.
        center_px: (2,) the image of the ball's centre, which the marked ellipse's is not.
        radius_px: mean radius of its outline.
        sd_px: of the mark's centre, per axis.
    """

    name: str
    file: Path
    color: BallColor
    camera: Camera
    center_px: Floats
    radius_px: float
    sd_px: float

    def image(self) -> Image:
        """The photograph."""
        return Image("camera", 0, 0.0, partial(read_picture, self.file))

    def body(self) -> Body:
        """A body one of whose balls is this one; the others are of colours rare in pictures."""
        others = [name for name in ("purple", "cyan", "green") if name != self.color.name][:2]
        colors = (self.color, *map(BallColor.named, others))
        places = ((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 80.0, 0.0))
        named = zip(("ball", "first", "second"), colors, places, strict=True)
        return Body("photographed", tuple(Ball(n, c, np.array(p), _RADIUS_MM) for n, c, p in named))

    def expectation(self, size: float = 1.0) -> Expectation:
        """The ball a little aside, `size` times as large as it is marked."""
        center, radius = self.center_px + _ASIDE_PX, size * self.radius_px
        lens = self.camera.intrinsics
        axis = lens.unproject(center[None])[0]
        distance = _RADIUS_MM * lens.focal_px / radius
        for _ in range(4):
            outline = self.camera.outline(distance * axis, _RADIUS_MM)
            distance *= np.linalg.norm(outline - outline.mean(axis=0), axis=1).mean() / radius
        limits, place = (radius / 1.25, radius * 1.25), distance * axis
        return Expectation(
            "ball", center, limits, 2 * radius, radius / 2, center_camera=np.asarray(place)
        )


@dataclass(frozen=True)
class Seen:
    """What a method makes of one ball: error of its centre, px, and whether that is in the region.

    Both None if it was not found.
    """

    error_px: float | None
    in_region: bool | None


def marked_balls(folder: Path = BESIDE) -> list[MarkedBall]:
    """All marked balls; none where there are no photographs."""
    files = [folder / name / "marks.json" for name in _MARKS]
    return [
        _marked(name, mark, file.parent)
        for file in files
        if file.exists()
        for name, mark in json.loads(file.read_text(encoding="utf-8")).items()
    ]


def _marked(name: str, mark: dict[str, Any], folder: Path) -> MarkedBall:
    file = (folder / mark["file"]).resolve()
    camera = camera_of(file, mark.get("focal_px"))
    center = np.array(mark.get("center_px") or mark["center"])
    axes = np.array(mark.get("semi_axes_px") or mark["semi_axes"])
    c, s = np.cos(mark["angle_rad"]), np.sin(mark["angle_rad"])
    turn = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    circle = axes * np.column_stack([np.cos(turn), np.sin(turn)])
    bearings = camera.intrinsics.unproject(circle @ [[c, s], [-s, c]] + center)
    # The axis a of the cone: a . b is the same for all its bearings b.
    axis = np.linalg.lstsq(bearings, np.ones(len(bearings)), rcond=None)[0]
    true = camera.project(axis[None])[0]
    color = BallColor.named(mark.get("color") or mark["colour"])
    sd = 0.15 if name.startswith(_FINE) else 0.4
    return MarkedBall(name, file, color, camera, true, float(axes.mean()), sd)


def camera_of(file: Path, focal_px: float | None = None) -> Camera:
    """The camera of a photograph, with an ordinary webcam's focal length if it is not known."""
    height, width = read_picture(file).shape[:2]
    focal = focal_px or _USUAL_FOCAL * max(width, height)
    lens = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera("camera", Intrinsics((width, height), lens), RigidTransform.identity())


def detections(make: MakeDetector, ball: MarkedBall, size: float | None = None) -> list[Detection]:
    """Search a photograph for a ball, or measure it where it is, expected `size` times as large."""
    told = () if size is None else (ball.expectation(size),)
    return [
        d for d in make(ball.body(), ball.camera).detect(ball.image(), told) if d.ball == "ball"
    ]


def look(make: MakeDetector, ball: MarkedBall, size: float | None = None) -> Seen:
    """How well a ball is found, see `detections`.

    Of several candidates the nearest to the truth counts: which is the ball, geometry decides.
    """
    found = detections(make, ball, size)
    best = min(found, key=lambda d: float(_off(d, ball) @ _off(d, ball)), default=None)
    if best is None or np.linalg.norm(_off(best, ball)) > _FOUND_WITHIN * ball.radius_px:
        return Seen(None, None)
    off = _off(best, ball)
    covariance = best.covariance_px + ball.sd_px**2 * np.eye(2)
    held = off @ np.linalg.solve(covariance, off) < chi_square_quantile(0.95, 2)
    return Seen(float(np.linalg.norm(off)), bool(held))


def _off(detection: Detection, ball: MarkedBall) -> Floats:
    return np.asarray(detection.center_px - ball.center_px)


def outline(body: Body, camera: Camera) -> OutlineDetector:
    """The program's own detector."""
    return OutlineDetector(OutlineConfig(), body, camera)


def photograph_rows(balls: Sequence[MarkedBall]) -> Iterator[tuple[str, ...]]:
    """A row for every method, see `HEAD`."""
    for peer in (OpenCvHough, OpenCvHoughAlt, MaskCentroid, FitEllipse):
        yield peer.name, *_cells(partial(peer, Settings()), balls, states_covariance=False)
    yield "outline", *_cells(outline, balls, states_covariance=True)


def _cells(
    make: MakeDetector, balls: Sequence[MarkedBall], *, states_covariance: bool
) -> Iterator[str]:
    for size in (None, 1.0):
        seen = [look(make, ball, size) for ball in balls]
        errors = np.array([one.error_px for one in seen if one.error_px is not None])
        yield f"{100 * len(errors) / len(balls):.0f}"
        yield f"{np.sqrt(np.mean(errors**2)):.2f}" if len(errors) else "-"
        held = [one.in_region for one in seen if one.in_region is not None]
        yield f"{100 * np.mean(held):.0f}" if states_covariance else "-"
