"""A body file from a recording in which the balls are seen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from measure.api.measuring import search_frame_sets
from measure.api.profiles import build_detectors, load_profile
from measure.api.refining import joint_covariance, lenient, measure_all
from measure.arrays import Floats
from measure.calibration import RefineSettings, refine_rig
from measure.calibration.refining.recording import recording_of
from measure.checking.unknown_body import PALETTES, SeenBall, find_layout, locate, probe
from measure.errors import ConfigError
from measure.geometry import RigidTransform, align_points
from measure.host import Registry
from measure.measuring import Profile
from measure.measuring.association import associate
from measure.model import Body, Detection
from measure.processes import Progress
from measure.session import Session, open_session, read_body

_SEARCHED = 24  # Frame sets, spread over the recording, in which whole pictures are searched
_ROUGH_MM, _FREE_MM = 0.5, 5.0
"""Standard deviations of a ball's centre: by the search alone, and while it is adjusted."""


@dataclass(frozen=True, eq=False)
class FoundBody:
    """A body as a recording shows it."""

    body: Body  # in the stated frame; its `tolerance_mm` is what is left of its uncertainty
    # (mm, standard deviation in mm) of every two balls.
    distances: Mapping[tuple[str, str], tuple[float, float]]
    frame: str  # where its origin is and how its axes lie, in words
    frame_sets: int  # how many it rests on
    rms_px: float  # of what is left of the balls' centres in the pictures


def find_body(
    session: Path | str,
    registry: Registry,
    radius_mm: float,
    like: Path | str | None = None,
    origin: str | None = None,
    profile: str = "precise",
    calibration: Path | str | None = None,
    progress: Progress | None = None,
) -> FoundBody:
    """Find a body's balls in a recording, and adjust their places to all its pictures.

    Args:
        session: needs no body; one that it names is not read.
        radius_mm: of all balls.
        like: a body file with the names, the colours and the frame to use; its layout serves
            only to tell balls of one colour apart.
        origin: name of the ball to put the origin at; the centroid, or that of `like`, if omitted.
        profile: how to measure, by name or TOML file.
        calibration: a calibration file to use instead of the session's own.
        progress: called with how many frame sets are done, and of how many.

    Raises:
        SessionError: fewer than three balls, two of one colour, or balls of another size.
        CalibrationError: too few frame sets in which they are measured.
        MeasureError: the recording cannot be opened.
    """
    if not 0 < radius_mm < np.inf:
        raise ConfigError(f"--radius-mm {radius_mm:g}: expected a length in mm above 0")
    pattern = None if like is None else _of_size(read_body(like), radius_mm)
    chosen = load_profile(profile)
    probes = [pattern] if pattern else [probe(p, radius_mm) for p in PALETTES]
    with open_session(session, calibration, probes[0]) as opened:
        frames = list(_searched(opened, probes, pattern, chosen, registry, progress))
        every = pattern or probe([c for p in PALETTES for c in p], radius_mm)
        rough = find_layout(frames, every, pick=pattern is None)
        if origin is not None and origin not in rough.names:
            raise ConfigError(
                f"--origin {origin}: there is no such ball, but {', '.join(rough.names)}"
            )
        rough = replace(rough, name="body" if pattern is None else pattern.name)
        return _adjusted(opened, rough, pattern, origin, chosen, registry, progress)


def _of_size(body: Body, radius_mm: float) -> Body:
    return replace(body, balls=tuple(replace(ball, radius_mm=radius_mm) for ball in body.balls))


def _searched(
    session: Session,
    probes: Sequence[Body],
    pattern: Body | None,
    profile: Profile,
    registry: Registry,
    progress: Progress | None,
) -> Iterator[dict[str, SeenBall]]:
    """The balls located in frame sets spread over the recording, by whole pictures."""
    searches = [build_detectors(profile, registry, body, session.cameras) for body in probes]
    total = len(session.pair().times_s)
    chosen = np.unique(np.linspace(0, total - 1, min(_SEARCHED, total)).round().astype(int))
    for done, (_, found) in enumerate(search_frame_sets(session, searches, chosen.tolist()), 1):
        located: dict[str, SeenBall] = {}
        for body, seen in zip(probes, found, strict=True):
            if body is pattern:
                # A known layout has told other things of these colours apart: two rays will do.
                mine = _of_this_body(seen, body, session)
                located |= locate(mine, body, session.cameras, 2)
            else:
                located |= locate(seen, body, session.cameras)
        if progress is not None:
            progress(done, len(chosen))
        yield located


