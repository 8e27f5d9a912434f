"""The paper's frame-update algorithm: states of circles, and where they are expected next.

A ball in a camera has one of two states, effective or suspended; transitions are pure functions.
Peng, Yang, Su, Hannaford (ICRA 2020), section II.D "Frame Update Algorithm".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from measure.arrays import Floats
from measure.host import Conclusion, Settings, Tracker, hookimpl, setting
from measure.limits import MAX_PAUSE_S
from measure.model import (
    Ball,
    BallPosition,
    BallView,
    Body,
    Camera,
    Detection,
    Doubt,
    Expectation,
    FrameSet,
    Motion,
    Pose,
)
from measure.model.observations import Reason, State
from measure_paper import ray_agreement
from measure_paper.ray_agreement import choose

_RADIUS_MEMORY = 0.5
"""Weight of the earlier radius in the running mean: one noisy radius must not shift the bounds."""


@dataclass(frozen=True, eq=False)
class Circle:
    """The state of one ball in one camera."""

    state: State = State.EFFECTIVE
    reason: Reason = Reason.NONE  # why it is suspended; `Reason.NONE` if it is not
    good_frames: int = 0  # for how many frames in a row a suspended circle has been good
    center_px: Floats | None = None  # (2,) where it was last accepted, None before the first time
    radius_px: float | None = None  # its radius then, smoothed
    time_s: float | None = None  # when that was

    @property
    def effective(self) -> bool:
        """Whether it may be used."""
        return self.state is State.EFFECTIVE


@dataclass(frozen=True)
class CircleEvidence:
    """The checks of one circle in one frame."""

    found: bool  # Hough returned a circle, at the latest with the largest tolerable sigma
    color_ok: bool = True
    # its centre moved more than the motion threshold since the last frame.
    moved_too_far: bool = False
    # whether it agrees with the 3-D centre from effective circles; None if fewer than two others
    # are effective, so that there is no such centre.
    consistent: bool | None = None


def advance(circle: Circle, evidence: CircleEvidence, good_frames_needed: int) -> Circle:
    """The circle's state after one more frame.

    An effective circle is suspended by any of the paper's three causes, or because it disagrees
    with the other cameras' circles (not in the paper: else a steady false circle would stay
    effective for ever). A suspended one becomes effective after *more* than `good_frames_needed`
    good frames in a row: found, of the right colour, and consistent with the effective circles in
    3-D.
    """
    reason = _suspension_reason(circle, evidence)
    if reason is not Reason.NONE:
        return replace(circle, state=State.SUSPENDED, reason=reason, good_frames=0)
    if circle.effective:
        return circle
    # A frame in which the circle cannot be checked interrupts the run of good frames.
    good_frames = circle.good_frames + 1 if evidence.consistent else 0
    if good_frames > good_frames_needed:
        return replace(circle, state=State.EFFECTIVE, reason=Reason.NONE, good_frames=0)
    return replace(circle, reason=Reason.RECOVERING, good_frames=good_frames)


def _suspension_reason(circle: Circle, evidence: CircleEvidence) -> Reason:
    if not evidence.found:
        return Reason.NOT_FOUND
    if not evidence.color_ok:
        return Reason.COLOR
    if circle.effective and evidence.moved_too_far:
        return Reason.JUMPED
    if evidence.consistent is False:
        return Reason.INCONSISTENT
    return Reason.NONE


def remember(circle: Circle, detection: Detection) -> Circle:
    """The circle with the detection's centre, time and averaged radius."""
    radius = detection.radius_px
    if circle.radius_px is not None:
        radius = _RADIUS_MEMORY * circle.radius_px + (1 - _RADIUS_MEMORY) * radius
    return replace(circle, center_px=detection.center_px, radius_px=radius, time_s=detection.time_s)


