"""The recorded body compared with its file: distances, radii, colours, handedness.

No pose is needed, so the check works with a body file too wrong to track with.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from measure.arrays import Floats
from measure.checking.body_explanations import Compared, blind_to, layout_findings, radius_findings
from measure.estimation.body_layout import looks_mirrored
from measure.geometry.covariance import MAD_TO_SD
from measure.measuring.association.candidates import by_ball, intersect_rays
from measure.model import Body, Camera, Detection

_SIGMAS = 4.0
_MIN_FRAMES = 3
_RANGE_RATIO = 2.5
_EDGE_BIAS_PX = 0.8
"""Systematic error of a ball's radius: glossy paint loses its colour inside the true outline."""
_SAME_BALL_RADII = 0.2
"""Distance of an outline's centre from a ball's, in radii, up to which it is that ball's."""
_MAX_INDEPENDENT_FRAMES = 10
"""Frames share errors of calibration and edges: no more count as independent."""


@dataclass(frozen=True, eq=False)
class LocatedBalls:
    """Balls located in one frame set, independent of the body's shape."""

    centers: Mapping[str, Floats]  # (3,) in the world by ball name, mm
    variances: Mapping[str, float]  # mean variance of a coordinate by ball name, mm^2
    # (mm, standard deviation in mm) by ball name, from the outlines.
    radii: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class BodyCheck:
    """The body as recorded, compared with its file."""

    distances: tuple[Compared, ...] = ()  # of every pair of balls that was located often enough
    radii: tuple[Compared, ...] = ()  # of every ball that was located often enough
    findings: tuple[str, ...] = ()  # what is wrong, a line each; empty if nothing is
    blind_to: tuple[str, ...] = ()  # mistakes that the located balls cannot show, a line each


def locate_balls(
    detections: Mapping[str, Sequence[Detection]], body: Body, cameras: Sequence[Camera]
) -> LocatedBalls:
    """Balls where the rays of most cameras intersect, in whole frames, if no colour repeats."""
    centers, variances, radii = {}, {}, {}
    for ball, candidates in zip(body.balls, by_ball(detections, body.balls, cameras), strict=True):
        points = intersect_rays(candidates, _SIGMAS, _RANGE_RATIO, max_points=1)
        if not len(points.points) or points.support[0] < min(3, len(cameras)):
            continue
        centers[ball.name] = points.points[0]
        variances[ball.name] = float(points.sd_mm[0] ** 2)
        near = outline_sizes(candidates.detections, points.points[0], cameras)
        if near:
            # The deviation is that of one view, as the bias of edges is common to all.
            radius, sd = np.median(near, axis=0).tolist()
            radii[ball.name] = (radius, sd)
    return LocatedBalls(centers, variances, radii)


def check_body(located: Iterable[LocatedBalls], body: Body) -> BodyCheck:
    """Compare the balls located in all frames with the body file."""
    frames = list(located)
    distances = tuple(
        compared
        for a, b in combinations(body.names, 2)
        if (compared := _distance(frames, body, a, b)) is not None
    )
    radii = tuple(
        compared for name in body.names if (compared := _radius(frames, body, name)) is not None
    )
    known = {name for compared in distances for name in compared.what}
    findings = [*layout_findings(distances, body), *radius_findings(radii)]
    if _mostly_mirrored(frames, body):
        findings.append(
            "the balls form the mirror image of the body file: one coordinate has the wrong sign"
        )
    return BodyCheck(distances, radii, tuple(findings), blind_to(body, known))


def outline_sizes(
    detections: Sequence[Detection], center: Floats, cameras: Sequence[Camera]
) -> list[tuple[float, float]]:
    """(radius in mm, its standard deviation) from every outline around a ball at `center`."""
    by_name = {camera.name: camera for camera in cameras}
    out = []
    for d in detections:
        camera = by_name[d.camera]
        off = np.linalg.norm(camera.project(center[None])[0] - d.center_px)
        if not off < _SAME_BALL_RADII * d.radius_px:
            continue
        focal = camera.intrinsics.focal_px
        distance = float(np.linalg.norm(center - camera.center))
        radius = distance * d.radius_px / np.hypot(d.radius_px, focal)
        sd_px = np.hypot(_EDGE_BIAS_PX, np.sqrt(d.variance_px2))
        out.append((float(radius), float(radius * sd_px / d.radius_px)))
    return out


def _distance(frames: Sequence[LocatedBalls], body: Body, a: str, b: str) -> Compared | None:
    both = [f for f in frames if a in f.centers and b in f.centers]
    if len(both) < _MIN_FRAMES:
        return None
    lengths = np.array([np.linalg.norm(f.centers[a] - f.centers[b]) for f in both])
    stated = np.sqrt(np.median([f.variances[a] + f.variances[b] for f in both]))
    file_mm = float(np.linalg.norm(body.centers[body.index(a)] - body.centers[body.index(b)]))
    median, scatter = _robust_mean(lengths, float(stated))
    sd = float(np.hypot(scatter, body.distance_sd_mm))
    return Compared((a, b), median, sd, file_mm, len(both))


def _radius(frames: Sequence[LocatedBalls], body: Body, name: str) -> Compared | None:
    seen = [f.radii[name] for f in frames if name in f.radii]
    if len(seen) < _MIN_FRAMES:
        return None
    values = np.array([radius for radius, _ in seen])
    common = float(np.median([sd for _, sd in seen]))
    median, scatter = _robust_mean(values, 0.0)
    file_mm = float(body.radii[body.index(name)])
    return Compared((name,), median, float(np.hypot(scatter, common)), file_mm, len(seen))


def _robust_mean(values: Floats, stated_sd: float) -> tuple[float, float]:
    """Median, and its standard deviation by scatter or as stated, whichever is larger."""
    median = float(np.median(values))
    scatter = MAD_TO_SD * float(np.median(np.abs(values - median)))
    count = min(len(values), _MAX_INDEPENDENT_FRAMES)
    return median, float(1.25 * max(scatter, stated_sd) / np.sqrt(count))


def _mostly_mirrored(frames: Sequence[LocatedBalls], body: Body) -> bool:
    votes = [
        looks_mirrored(body.centers, np.stack([f.centers[name] for name in body.names]))
        for f in frames
        if all(name in f.centers for name in body.names)
    ]
    return len(votes) >= _MIN_FRAMES and float(np.mean(votes)) > 0.5