def _of_this_body(
    seen: Mapping[str, list[Detection]], body: Body, session: Session
) -> Mapping[str, list[Detection]]:
    """Those that lie as in a file with this layout; all if none do, and no colour repeats."""
    found = associate(body, session.cameras, seen)
    if found.world_from_body is None and len({b.color for b in body.balls}) == len(body.balls):
        return seen
    kept: dict[str, list[Detection]] = {name: [] for name in seen}
    for detection in found.detections:
        kept[detection.camera].append(detection)
    return kept


def _adjusted(
    session: Session,
    rough: Body,
    pattern: Body | None,
    origin: str | None,
    profile: Profile,
    registry: Registry,
    progress: Progress | None,
) -> FoundBody:
    """Measure the recording with a rough body, and adjust that by bundle adjustment."""
    first = replace(rough, tolerance_mm=_ROUGH_MM)
    measured, sized = measure_all(
        replace(session, body=first), lenient(profile), registry, progress
    )
    recording = recording_of(measured, sized, least_motion_mm=0.0)
    refined = refine_rig(
        session.cameras,
        sized,
        recording,
        RefineSettings(body_tolerance_mm=_FREE_MM),
        joint_covariance(session),
    )
    distances = _distances(sized.names, refined.centers, refined.center_covariance)
    variance = np.mean([sd**2 for _, sd in distances.values()])
    place, words = _frame(refined.centers, sized.names, pattern, origin)
    body = replace(
        _of_size(sized, rough.radii[0]).with_centers(place.inverse().apply(refined.centers)),
        tolerance_mm=float(np.sqrt(variance / 2)),
    )
    rms = float(np.sqrt(np.mean([after**2 for _, after in refined.rms_px.values()])))
    return FoundBody(body, distances, words, refined.frames, rms)


def _distances(
    names: tuple[str, ...], centers: Floats, covariance: Floats
) -> dict[tuple[str, str], tuple[float, float]]:
    """Distances and their standard deviations: a turn of the whole body changes none."""
    out = {}
    for i, j in combinations(range(len(names)), 2):
        way = centers[i] - centers[j]
        length = float(np.linalg.norm(way))
        by_center = np.zeros(centers.shape)
        by_center[i], by_center[j] = way / length, -way / length
        row = by_center.ravel()
        out[names[i], names[j]] = (length, float(np.sqrt(row @ covariance @ row)))
    return out


def _frame(
    centers: Floats, names: tuple[str, ...], pattern: Body | None, origin: str | None
) -> tuple[RigidTransform, str]:
    """The frame of the new body, in that of `centers`, and in words."""
    at = centers.mean(axis=0) if origin is None else centers[names.index(origin)]
    where = "the balls' centroid" if origin is None else f"ball {origin}"
    if pattern is not None:
        like = align_points(centers, pattern.centers_of(names))
        if origin is None:
            return like, "origin and axes as in the file of --like, fitted to all balls"
        return RigidTransform(like.rotation, at), f"origin at {where}, axes as in that of --like"
    x = (centers[1] - centers[0]) / np.linalg.norm(centers[1] - centers[0])
    normals = np.cross(x, centers - centers[0])
    third = int(np.argmax(np.linalg.norm(normals, axis=1)))
    z = normals[third] / np.linalg.norm(normals[third])
    words = (
        f"origin at {where}, x along the way from {names[0]} to {names[1]}, y in the plane "
        f"of these and {names[third]}, towards it"
    )
    return RigidTransform(np.stack([x, np.cross(z, x), z], axis=1), at), words
