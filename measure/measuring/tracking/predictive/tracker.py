"""Tracking in space: a predicted pose says where to look and what to believe.

The states are the paper's (section II.D): a ball is effective in a camera or suspended, with the
reason. Gates come from covariances. Without a prediction the whole frame is searched, and geometry
tells the body from whatever else has its colours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np

from measure.arrays import Floats
from measure.geometry import chi_square_quantile
from measure.host.settings import Settings, setting
from measure.measuring import association
from measure.measuring.association import Association, AssociationSettings, associate
from measure.measuring.tracking.predictive.camera_bias import CamerasAside
from measure.measuring.tracking.predictive.consistency import inconsistencies, unbacked
from measure.measuring.tracking.predictive.gating import (
    AGREES,
    CONTRADICTS,
    JUMPED,
    MISCOLORED,
    judge_sightings,
)
from measure.measuring.tracking.predictive.motion_filter import MotionState, just_found, per_axis
from measure.measuring.tracking.predictive.pose_checks import (
    contradictions,
    hasty,
    jumped,
    lost_sight,
    said_of_strangers,
    strangers,
    unconfirmed,
    weaknesses,
)
from measure.measuring.tracking.predictive.search_windows import Windows, predict_windows
from measure.measuring.tracking.predictive.warm_up import warm_up
from measure.measuring.tracking.tracker import Verdict
from measure.model import (
    BallPosition,
    BallView,
    Body,
    Camera,
    Detection,
    Expectation,
    FrameSet,
    Motion,
    Pose,
)
from measure.model.observations import Reason, State

_LEFT_OUT = np.repeat([0.02, 0.0005], 3)
"""In mm and rad: errors of a pose that its covariance does not tell, for the filter."""
_REASONS = {
    AGREES: Reason.NONE,
    JUMPED: Reason.JUMPED,
    MISCOLORED: Reason.COLOR,
    CONTRADICTS: Reason.INCONSISTENT,
}
_SUSPICIOUS = (Reason.JUMPED, Reason.COLOR, Reason.INCONSISTENT)


class PredictiveConfig(Settings):
    """Settings of tracking in SE(3)."""

    renamed: ClassVar[Mapping[str, str]] = {
        "turning_rad_s2": "angular_acceleration_rad_s2",
        "turning_rad_s": "angular_speed_rad_s",
        "model_px": "systematic_px",
        "own_px": "view_bias_px",
        "reach_floor_px": "min_reach_px",
        "size_slack": "radius_slack",
    }

    acceleration_mm_s2: float = setting(
        1500.0, "Standard deviation of the body's acceleration.", unit="mm/s^2", gt=0
    )
    angular_acceleration_rad_s2: float = setting(
        15.0, "Standard deviation of its angular acceleration.", unit="rad/s^2", gt=0
    )
    speed_mm_s: float = setting(
        60.0, "Standard deviation of the speed of a body just found.", unit="mm/s", gt=0
    )
    angular_speed_rad_s: float = setting(
        0.7, "Standard deviation of its angular speed.", unit="rad/s", gt=0
    )
    confidence: float = setting(
        0.9999, "Detections less likely than the rest are not believed.", gt=0.5, lt=1
    )
    systematic_px: float = setting(
        0.5,
        "Systematic error of a detection, added to its standard deviation in every gate.",
        unit="px",
        ge=0,
    )
    view_bias_px: float = setting(
        0.3,
        "Standard deviation of a ball-view's own bias besides its noise, where all ball-views "
        "together are tested against the pose.",
        unit="px",
        ge=0,
    )
    reach_sigmas: float = setting(3.5, "Standard deviations of the prediction to search.", gt=0)
    min_reach_px: float = setting(3.0, "Least reach of a search.", unit="px", gt=0)
    radius_slack: float = setting(0.15, "Relative error of an outline's radius.", gt=0, lt=1)
    recover_frames: int = setting(
        1, "Frames a detection must be good again after it was not believed.", ge=0
    )
    lost_after: int = setting(3, "Frames without a believed pose before all is searched.", ge=1)
    max_gap_s: float = setting(0.5, "A longer pause than this ends the prediction.", unit="s", gt=0)
    min_color_match: float = setting(
        0.15, "Least share of a ball's inside that has its colour, where that is checked.", ge=0
    )
    max_rms_px: float = setting(
        2.5, "A pose with larger reprojection errors is flagged.", unit="px", gt=0
    )
    max_sd_mm: float = setting(
        2.0, "A pose with a larger standard deviation is flagged.", unit="mm", gt=0
    )
    distance_tolerance_mm: float = setting(
        1.0, "Error of a distance between two balls that is not worth a flag.", unit="mm", ge=0
    )


class PredictiveTracker:
    """Predicts, gates, judges, and starts again when lost."""

    Config: ClassVar[type[Settings]] = PredictiveConfig

    def __init__(self, config: PredictiveConfig, body: Body, cameras: Sequence[Camera]) -> None:
        self.config = config
        self._body = body
        self._cameras = tuple(cameras)
        self._keys = [(camera.name, ball) for camera in cameras for ball in body.names]
        self._acceleration = per_axis(config.acceleration_mm_s2, config.angular_acceleration_rad_s2)
        self._speed = per_axis(config.speed_mm_s, config.angular_speed_rad_s)
        self._possible = self._acceleration
        self._aside = CamerasAside(body, cameras, config.view_bias_px, config.confidence)
        self._state: MotionState | None = None
        self._windows: Windows | None = None
        self._found: Association | None = None
        self._strangers: tuple[str, ...] = ()
        self._confirmed: set[str] = set()
        self._doubts: tuple[str, ...] = ()
        self._refound: tuple[MotionState | None, MotionState] | None = None
        self._last_seen: MotionState | None = None
        self._waiting: dict[tuple[str, str], int] = {}
        self._misses = 0
        self._faster: tuple[Floats, Floats] | None = None

    def warm_up(self) -> None:
        """Compile or load the loops of searching and of tracking."""
        association.warm_up(self._body, self._cameras)
        warm_up(self._body, self._cameras)

    def expect(self, frame_set: FrameSet) -> Mapping[str, Sequence[Expectation]]:
        """Windows from the predicted pose at each image's own time; the whole frame without one."""
        self._windows = self._found = self._faster = None
        if self._state is not None and frame_set.images:
            latest = max(image.time_s for image in frame_set.images.values())
            if abs(latest - self._state.time_s) > self.config.max_gap_s:
                self._forget()
        if self._state is None or not frame_set.images:
            return dict.fromkeys(frame_set.images, ())
        times_s = {name: image.time_s for name, image in frame_set.images.items()}
        self._possible = self._state.possible(self._acceleration)
        self._windows = predict_windows(
            self._state, times_s, self._possible, self._body, self._cameras
        )
        c = self.config
        return self._windows.expectations(c.reach_sigmas, c.min_reach_px, c.radius_slack)

    def backwards(self) -> PredictiveTracker | None:
        """A tracker of the same motion; None where the body is lost."""
        if self._state is None:
            return None
        back = PredictiveTracker(self.config, self._body, self._cameras)
        back._state, back._confirmed = self._state, set(self._confirmed)
        return back

    def judge(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> tuple[BallView, ...]:
        """Association across cameras while searching; gates while tracking."""
        if self._windows is None:
            return self._search(frame_set, detections)
        return self._track(frame_set, self._windows, detections)

    def motion(self, time_s: float) -> Motion | None:
        """The predicted motion at `time_s`; right after a search, the pose found, at rest.

        Its velocity takes in what pictures of different times say, so that a body that speeds up
        is not seen where it was going to be.
        """
        if self._state is None:
            return None
        return self._state.at(time_s, self._possible).motion(self._faster)

    def conclude(
        self,
        frame_set: FrameSet,
        views: Sequence[BallView],
        positions: Sequence[BallPosition],
        pose: Pose | None,
        residuals_px: Mapping[tuple[str, str], Floats],
    ) -> Verdict:
        """Flag what contradicts itself, learn from the rest."""
        if pose is None:
            reason = self._found.reason if self._found is not None else ""
            self._missed()
            return Verdict(None, reason or "too few balls agree with the prediction")
        c = self.config
        wrong = contradictions(
            pose, positions, views, self._body, self._cameras, c.distance_tolerance_mm, c.max_rms_px
        )
        weak = weaknesses(pose, views, c.max_sd_mm) + self._still_strange(views) + self._doubts
        weak += self._jumped() + unconfirmed(views, self._body, self._confirmed)
        if self._state is not None and self._state.new:
            weak += hasty(views, [image.time_s for image in frame_set.images.values()])
        weak += inconsistencies(pose, views, positions, self._body, c.view_bias_px, c.confidence)
        motion = partial(self.motion, pose.time_s)
        weak += self._aside.doubts(pose, views, residuals_px, motion)
        weak += unbacked(pose, views, self._body, self._cameras)
        flags = tuple(dict.fromkeys((*pose.flags, *wrong, *weak)))
        if wrong:
            self._missed()
        elif lost_sight(pose, self._body):
            self._forget()
        elif self._state is not None:
            self._misses = 0
            self._state = self._state.updated(pose, _LEFT_OUT, self._acceleration)
            self._last_seen, self._faster = self._state, None
        return Verdict(pose if flags == pose.flags else replace(pose, flags=flags))

    def _search(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> tuple[BallView, ...]:
        present = [camera for camera in self._cameras if camera.name in frame_set.images]
        self._found = found = associate(self._body, present, detections, AssociationSettings())
        self._waiting = {}
        if found.world_from_body is not None:
            assert found.covariance is not None
            time_s = float(np.mean([d.time_s for d in found.detections]))
            here = found.world_from_body, found.covariance, time_s
            self._state = just_found(*here, self._speed, self._acceleration, self._last_seen)
            self._refound = self._last_seen, self._state
            self._strangers = strangers(found, self._body, present, detections)
            self._confirmed = set()
            self._doubts = found.doubts
        chosen = {(d.camera, d.ball): d for d in found.detections}
        return tuple(
            self._searched(frame_set, camera.name, ball, chosen, detections)
            for camera in self._cameras
            for ball in self._body.names
        )

    def _searched(
        self,
        frame_set: FrameSet,
        camera: str,
        ball: str,
        chosen: Mapping[tuple[str, str], Detection],
        detections: Mapping[str, Sequence[Detection]],
    ) -> BallView:
        if (detection := chosen.get((camera, ball))) is not None:
            return BallView(ball, camera, State.EFFECTIVE, detection=detection)
        if camera not in frame_set.images:
            return BallView(ball, camera, State.SUSPENDED, Reason.NO_IMAGE)
        seen = any(d.ball == ball for d in detections.get(camera, ()))
        return BallView(
            ball, camera, State.SUSPENDED, Reason.INCONSISTENT if seen else Reason.NOT_FOUND
        )

    def _track(
        self,
        frame_set: FrameSet,
        windows: Windows,
        detections: Mapping[str, Sequence[Detection]],
    ) -> tuple[BallView, ...]:
        best = {(d.camera, d.ball): d for some in detections.values() for d in reversed(some)}
        rows = [row for row, key in enumerate(windows.keys) if key in best]
        keys = [windows.keys[row] for row in rows]
        reasons = self._gate(windows, rows, [best[key] for key in keys])
        judged = dict(zip(keys, reasons, strict=True))
        views = []
        for key in self._keys:
            camera, ball = key
            reason = judged.get(key)
            if reason is None:
                reason = Reason.NOT_FOUND if camera in frame_set.images else Reason.NO_IMAGE
            if self._waiting or reason is not Reason.NONE:
                reason = self._patience(key, reason)
            state = State.EFFECTIVE if reason is Reason.NONE else State.SUSPENDED
            views.append(BallView(ball, camera, state, reason, best.get(key)))
        return tuple(views)

    def _gate(
        self, windows: Windows, rows: Sequence[int], seen: Sequence[Detection]
    ) -> list[Reason]:
        """Why each detection is not believed, or `Reason.NONE`."""
        if not seen:
            return []
        assert self._state is not None
        c = self.config
        judged, change, covariance = judge_sightings(
            windows.sighted(rows, seen, c.min_color_match),
            np.array(rows),
            windows.balls,
            self._state.covariance,
            self._state.time_s,
            self._possible**2,
            c.systematic_px,
            chi_square_quantile(c.confidence, 2),
        )
        if not np.isnan(change[0]):
            self._faster = change[6:], covariance[6:, 6:]
        return [_REASONS[judgement] for judgement in judged.tolist()]

    def _patience(self, key: tuple[str, str], reason: Reason) -> Reason:
        """A detection that was not believed must be good for some frames before it counts."""
        if reason is Reason.NONE and self._waiting.get(key, 0) > 0:
            self._waiting[key] -= 1
            return Reason.RECOVERING
        if reason is not Reason.NONE and reason in _SUSPICIOUS:
            self._waiting[key] = self.config.recover_frames
        return reason

    def _still_strange(self, views: Sequence[BallView]) -> tuple[str, ...]:
        """Cameras that saw balls, but not these, when the body was found, and still do not."""
        if not self._strangers:
            return ()
        back = {view.camera for view in views if view.effective}
        self._strangers = tuple(name for name in self._strangers if name not in back)
        return said_of_strangers(self._strangers)

    def _jumped(self) -> tuple[str, ...]:
        """Whether it was found too far from where it was lost, by what it has shown since."""
        if self._refound is None:
            return ()
        known = self._state is not None and self._state.known
        doubts = jumped(*self._refound, self._possible if known else self._acceleration)
        if not doubts:
            self._refound = None
        return doubts

    def _missed(self) -> None:
        """A body just found that contradicts itself is not followed at all."""
        self._misses += 1
        if self._found is not None or self._misses >= self.config.lost_after:
            self._forget()

    def _forget(self) -> None:
        self._state, self._misses, self._waiting = None, 0, {}