class FrameUpdateSettings(Settings):
    """How far a circle may move and vary, and when the system restarts."""

    motion_mm_s: float = setting(
        100.0, "Motion threshold: largest speed of a ball across the view.", unit="mm/s", gt=0
    )
    motion_base_px: float = setting(
        4.0, "Motion threshold: largest shift of a resting circle between frames.", unit="px", gt=0
    )
    color_percent: float = setting(
        25.0, "Colour match below which a circle is suspended.", unit="%", ge=0, le=100
    )
    good_frames: int = setting(
        5, "A suspended circle recovers after more good frames in a row than this.", ge=0
    )
    consistency_mm: float = setting(
        3.0, "Largest distance of a ray from the 3-D centre of its ball.", unit="mm", gt=0
    )
    radius_percent: float = setting(
        10.0, "Range of r_min and r_max about the radius of earlier frames.", unit="%", gt=0, lt=90
    )
    min_distance_radii: float = setting(
        1.0, "Least distance d_min of two circles of one colour, in radii.", gt=0
    )
    skip_frames: int = setting(
        3, "Frame sets skipped before a restart when too few circles are effective.", ge=0
    )
    tolerance_step: float = setting(1.5, "Factor on all tolerable ranges at each restart.", ge=1)
    tolerance_max: float = setting(3.0, "Largest factor on the tolerable ranges.", ge=1)
    tolerance_decay: float = setting(
        0.5, "Share of the raised tolerance that is left after a good frame.", ge=0, lt=1
    )
    search_tolerance: float = setting(
        2.0, "Tolerance from which a restart searches whole frames.", ge=1
    )
    flag_residual_mm: float = setting(
        1.0, "RMS misfit of the balls to the body from which a pose is flagged.", unit="mm", gt=0
    )
    flag_rays_mm: float = setting(
        1.0,
        "RMS distance of the rays from their balls from which a pose is flagged.",
        unit="mm",
        gt=0,
    )
    max_residual_mm: float = setting(
        3.0, "RMS misfit of the balls to the body from which a pose is refused.", unit="mm", gt=0
    )


