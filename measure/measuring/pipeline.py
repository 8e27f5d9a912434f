"""The way of an image: detector -> tracking -> triangulator -> pose solver."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.errors import MeasureError
from measure.measuring import plugin_calls as asking
from measure.measuring import pose_spline
from measure.measuring import time_alignment as instants
from measure.measuring.backtracking import Looked, looked_back
from measure.measuring.duplicate_images import Repeats
from measure.measuring.measurement import Draft, Measurement, Status
from measure.measuring.pose_spline import motion_at, with_neighbours
from measure.measuring.stages import Stages
from measure.measuring.thread_pool import SideBySide
from measure.measuring.time_alignment import Seen
from measure.model import BallPosition, Body, Camera, Detection, Expectation, FrameSet, Motion, Pose

_SAME_MM = 5e-3
"""Motions that carry pictures to places no further apart are the same."""
_ARM_MM = np.array([1.0, 1.0, 1.0, 40.0, 40.0, 40.0])


class Pipeline:
    """Measures frame sets one after the other; cameras side by side."""

    def __init__(self, body: Body, cameras: Sequence[Camera], stages: Stages) -> None:
        self._body = body
        self._cameras = {camera.name: camera for camera in cameras}
        self._rolling = any(camera.readout_s for camera in cameras)
        self._repeats = Repeats()
        self._goes_back = stages.smoothing and all(
            not detector.stateful for detector in stages.detectors.values()
        )
        self.stages = stages

    def warm_up(self) -> None:
        """Let every stage compile or load what is slow."""
        self.warm_up_detectors()
        self.warm_up_what_follows()

    def warm_up_detectors(self) -> None:
        """One of them: those of all cameras share what is slow."""
        for one in list(self.stages.detectors.values())[:1]:
            asking.warm_up("detector", one)

    def warm_up_what_follows(self) -> None:
        """Tracking, triangulation, poses and motion."""
        self.stages.tracker.warm_up()
        asking.warm_up("triangulator", self.stages.triangulator)
        asking.warm_up("solver", self.stages.solver)
        for camera in list(self._cameras.values())[:1]:
            instants.warm_up(self._body, camera)
        if self.stages.smoothing:
            pose_spline.warm_up()

    def measure(self, frame_sets: Iterable[FrameSet]) -> Generator[Measurement]:
        """Measure frame sets in order of time; yields one measurement for each, in order.

        Raises:
            MeasureError: what the frame sets raise, after those before it have been measured.
        """
        broken = list[MeasureError]()
        with SideBySide(len(self._cameras)) as pool:
            readable = _until_broken(frame_sets, broken)
            looked = (self._draft(frame_set, pool) for frame_set in readable)
            if self._goes_back:
                drafts = looked_back(looked, lambda waiting: self._back(waiting, pool))
            else:
                drafts = (one.draft for one in looked)
            if self.stages.smoothing:
                drafts = map(self._again, with_neighbours(drafts))
            for draft in drafts:
                yield draft.measurement.with_tolerance(self._body)
        if broken:
            raise broken[0]

    def _draft(self, frame_set: FrameSet, pool: SideBySide) -> Looked:
        frame_set, doubt = self._repeats.sort_out(frame_set)
        draft = self._first_draft(frame_set, pool)
        return Looked(frame_set, draft.doubted(doubt) if doubt else draft, doubt)

    def _back(self, waiting: Sequence[Looked], pool: SideBySide) -> list[Draft]:
        """Track the body back through frame sets before it was found, as far as that leads."""
        drafts = [one.draft for one in waiting]
        tracker = self.stages.tracker.backwards()
        if tracker is None:
            return drafts
        cameras = list(self._cameras.values())
        back = Pipeline(self._body, cameras, replace(self.stages, tracker=tracker))
        for i in reversed(range(len(drafts))):
            again = back._tracked(waiting[i].frame_set, pool)
            if again is None:
                break
            drafts[i] = waiting[i].or_better(again)
        return drafts

    def _tracked(self, frame_set: FrameSet, pool: SideBySide) -> Draft | None:
        """The body where it is expected; None if it is nowhere expected, or not there."""
        expected = self.stages.tracker.expect(frame_set)
        if not expected or not all(expected.values()):
            return None
        draft = self._look(frame_set, expected, pool)
        return None if draft.measurement.pose is None else draft

    def _first_draft(self, frame_set: FrameSet, pool: SideBySide) -> Draft:
        expected = self.stages.tracker.expect(frame_set)
        if expected is None:
            return Draft(_skipped(frame_set), None, ())
        draft = self._look(frame_set, expected, pool)
        if not self.stages.remeasure_after_search:
            return draft
        return self._looked_again(frame_set, self._searched_again(frame_set, draft, pool), pool)

    def _searched_again(self, frame_set: FrameSet, draft: Draft, pool: SideBySide) -> Draft:
        """Search the very pictures in which the tracker lost the body, so that none is lost."""
        if draft.measurement.searched or draft.measurement.status is Status.OK:
            return draft
        expected = self.stages.tracker.expect(frame_set)
        if expected is None or any(expected.values()):
            return draft
        found = self._look(frame_set, expected, pool)
        return draft if found.measurement.pose is None else found

    def _looked_again(self, frame_set: FrameSet, draft: Draft, pool: SideBySide) -> Draft:
        """A search only finds the balls; knowing where they are, they can be measured."""
        measured = draft.measurement
        if not measured.searched or measured.pose is None:
            return draft
        expected = self.stages.tracker.expect(frame_set)
        if expected is None:
            return draft
        again = self._look(frame_set, expected, pool)
        return replace(again, measurement=replace(again.measurement, searched=measured.searched))

    def _look(
        self, frame_set: FrameSet, expected: Mapping[str, Sequence[Expectation]], pool: SideBySide
    ) -> Draft:
        tracker = self.stages.tracker
        views = tracker.judge(frame_set, self._detect(frame_set, expected, pool))
        time_s = self._instant(frame_set)
        prior = tracker.motion(time_s)
        seen = Seen.of(views, time_s, self._body, self._cameras)
        positions = self._triangulate(seen, prior)
        pose = self._solve(seen, positions, prior)
        residuals_px = self._residuals(seen, pose, prior)
        verdict = tracker.conclude(frame_set, views, positions, pose, residuals_px)
        balls = len(self._body.balls)
        measured = Measurement(
            index=frame_set.index,
            time_s=time_s,
            frames=_frames(frame_set),
            views=views,
            positions=positions,
            pose=verdict.pose,
            status=_status(verdict.pose),
            reason=verdict.reason,
            residuals_px=residuals_px if verdict.pose is not None else {},
            searched=tuple(n for n in frame_set.images if len(expected.get(n, ())) < balls),
        )
        raised = () if pose is None else pose.flags
        flags = () if verdict.pose is None else verdict.pose.flags
        return Draft(measured, prior, tuple(flag for flag in flags if flag not in raised), seen)

    def _detect(
        self, frame_set: FrameSet, expected: Mapping[str, Sequence[Expectation]], pool: SideBySide
    ) -> dict[str, list[Detection]]:
        def detect(name: str) -> list[Detection]:
            detector, image = self.stages.detectors[name], frame_set.images[name]
            found = asking.detections(detector, image, expected.get(name, ()), self._body)
            return self._at_their_rows(found) if self.stages.per_image_timestamps else found

        return pool.map(detect, frame_set.images)

    def _at_their_rows(self, found: list[Detection]) -> list[Detection]:
        """Detections at the times when a rolling shutter exposed their rows."""
        cameras = self._cameras
        if not self._rolling:
            return found
        return [
            replace(d, time_s=d.time_s + float(cameras[d.camera].row_delay_s(d.center_px[1])))
            if cameras[d.camera].readout_s
            else d
            for d in found
        ]

    def _instant(self, frame_set: FrameSet) -> float:
        """With own times: the middle of the images' times, where moving them costs least."""
        if not self.stages.per_image_timestamps or not frame_set.images:
            return frame_set.time_s
        return sum(image.time_s for image in frame_set.images.values()) / len(frame_set.images)

    def _triangulate(self, seen: Seen, motion: Motion | None) -> tuple[BallPosition, ...]:
        if not seen.detections:
            return ()
        used: Sequence[Detection] = seen.detections
        if motion is not None and self.stages.per_image_timestamps:
            used = seen.carried(motion)
        asked = self.stages.triangulator
        positions = asking.positions(asked, used, self._cameras, self._body, seen.time_s)
        return tuple(
            [f if f.time_s == seen.time_s else replace(f, time_s=seen.time_s) for f in positions]
        )

    def _solve(
        self, seen: Seen, positions: Sequence[BallPosition], prior: Motion | None
    ) -> Pose | None:
        if not seen.detections:
            return None
        asked, cameras = self.stages.solver, self._cameras
        pose = asking.pose(asked, positions, seen.detections, cameras, seen.time_s, prior)
        if pose is None or prior is None or not self.stages.per_image_timestamps:
            return pose
        share = seen.velocity_share(pose, prior)
        return pose if share is None else replace(pose, covariance=pose.covariance + share)

    def _again(self, near: tuple[Sequence[Pose], Draft, Sequence[Pose]]) -> Draft:
        """Solve a pose once more, with the motion that the poses round it show."""
        before, draft, after = near
        current, seen = draft.measurement, draft.seen
        if current.pose is None or seen is None or seen.at_once:
            return draft
        motion = motion_at(current.pose, before, after)
        if motion is None or not _differ(motion, draft.motion, seen.instants):
            return draft
        positions = self._triangulate(seen, motion)
        pose = self._solve(seen, positions, motion)
        if pose is None:
            return draft
        pose = replace(
            pose,
            covariance=pose.covariance * motion.gain(seen.instants) ** 2,
            flags=tuple(dict.fromkeys((*pose.flags, *draft.doubts))),
        )
        again = replace(
            current,
            positions=positions,
            pose=pose,
            status=_status(pose),
            residuals_px=self._residuals(seen, pose, motion),
        )
        return replace(draft, measurement=again, motion=motion)

    def _residuals(
        self, seen: Seen, pose: Pose | None, prior: Motion | None
    ) -> dict[tuple[str, str], Floats]:
        if pose is None:
            return {}
        return seen.residuals_px(pose, prior if self.stages.per_image_timestamps else None)


def _until_broken(frame_sets: Iterable[FrameSet], broken: list[MeasureError]) -> Iterator[FrameSet]:
    """Frame sets up to one that cannot be read, which must not take those before it along."""
    try:
        yield from frame_sets
    except MeasureError as error:
        broken.append(error)


def _status(pose: Pose | None) -> Status:
    if pose is None:
        return Status.LOST
    return Status.FLAGGED if pose.flags else Status.OK


def _differ(one: Motion, other: Motion | None, times_s: Sequence[float]) -> bool:
    """Whether two motions carry pictures of these times to places that differ at all."""
    if other is None:
        return True
    others = other.moved([*times_s, one.time_s])
    change = one.moved(times_s) - others[:-1] + others[-1]
    return bool(np.max(np.abs(change) * _ARM_MM) > _SAME_MM)


def _frames(frame_set: FrameSet) -> dict[str, int]:
    return {name: image.frame for name, image in frame_set.images.items()}


def _skipped(frame_set: FrameSet) -> Measurement:
    return Measurement(
        index=frame_set.index,
        time_s=frame_set.time_s,
        frames=_frames(frame_set),
        views=(),
        positions=(),
        pose=None,
        status=Status.SKIPPED,
        reason="restarting",
    )
