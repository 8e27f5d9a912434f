"""Predictive tracking: a motion filter predicts search windows and gates detections.

The states are the paper's (section II.D): a ball is effective in a camera or suspended, with the
reason. Gates come from covariances. Without a prediction whole frames are searched, and the body is
found among all candidates of its colours by association.

A search that finds balls of a second body, or the body further away than it can have moved, leaves
a doubt whether the body that is tracked is another. Tracking in windows never sees what else there
is, so whole images are searched beside it now and then; the doubt ends when they show the body
alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np

from measure import model
from measure.arrays import Floats
from measure.estimation.multiview import calibration_noise
from measure.geometry import chi_square_quantile
from measure.host import Conclusion, Review, Settings, Tracker
from measure.measuring import association
from measure.measuring.association import Association, associate, second_body
from measure.measuring.tracking.motion_filter import MotionState, initial_state, per_axis
from measure.measuring.tracking.pose_checks import PoseChecks, ResidualTable, too_uncertain
from measure.measuring.tracking.search_windows import (
    SearchWindows,
    gate_observations,
    predict_windows,
)
from measure.measuring.tracking.settings import PredictiveConfig
from measure.model import Doubt, Rig
from measure.model.observations import Reason, State

_MOTION_CONFIDENCE = 0.9999
_REVIEW_EVERY_S = 0.5
_REVIEWS_ALONE = 3  # Reviews in a row that must show no other body: one may be hidden for a moment


class IdentityDoubt:
    """The flags of a search that hold until later images contradict them."""

    def __init__(self) -> None:
        self._second_body: tuple[str, ...] = ()
        self._restart: tuple[MotionState | None, MotionState] | None = None
        self._reviewed_s: float | None = None
        self._alone = 0
        self._raised = False

    def begin(
        self, second_body: tuple[str, ...], lost: MotionState | None, found: MotionState
    ) -> None:
        """A search has found the body.

        Args:
            second_body: flags of another body beside it.
            lost: the motion when it was last seen; None if it never was.
        """
        self._second_body, self._restart = second_body, (lost, found)
        self._reviewed_s, self._alone, self._raised = found.time_s, 0, bool(second_body)

    def flags(
        self, state: MotionState | None, acceleration: Floats, observed: Floats
    ) -> tuple[str, ...]:
        """The doubts that hold.

        Args:
            acceleration: (6,) standard deviations by the settings.
            observed: (6,) the same by what was observed since, where it is known.
        """
        moved: tuple[str, ...] = ()
        if self._restart is not None:
            known = state is not None and state.accelerations_known
            moved = _implausible_motion(*self._restart, observed if known else acceleration)
            if not moved:
                self._restart = None
        self._raised = bool(self._second_body or moved)
        return self._second_body + moved

    def due(self, time_s: float) -> bool:
        """Whether a doubt holds and whole images were not searched for some time."""
        if not self._raised or self._reviewed_s is None:
            return False
        return time_s - self._reviewed_s >= _REVIEW_EVERY_S

    def reviewed(self, second_body: tuple[str, ...], time_s: float) -> None:
        """Take what whole images show: flags of another body, or none."""
        self._reviewed_s = time_s
        if second_body:
            self._second_body, self._alone = second_body, 0
            return
        self._alone += 1
        if self._alone >= _REVIEWS_ALONE:
            self._second_body, self._restart, self._raised = (), None, False


def _implausible_motion(
    lost: MotionState | None, found: MotionState, acceleration_sd: Floats
) -> tuple[str, ...]:
    """A flag if a body was found further from where it was lost than it can have moved.

    Args:
        lost: the motion when the body was last seen; None if it never was.
        acceleration_sd: (6,) as in `MotionState.at`.
    """
    if lost is None:
        return ()
    expected = lost.at(found.time_s, acceleration_sd)
    step = found.world_from_body.difference(expected.world_from_body)
    noise = expected.covariance[:6, :6] + found.covariance[:6, :6]
    if step @ np.linalg.solve(noise, step) < chi_square_quantile(_MOTION_CONFIDENCE, 6):
        return ()
    moved = np.linalg.norm(found.world_from_body.translation - lost.world_from_body.translation)
    return (Doubt("too-far", moved_mm=float(moved), since_s=found.time_s - lost.time_s),)


_EXTRA_SD = np.repeat([0.02, 0.0005], 3)
"""Standard deviations (mm, rad) added to a measured pose in the filter: systematic errors."""
_SUSPICIOUS = (Reason.JUMPED, Reason.COLOR, Reason.INCONSISTENT)


class PredictiveTracker(Tracker):
    """Predicts windows, gates detections, flags poses, and searches again when lost."""

    name = "predictive"
    Config: ClassVar[type[Settings]] = PredictiveConfig
    config: PredictiveConfig

    def __init__(
        self, config: PredictiveConfig, body: model.Body, cameras: Sequence[model.Camera]
    ) -> None:
        super().__init__(config, body, cameras)
        self._keys = [(camera.name, ball) for camera in cameras for ball in body.names]
        self._acceleration = per_axis(config.acceleration_mm_s2, config.angular_acceleration_rad_s2)
        self._speed = per_axis(config.speed_mm_s, config.angular_speed_rad_s)
        self._acceleration_bound = self._acceleration
        self._checks = PoseChecks(config)
        self._state: MotionState | None = None
        self._windows: SearchWindows | None = None
        self._found: Association | None = None
        self._identity = IdentityDoubt()
        self._note = ""  # what the last search left out: it holds while the body is tracked
        self._last_state: MotionState | None = None
        self._recovering: dict[tuple[str, str], int] = {}
        self._misses = 0
        self._velocity_change: tuple[Floats, Floats] | None = None

    def warm_up(self) -> None:
        """Compile or load the loops of searching and of tracking."""
        association.warm_up(self.cameras)
        calibration_noise(Rig.of(self.cameras), self.body.middle)

    def begin_near(self, pose: model.Pose) -> None:
        """Take the body to be where it is known to be from elsewhere, unless that is known better.

        To be asked before a frame set of about that time is.
        """
        known = None if self._state is None else self._state.at(pose.time_s, self._acceleration)
        if known is None or np.trace(known.covariance[:3, :3]) > np.trace(pose.covariance[:3, :3]):
            self._forget()
            self._state = initial_state(
                pose.world_from_body,
                pose.covariance,
                pose.time_s,
                self._speed,
                self._acceleration,
                None,
            )

    def expect(self, frame_set: model.FrameSet) -> Mapping[str, Sequence[model.Expectation]]:
        """Windows from the predicted pose at each image's own time; the whole frame without one."""
        self._windows = self._found = self._velocity_change = None
        if self._state is not None and frame_set.images:
            latest = max(image.time_s for image in frame_set.images.values())
            if abs(latest - self._state.time_s) > self.config.max_gap_s:
                self._forget()
        if self._state is None or not frame_set.images:
            return dict.fromkeys(frame_set.images, ())
        times_s = {name: image.time_s for name, image in frame_set.images.items()}
        self._acceleration_bound = self._state.acceleration_bound(self._acceleration)
        self._windows = predict_windows(
            self._state, times_s, self._acceleration_bound, self.body, self.cameras
        )
        c = self.config
        return self._windows.expectations(c.reach_sigmas, c.min_reach_px, c.radius_slack)

    def doubt(self, frame_set: model.FrameSet) -> Review | None:
        """Looks for another body beside the one that is tracked, if that may be the wrong one."""
        state, time_s = self._state, frame_set.time_s
        if state is None or not self._identity.due(time_s):
            return None
        present = [camera for camera in self.cameras if camera.name in frame_set.images]

        def review(detections: Mapping[str, Sequence[model.Detection]]) -> None:
            flags = second_body(state.world_from_body, self.body, present, detections)
            self._identity.reviewed(flags, time_s)

        return review

    def judge(
        self, frame_set: model.FrameSet, detections: Mapping[str, Sequence[model.Detection]]
    ) -> tuple[model.BallView, ...]:
        """Association across cameras while searching; gates while tracking."""
        if self._windows is None:
            return self._search(frame_set, detections)
        return self._track(frame_set, self._windows, detections)

    def motion(self, time_s: float) -> model.Motion | None:
        """The predicted motion at `time_s`; right after a search, the pose found, at rest.

        The velocity includes the change that the gated detections of this frame set ask for: else
        detections of an accelerating body would be moved to one instant by an outdated velocity.
        """
        if self._state is None:
            return None
        return self._state.at(time_s, self._acceleration_bound).motion(self._velocity_change)

    def conclude(
        self,
        frame_set: model.FrameSet,
        views: Sequence[model.BallView],
        positions: Sequence[model.BallPosition],
        pose: model.Pose | None,
        residuals_px: Mapping[tuple[str, str], Floats],
    ) -> Conclusion:
        """Flag the pose; unless a flag is hard, update the motion filter with it."""
        if pose is None:
            reason = self._found.reason if self._found is not None else ""
            self._missed()
            return Conclusion(None, reason or Doubt("against-prediction"))
        bias_px = self.config.view_bias_px
        table = ResidualTable(pose, views, residuals_px, self.body, self.cameras, bias_px)
        hard = self._checks.hard(table, positions)
        new = self._state is not None and self._state.new
        new_at_s = [image.time_s for image in frame_set.images.values() if new]
        soft = self._checks.soft(table, partial(self.motion, pose.time_s), new_at_s)
        soft += self._identity.flags(self._state, self._acceleration, self._acceleration_bound)
        flags = tuple(dict.fromkeys((*pose.flags, *hard, *soft)))
        if hard:
            self._missed()
        elif too_uncertain(pose, self.body):
            self._forget()
        elif self._state is not None:
            self._misses = 0
            self._state = self._state.updated(pose, _EXTRA_SD, self._acceleration)
            self._last_state, self._velocity_change = self._state, None
        return Conclusion(pose if flags == pose.flags else replace(pose, flags=flags), self._note)

    def _search(
        self, frame_set: model.FrameSet, detections: Mapping[str, Sequence[model.Detection]]
    ) -> tuple[model.BallView, ...]:
        present = [camera for camera in self.cameras if camera.name in frame_set.images]
        self._found = found = associate(self.body, present, detections)
        self._recovering = {}
        self._note = "" if found.reflection is None else found.reflection.note
        if found.world_from_body is not None:
            assert found.covariance is not None
            time_s = float(np.mean([d.time_s for d in found.detections]))
            self._state = initial_state(
                found.world_from_body,
                found.covariance,
                time_s,
                self._speed,
                self._acceleration,
                self._last_state,
            )
            self._identity.begin(found.flags, self._last_state, self._state)
            self._checks.begin(found.disagreeing)
        chosen = {(d.camera, d.ball): d for d in found.detections}
        seen = {(d.camera, d.ball) for some in detections.values() for d in some}
        return tuple(
            _searched_view(key, frame_set, chosen.get(key), key in seen) for key in self._keys
        )

    def _track(
        self,
        frame_set: model.FrameSet,
        windows: SearchWindows,
        detections: Mapping[str, Sequence[model.Detection]],
    ) -> tuple[model.BallView, ...]:
        best = {(d.camera, d.ball): d for some in detections.values() for d in reversed(some)}
        rows = [row for row, key in enumerate(windows.keys) if key in best]
        keys = [windows.keys[row] for row in rows]
        reasons = self._gate(windows, rows, [best[key] for key in keys])
        gated = dict(zip(keys, reasons, strict=True))
        views = []
        for key in self._keys:
            camera, ball = key
            reason = gated.get(key)
            if reason is None:
                reason = Reason.NOT_FOUND if camera in frame_set.images else Reason.NO_IMAGE
            if self._recovering or reason is not Reason.NONE:
                reason = self._recovery(key, reason)
            state = State.EFFECTIVE if reason is Reason.NONE else State.SUSPENDED
            views.append(model.BallView(ball, camera, state, reason, best.get(key)))
        return tuple(views)

    def _gate(
        self, windows: SearchWindows, rows: Sequence[int], seen: Sequence[model.Detection]
    ) -> list[Reason]:
        """Why each detection is suspended, or `Reason.NONE`."""
        if not seen:
            return []
        assert self._state is not None
        c = self.config
        reasons, self._velocity_change = gate_observations(
            windows.observations(rows, seen, c.min_color_match),
            np.array(rows),
            windows.balls,
            self._state.covariance,
            self._state.time_s,
            self._acceleration_bound**2,
            c.systematic_px,
            chi_square_quantile(c.confidence, 2),
        )
        return reasons

    def _recovery(self, key: tuple[str, str], reason: Reason) -> Reason:
        """A suspended detection must be good for some frames before it is effective again."""
        if reason is Reason.NONE and self._recovering.get(key, 0) > 0:
            self._recovering[key] -= 1
            return Reason.RECOVERING
        if reason is not Reason.NONE and reason in _SUSPICIOUS:
            self._recovering[key] = self.config.recover_frames
        return reason

    def _missed(self) -> None:
        """Count a frame set without an accepted pose; forget the body at once after a search."""
        self._misses += 1
        if self._found is not None or self._misses >= self.config.lost_after:
            self._forget()

    def _forget(self) -> None:
        self._state, self._misses, self._recovering = None, 0, {}


def _searched_view(
    key: tuple[str, str], frame_set: model.FrameSet, chosen: model.Detection | None, seen: bool
) -> model.BallView:
    """The state of a ball in a camera after a search: effective if its candidate was chosen."""
    camera, ball = key
    if chosen is not None:
        return model.BallView(ball, camera, State.EFFECTIVE, detection=chosen)
    reason = Reason.INCONSISTENT if seen else Reason.NOT_FOUND
    if camera not in frame_set.images:
        reason = Reason.NO_IMAGE
    return model.BallView(ball, camera, State.SUSPENDED, reason)
