"""Coverage: how often cameras saw the balls, and the accuracy to expect there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.checking.body import Compared
from measure.checking.causes import Cause, Word
from measure.checking.finding import Finding, Level
from measure.checking.search import SearchSample
from measure.estimation.expected_accuracy import noise_sd, tolerance_sd
from measure.geometry import RigidTransform
from measure.model import Body, Camera, Doubt
from measure.model.doubts import counted

_MIN_SEEN_SHARE = 0.5
_MAX_CHANCE_SHARE = 0.1  # Of frame sets with a pose, a second body or a reflection by chance
_MIN_ANGLE_DEG = 20.0
_GRID = (-1.0, 0.0, 1.0)
HIDDEN_SHARE = 0.15  # Of views, from which on another ball in front is worth knowing
_BEHIND = 2.0  # Error of a centre behind another ball over that of others: 1.4 to 2.9 in renders
_ARMS = 1.25, 1.5, 1.75, 2.0, 2.5, 3.0  # Times as long


@dataclass(frozen=True)
class Coverage:
    """How often one camera saw one ball, and how often the ball lay in its image."""

    camera: str
    ball: str
    seen: int
    expected: int
    hidden: int = 0  # where it lay there, but another ball of the body was before its centre


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
        common, *_ = counted([s.reason] for s in samples if s.world_from_body is None)
        fits = any(d.agrees and d.frames > len(samples) / 2 for d in distances)
        by_chance = len(with_pose) <= _MAX_CHANCE_SHARE * len(samples) and not fits
        looked = len(samples)
        if by_chance:
            text = Doubt("found-by-chance", lost=lost, looked=looked, reason=common)
        else:
            text = Doubt("found-seldom", lost=lost, looked=looked, reason=common)
        findings.append(Finding(Level.WRONG if by_chance else Level.WEAK, "balls", text))
    disagreeing = {cause.of for cause in disagreeing_causes(samples)}
    flagged = [s.flags[0] for s in samples if s.flags]  # a second body may be in view
    reflected = [s.reflection.note for s in samples if s.reflection is not None]
    mostly = true_colors and len(flagged) > len(samples) / 2
    level = Level.WRONG if mostly else Level.WEAK
    for found, bad in ((flagged, level), (reflected, Level.NOTE)):
        if len(found) > _MAX_CHANCE_SHARE * len(samples):
            many = f"{found[0]} (so in {len(found)} of {len(samples)} frame sets looked at)"
            findings.append(Finding(bad, "balls", many, code=Doubt.of(found[0]).code))
    for row in table:
        if row.camera not in disagreeing and row.seen < _MIN_SEEN_SHARE * row.expected:
            why = "hidden, or its colour does not match"
            if row.hidden > (row.expected - row.seen) / 2:
                why = f"another ball of the body is in front of it in {row.hidden}"
            camera, ball, seen = row.camera, row.ball, row.seen
            text = Doubt(
                "ball-unseen", camera=camera, ball=ball, seen=seen, expected=row.expected, why=why
            )
            findings.append(Finding(Level.NOTE, "coverage", text))
    findings += _hiding(with_pose, body, cameras)
    if with_pose and (angle := _widest_angle(with_pose, cameras)) < _MIN_ANGLE_DEG:
        findings.append(Finding(Level.WEAK, "coverage", Doubt("cameras-in-line", angle_deg=angle)))
    return table, findings


class Arms(NamedTuple):
    """A body whose balls are `times` as far from their middle, and what that changes."""

    body: Body
    times: float
    hidden: float  # share of views partly behind another ball
    noise: Floats  # (2,) of position and of rotation, per that of now

    def __str__(self) -> str:
        return (
            f"with arms {self.times:g} times as long it would be {self.hidden:.0%}, and the "
            f"position {self.noise[0]:.2f} and the rotation {self.noise[1]:.2f} times as noisy "
            "(by geometry)"
        )


def hidden_share(poses: Sequence[RigidTransform], body: Body, cameras: Sequence[Camera]) -> float:
    """Share of views of a ball in which another one of the body hides a part of it."""
    views = [c.hides(p.apply(body.centers), body.radii, 1.0) for p in poses for c in cameras]
    return float(np.mean(np.any(views, axis=2)))


def longer_arms(
    poses: Sequence[RigidTransform], body: Body, cameras: Sequence[Camera]
) -> Arms | None:
    """The shortest arms with which balls hide each other in few views; None if there are none.

    Balls move away from the body's origin where that is among them, else from their middle.

    Args:
        poses: world_from_body.
    """

    def noise(one: Body) -> Floats:
        each = [noise_sd(pose, one, cameras, 1.0, _BEHIND) for pose in poses]
        return np.asarray(np.median(each, axis=0))

    reach = np.linalg.norm(body.centers - body.middle, axis=1).max()
    pivot = np.zeros(3) if np.linalg.norm(body.middle) < reach else body.middle
    for times in _ARMS:
        one = body.with_centers(np.round(pivot + times * (body.centers - pivot), 1))
        if (hidden := hidden_share(poses, one, cameras)) < HIDDEN_SHARE:
            ratio = noise(one) / noise(body)
            return Arms(one, times, hidden, ratio) if np.isfinite(ratio).all() else None
    return None


def _hiding(
    samples: Sequence[SearchSample], body: Body, cameras: Sequence[Camera]
) -> Iterator[Finding]:
    """What longer arms would give where balls of the body are often behind others."""
    poses = [s.world_from_body for s in samples if s.world_from_body is not None]
    if not poses or (now := hidden_share(poses, body, cameras)) <= HIDDEN_SHARE:
        return
    longer = longer_arms(poses, body, cameras)
    cure = f": {longer}; `measure target BODY --run RUN` draws it" if longer else ""
    yield Finding(Level.NOTE, "body", Doubt("balls-hidden", share=now, cure=cure))


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
    seen = expected = hidden = 0
    for sample in samples:
        assert sample.world_from_body is not None
        centers = sample.world_from_body.apply(body.centers)
        lies = bool(camera.intrinsics.contains(camera.project(centers[ball : ball + 1]))[0])
        expected += lies
        seen += any(d.camera == camera.name and d.ball == name for d in sample.agreeing)
        hidden += lies and bool(camera.hides(centers, body.radii)[ball].any())
    return Coverage(camera.name, name, seen, max(expected, seen), hidden)


def _widest_angle(samples: Sequence[SearchSample], cameras: Sequence[Camera]) -> float:
    """Largest angle, in deg, between two cameras' lines of sight to the body."""
    places = [s.world_from_body.translation for s in samples if s.world_from_body is not None]
    away = np.stack([camera.center for camera in cameras]) - np.mean(places, axis=0)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    # The sine is 0 for opposite directions too, which are as weak as equal ones.
    sines = np.linalg.norm(np.cross(away[:, None], away[None]), axis=2)
    return float(np.degrees(np.arcsin(np.clip(np.max(sines), 0, 1))))