class FrameUpdate(Tracker):
    """Remembers each circle's state, place and radius, and the last pose."""

    name = "frame-update"
    Config: ClassVar[type[Settings]] = FrameUpdateSettings
    config: FrameUpdateSettings

    def __init__(self, config: FrameUpdateSettings, body: Body, cameras: Sequence[Camera]) -> None:
        super().__init__(config, body, cameras)
        self._cameras = {camera.name: camera for camera in cameras}
        self._pose: Pose | None = None
        self._tolerance = 1.0
        self._skip = 0
        self._starting = True
        self._circles: dict[tuple[str, str], Circle] = {}
        self._forget_circles()

    def use_cameras(self, cameras: Sequence[Camera]) -> None:
        """From now on the cameras stand elsewhere."""
        super().use_cameras(cameras)
        self._cameras = {camera.name: camera for camera in cameras}

    @property
    def tolerance(self) -> float:
        """The factor on all tolerable ranges: 1 in normal tracking, more after a restart."""
        return self._tolerance

    def expect(self, frame_set: FrameSet) -> Mapping[str, Sequence[Expectation]] | None:
        """Windows around the last circles or the last pose; None while frames are skipped."""
        if self._skip > 0:
            self._skip -= 1
            return None
        return {
            name: [
                expectation
                for ball in self.body.balls
                if (expectation := self._expect(ball, self._cameras[name], image.time_s))
            ]
            for name, image in frame_set.images.items()
        }

    def judge(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> tuple[BallView, ...]:
        """Advance every circle's state by this frame."""
        if self._starting:
            return tuple(self._start(frame_set, detections))
        tracked = (self._track(ball, frame_set, detections) for ball in self.body.balls)
        return tuple(view for views in tracked for view in views)

    def motion(self, time_s: float) -> Motion | None:
        """The last pose, at rest."""
        if self._pose is None:
            return None
        return Motion.at_rest(self._pose.world_from_body, self._pose.time_s)

    def conclude(
        self,
        frame_set: FrameSet,
        views: Sequence[BallView],
        positions: Sequence[BallPosition],
        pose: Pose | None,
        residuals_px: Mapping[tuple[str, str], Floats],
    ) -> Conclusion:
        """Keep the pose and let the tolerance converge, or plan a restart with a raised one."""
        problem = self._problem(views, positions, pose)
        if problem or pose is None:
            self._plan_restart()
            return Conclusion(None, problem or Doubt("no-solution"))
        self._pose = pose
        self._starting = False
        self._tolerance = 1 + (self._tolerance - 1) * self.config.tolerance_decay
        against = ray_agreement.residual_flags(
            positions, pose, self.config.flag_residual_mm, self.config.flag_rays_mm
        )
        return Conclusion(replace(pose, flags=(*pose.flags, *against)))

    def _problem(
        self, views: Sequence[BallView], positions: Sequence[BallPosition], pose: Pose | None
    ) -> str:
        if pose is not None and pose.residual_mm > self.config.max_residual_mm:
            return Doubt("refused", off_mm=pose.residual_mm)
        if pose is not None or len(positions) >= 3:
            return ""
        counts = {
            name: sum(view.ball == name and view.effective for view in views)
            for name in self.body.names
        }
        if short := [name for name, count in counts.items() if count < 2]:
            return Doubt("few-circles", balls=short)
        return Doubt("few-located", balls=len(positions))

    def _plan_restart(self) -> None:
        config = self.config
        self._skip = config.skip_frames
        self._tolerance = min(self._tolerance * config.tolerance_step, config.tolerance_max)
        self._starting = True
        self._forget_circles()

    def _forget_circles(self) -> None:
        """Every circle is initialised as effective."""
        self._circles = {
            (ball, camera): Circle() for ball in self.body.names for camera in self._cameras
        }

    def _expect(self, ball: Ball, camera: Camera, time_s: float) -> Expectation | None:
        circle = self._circles[ball.name, camera.name]
        point = self._predicted(ball)
        if circle.effective and circle.center_px is not None and circle.radius_px is not None:
            center, radius = circle.center_px, circle.radius_px
        elif point is not None and self._tolerance < self.config.search_tolerance:
            center = camera.project(point[None])[0]
            radius = ray_agreement.apparent_radius_px(camera, point, ball.radius_mm)
            if not np.all(np.isfinite(center)):
                return None
        else:
            return None
        spread = min(self.config.radius_percent / 100 * self._tolerance, 0.9)
        return Expectation(
            ball=ball.name,
            center_px=center,
            radius_px=(radius * (1 - spread), radius * (1 + spread)),
            min_distance_px=self.config.min_distance_radii * radius / self._tolerance,
            reach_px=self._motion_px(ball, radius, self._seen_at(circle), time_s),
            tolerance=self._tolerance,
        )

    def _predicted(self, ball: Ball) -> Floats | None:
        return None if self._pose is None else self._pose.world_from_body.apply(ball.center_mm)

    def _seen_at(self, circle: Circle) -> float | None:
        if circle.effective and circle.time_s is not None:
            return circle.time_s
        return None if self._pose is None else self._pose.time_s

    def _motion_px(
        self, ball: Ball, radius_px: float, since_s: float | None, time_s: float
    ) -> float:
        """The motion threshold between two detections of a ball."""
        step_s = 0.0 if since_s is None else min(abs(time_s - since_s), MAX_PAUSE_S)
        moved_mm = self.config.motion_mm_s * step_s
        return self._tolerance * (
            self.config.motion_base_px + moved_mm * radius_px / ball.radius_mm
        )

    def _limits(self) -> ray_agreement.AgreementLimits:
        return ray_agreement.AgreementLimits(
            self.config.consistency_mm, self.config.radius_percent / 100
        )

    def _good(self, detection: Detection) -> bool:
        miscolored = 100 * detection.color_match < self.config.color_percent
        return detection.score > 0 and not miscolored

    def _start(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> list[BallView]:
        """All circles that can be the body's balls are effective."""
        candidates = [
            detection
            for name in frame_set.images
            for detection in detections.get(name, ())
            if self._good(detection)
        ]
        seen = ray_agreement.ray_observations(candidates, self._cameras)
        chosen = choose(self.body, seen, self._limits(), 2 * self.config.consistency_mm)
        views = []
        for ball, camera in self._circles:
            members = chosen[ball].members if ball in chosen else {}
            mine = [d for d in detections.get(camera, ()) if d.ball == ball]
            detection = members.get(camera) or (mine[0] if mine else None)
            circle = Circle()
            if camera not in members:
                evidence = CircleEvidence(
                    found=detection is not None,
                    color_ok=detection is None or self._good(detection),
                    consistent=False,
                )
                circle = advance(circle, evidence, self.config.good_frames)
            elif detection is not None:
                circle = remember(circle, detection)
            self._circles[ball, camera] = circle
            views.append(_view(ball, camera, circle, detection, frame_set))
        return views

    def _track(
        self, ball: Ball, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> list[BallView]:
        found = {
            name: next((d for d in detections.get(name, ()) if d.ball == ball.name), None)
            for name in self._cameras
        }
        evidence = {
            name: self._evidence(ball, name, detection) for name, detection in found.items()
        }
        evidence = self._with_consistency(ball, found, evidence)
        views = []
        for name, detection in found.items():
            circle = self._circles[ball.name, name]
            if name in frame_set.images:
                circle = advance(circle, evidence[name], self.config.good_frames)
                if detection is not None and circle.reason in (Reason.NONE, Reason.RECOVERING):
                    circle = remember(circle, detection)
                self._circles[ball.name, name] = circle
            views.append(_view(ball.name, name, circle, detection, frame_set))
        return views

    def _evidence(self, ball: Ball, camera: str, detection: Detection | None) -> CircleEvidence:
        if detection is None:
            return CircleEvidence(found=False)
        circle = self._circles[ball.name, camera]
        moved = 0.0
        if circle.center_px is not None:
            moved = float(np.linalg.norm(detection.center_px - circle.center_px))
        allowed = self._motion_px(ball, detection.radius_px, circle.time_s, detection.time_s)
        return CircleEvidence(
            found=True, color_ok=self._good(detection), moved_too_far=moved > allowed
        )

    def _with_consistency(
        self,
        ball: Ball,
        found: Mapping[str, Detection | None],
        evidence: Mapping[str, CircleEvidence],
    ) -> dict[str, CircleEvidence]:
        """Fill in whether each circle agrees with the 3-D centre from effective circles."""
        good = [d for name, d in found.items() if d is not None and evidence[name].color_ok]
        seen = ray_agreement.ray_observations(good, self._cameras)
        effective = [
            one
            for one in seen
            if self._circles[ball.name, one.camera.name].effective
            and not evidence[one.camera.name].moved_too_far
        ]
        outliers = ray_agreement.disagreeing(effective, ball.radius_mm, self._limits())
        kept = [one for one in effective if one not in outliers]
        point = ray_agreement.locate(kept)
        if point is None and len(self.body.balls) > 3:
            point = self._predicted(ball)
        out = dict(evidence)
        for one in seen:
            name = one.camera.name
            if one in outliers:
                out[name] = replace(evidence[name], consistent=False)
            elif point is not None and one not in kept:
                fits = ray_agreement.misfit(one, point, ball.radius_mm, self._limits()) <= 1
                out[name] = replace(evidence[name], consistent=fits)
        return out


@hookimpl
def measure_trackers() -> list[type[Tracker]]:
    """Register the tracker."""
    return [FrameUpdate]


def _view(
    ball: str, camera: str, circle: Circle, detection: Detection | None, frame_set: FrameSet
) -> BallView:
    if camera not in frame_set.images:
        return BallView(ball, camera, State.SUSPENDED, Reason.NO_IMAGE)
    return BallView(ball, camera, circle.state, circle.reason, detection)
