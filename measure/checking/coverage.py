"""Coverage: how often cameras saw the balls, and the accuracy to expect there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.checking.body import Compared
from measure.checking.causes import Cause, Word
from measure.checking.finding import Finding, Level
from measure.checking.search import SearchSample
from measure.estimation.expected_accuracy import noise_sd, tolerance_sd
from measure.geometry import RigidTransform
from measure.model import Body, Camera

_MIN_SEEN_SHARE = 0.5
_MAX_CHANCE_SHARE = 0.1  # Of frame sets with a pose, a second body or a reflection by chance
_MIN_ANGLE_DEG = 20.0
_GRID = (-1.0, 0.0, 1.0)


@dataclass(frozen=True)
class Coverage:
    """How often one camera saw one ball, and how often the ball lay in its image."""

    camera: str
    ball: str
    seen: int
    expected: int


def coverage_findings(
    samples: Sequence[SearchSample],
    body: Body,
    cameras: Sequence[Camera],
    distances: Sequence[Compared] = (),
    true_colors: bool = True,
) -> tuple[tuple[Coverage, ...], list[Finding]]:
    """The coverage of every camera and ball, and what is weak about it.

    Args:
        distances: between balls. Where one fits in most frame sets, calibration and body are right.
        true_colors: whether what has a ball's colour looks like a ball: not if overexposed.
    """
    with_pose = [s for s in samples if s.world_from_body is not None]
    table = tuple(_seen(with_pose, body, c, k) for c in cameras for k in range(len(body.balls)))
    findings: list[Finding] = []
    lost = len(samples) - len(with_pose)
    if lost:
        reasons = [s.reason for s in samples if s.world_from_body is None]
        common = max(set(reasons), key=reasons.count)
        fits = any(d.agrees and d.frames > len(samples) / 2 for d in distances)
        by_chance = len(with_pose) <= _MAX_CHANCE_SHARE * len(samples) and not fits
        why = (
            "check the calibration, and the radii in the body file"
            if by_chance
            else "as cameras and body agree elsewhere, balls are hidden there, or out of view"
        )
        text = f"no pose in {lost} of {len(samples)} frame sets looked at, mostly: {common}; {why}"
        findings.append(Finding(Level.WRONG if by_chance else Level.WEAK, "balls", text))
    disagreeing = {cause.of for cause in disagreeing_causes(samples)}
    flagged = [s.flags[0] for s in samples if s.flags]
    if len(flagged) > _MAX_CHANCE_SHARE * len(samples):  # a second body may be in view
        text = f"{flagged[0]} (so in {len(flagged)} of {len(samples)} frame sets looked at)"
        mostly = true_colors and len(flagged) > len(samples) / 2
        findings.append(Finding(Level.WRONG if mostly else Level.WEAK, "balls", text))
    reflections = [s.reflection for s in samples if s.reflection is not None]
    if len(reflections) > _MAX_CHANCE_SHARE * len(samples):
        text = f"{reflections[0]} (so in {len(reflections)} of {len(samples)} frame sets looked at)"
        findings.append(Finding(Level.NOTE, "balls", text))
    for row in table:
        if row.camera not in disagreeing and row.seen < _MIN_SEEN_SHARE * row.expected:
            text = (
                f"{row.camera} sees ball {row.ball} in {row.seen} of {row.expected} frame sets "
                "in which it lies in its picture: hidden, or its colour does not match"
            )
            findings.append(Finding(Level.NOTE, "coverage", text))
    if with_pose and (angle := _widest_angle(with_pose, cameras)) < _MIN_ANGLE_DEG:
        text = (
            f"all cameras look along nearly the same line ({angle:.0f} deg apart at most): "
            "distances will be poor; spread them out"
        )
        findings.append(Finding(Level.WEAK, "coverage", text))
    return table, findings


def disagreeing_causes(samples: Sequence[SearchSample]) -> list[Cause]:
    """Cameras that see balls elsewhere in more than half of the frame sets with a pose."""
    posed = [s for s in samples if s.world_from_body is not None]
    counts = Counter(name for sample in posed for name in sample.disagreeing_cameras)
    return [
        Cause(
            Word.MOVED,
            name,
            f"{name} sees balls, but none where the others do (in {k} of {len(posed)} frame sets)",
            "it has another camera's calibration, or stands elsewhere than when it was calibrated: "
            "calibrate it",
            Level.WRONG,
        )
        for name, k in sorted(counts.items())
        if k > len(posed) / 2
    ]


def expected_accuracy(
    middle: RigidTransform, reach_mm: float, body: Body, cameras: Sequence[Camera], noise_px: float
) -> Floats:
    """Standard deviations (27, 5) to expect of the pose around a place, with every ball in sight.

    Columns are x, y, z in mm, and the deviations of the position in mm and of the rotation in deg;
    NaN where too few cameras see the body. The world's scale is not in them.

    Args:
        middle: a pose in the middle of the workspace.
        reach_mm: half the side of the cube.
        noise_px: standard deviation of a ball's centre in a picture.
    """
    rows = []
    for offset in np.stack(np.meshgrid(_GRID, _GRID, _GRID), axis=-1).reshape(-1, 3):
        pose = RigidTransform(middle.rotation, middle.translation + reach_mm * offset)
        by_noise = noise_sd(pose, body, cameras, noise_px)
        position, rotation = np.hypot(by_noise, tolerance_sd(body, pose))
        rows.append([*pose.translation, position, rotation])
    return np.array(rows)


def _seen(samples: Sequence[SearchSample], body: Body, camera: Camera, ball: int) -> Coverage:
    name = body.names[ball]
    seen = expected = 0
    for sample in samples:
        assert sample.world_from_body is not None
        pixel = camera.project(sample.world_from_body.apply(body.centers[ball : ball + 1]))
        expected += int(camera.intrinsics.contains(pixel)[0])
        seen += any(d.camera == camera.name and d.ball == name for d in sample.agreeing)
    return Coverage(camera.name, name, seen, max(expected, seen))


def _widest_angle(samples: Sequence[SearchSample], cameras: Sequence[Camera]) -> float:
    """Largest angle, in deg, between two cameras' lines of sight to the body."""
    places = [s.world_from_body.translation for s in samples if s.world_from_body is not None]
    away = np.stack([camera.center for camera in cameras]) - np.mean(places, axis=0)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    # The sine is 0 for opposite directions too, which are as weak as equal ones.
    sines = np.linalg.norm(np.cross(away[:, None], away[None]), axis=2)
    return float(np.degrees(np.arcsin(np.clip(np.max(sines), 0, 1))))
