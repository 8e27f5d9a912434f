"""How much of the recording the cameras saw, and how well they could measure there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.checking.finding import Finding, Level
from measure.checking.moved_cameras import Misfit
from measure.checking.sampled_search import Surveyed
from measure.estimation.expected_accuracy import noise_sd, tolerance_sd
from measure.geometry import RigidTransform
from measure.model import Body, Camera

_SELDOM = 0.5
_BY_CHANCE = 0.1
_NEAR_PARALLEL_DEG = 20.0
_GRID = (-1.0, 0.0, 1.0)


@dataclass(frozen=True)
class Coverage:
    """How often one camera saw one ball, of the times it lay in its picture."""

    camera: str
    ball: str
    seen: int
    expected: int


def coverage_findings(
    surveys: Sequence[Surveyed],
    body: Body,
    cameras: Sequence[Camera],
    misfits: Collection[Misfit] = (),
) -> tuple[tuple[Coverage, ...], list[Finding]]:
    """Who saw what, and what is weak about it.

    Args:
        surveys: of the frame sets looked at.
        body: the body.
        cameras: all of them.
        misfits: cameras measured to be off. Others then disagree with them, and are not to blame.
    """
    with_pose = [s for s in surveys if s.world_from_body is not None]
    table = tuple(_seen(with_pose, body, c, k) for c in cameras for k in range(len(body.balls)))
    findings: list[Finding] = []
    lost = len(surveys) - len(with_pose)
    if lost:
        reasons = [s.reason for s in surveys if s.world_from_body is None]
        common = max(set(reasons), key=reasons.count)
        level = Level.WRONG if lost > len(surveys) / 2 else Level.WEAK
        text = f"no pose in {lost} of {len(surveys)} frame sets looked at, mostly: {common}"
        findings.append(Finding(level, "balls", text))
    strange, told = _strangers([] if misfits else with_pose)
    findings += told + _doubts(surveys)
    for row in table:
        if row.camera not in strange and row.seen < _SELDOM * row.expected:
            text = (
                f"{row.camera} sees ball {row.ball} in {row.seen} of {row.expected} frame sets "
                "in which it lies in its picture: hidden, or its colour does not match"
            )
            findings.append(Finding(Level.NOTE, "coverage", text))
    if with_pose and (angle := _widest_angle(with_pose, cameras)) < _NEAR_PARALLEL_DEG:
        text = (
            f"all cameras look along nearly the same line ({angle:.0f} deg apart at most): "
            "distances will be poor; spread them out"
        )
        findings.append(Finding(Level.WEAK, "coverage", text))
    return table, findings


def _strangers(surveys: Sequence[Surveyed]) -> tuple[set[str], list[Finding]]:
    """Cameras that see balls elsewhere than the others more often than not, and a line for each."""
    counts = Counter(name for survey in surveys for name in survey.strangers)
    often = {name: k for name, k in sorted(counts.items()) if k > len(surveys) / 2}
    return set(often), [
        Finding(
            Level.WRONG,
            "calibration",
            f"{name} sees balls, but none where the others do (in {k} of {len(surveys)} frame "
            "sets): it has another camera's calibration, or stands elsewhere than when it was "
            "calibrated",
        )
        for name, k in often.items()
    ]


def _doubts(surveys: Sequence[Surveyed]) -> list[Finding]:
    """One line if a second body may be in view in more frame sets than by chance."""
    doubted = [s.doubts[0] for s in surveys if s.doubts]
    if len(doubted) <= _BY_CHANCE * len(surveys):
        return []
    text = f"{doubted[0]} (so in {len(doubted)} of {len(surveys)} frame sets looked at)"
    return [Finding(Level.WRONG, "balls", text)]


def expected_accuracy(
    middle: RigidTransform,
    reach_mm: float,
    body: Body,
    cameras: Sequence[Camera],
    noise_px: float,
) -> Floats:
    """How well the pose could be known round a place, with every ball in sight.

    Args:
        middle: a pose in the middle of the workspace.
        reach_mm: half the side of the cube to look at.
        body: the body.
        cameras: the cameras.
        noise_px: standard deviation of a ball's centre in a picture.

    Returns:
        (27, 5): x, y, z in mm, standard deviation of the position in mm and of the rotation in
        deg; NaN where too few cameras see the body.
    """
    rows = []
    for offset in np.stack(np.meshgrid(_GRID, _GRID, _GRID), axis=-1).reshape(-1, 3):
        pose = RigidTransform(middle.rotation, middle.translation + reach_mm * offset)
        by_noise = noise_sd(pose, body, cameras, noise_px)
        rows.append([*pose.translation, *np.hypot(by_noise, tolerance_sd(body, pose))])
    return np.array(rows)


def _seen(surveys: Sequence[Surveyed], body: Body, camera: Camera, ball: int) -> Coverage:
    name = body.names[ball]
    seen = expected = 0
    for survey in surveys:
        assert survey.world_from_body is not None
        pixel = camera.project(survey.world_from_body.apply(body.centers[ball : ball + 1]))
        expected += int(camera.intrinsics.contains(pixel)[0])
        seen += any(d.camera == camera.name and d.ball == name for d in survey.agreeing)
    return Coverage(camera.name, name, seen, max(expected, seen))


def _widest_angle(surveys: Sequence[Surveyed], cameras: Sequence[Camera]) -> float:
    """Largest angle, in deg, between two cameras' lines of sight to the body."""
    places = [s.world_from_body.translation for s in surveys if s.world_from_body is not None]
    away = np.stack([camera.center for camera in cameras]) - np.mean(places, axis=0)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    # Opposite directions are as parallel as equal ones.
    sines = np.linalg.norm(np.cross(away[:, None], away[None]), axis=2)
    return float(np.degrees(np.arcsin(np.clip(np.max(sines), 0, 1))))
