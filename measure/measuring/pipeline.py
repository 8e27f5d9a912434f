"""The way of an image: detector -> tracking -> triangulator -> pose solver."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.host import Detector, PoseSolver, Triangulator
from measure.measuring.instants import center_residuals, detection_at
from measure.measuring.measurement import Measurement, Status
from measure.measuring.tracking import Tracker
from measure.model import (
    BallView,
    Body,
    Camera,
    Detection,
    Expectation,
    Fix,
    FrameSet,
    Motion,
    Pose,
)


@dataclass(frozen=True, eq=False)
class Stages:
    """The parts a pipeline is made of.

    Attributes:
        detectors: one per camera, by name.
        tracker: holds the state between frame sets.
        triangulator: locates single balls.
        solver: locates the body.
        own_times: whether each image counts at its own time.
        neighbours: whether a pose is solved again with the velocity its neighbours give.
        look_again: whether, after a search of whole frames, the balls are measured once more where
            they were found.
    """

    detectors: Mapping[str, Detector]
    tracker: Tracker
    triangulator: Triangulator
    solver: PoseSolver
    own_times: bool
    neighbours: bool
    look_again: bool


class Pipeline:
    """Measures frame sets one after the other; cameras side by side."""

    def __init__(self, body: Body, cameras: Sequence[Camera], stages: Stages) -> None:
        self._body = body
        self._cameras = {camera.name: camera for camera in cameras}
        self.stages = stages

    def warm_up(self) -> None:
        """Let every stage compile or load what is slow; detectors of all cameras share that."""
        for detector in list(self.stages.detectors.values())[:1]:
            detector.warm_up()
        self.stages.triangulator.warm_up()
        self.stages.solver.warm_up()

    def measure(self, frame_sets: Iterable[FrameSet]) -> Iterator[Measurement]:
        """Measure frame sets in order of time; yields one measurement for each, in order."""
        with ThreadPoolExecutor(max_workers=len(self._cameras)) as pool:
            first_pass = (self._measure_one(frame_set, pool) for frame_set in frame_sets)
            if self.stages.neighbours:
                yield from self._with_neighbours(first_pass)
            else:
                yield from first_pass

    def _measure_one(self, frame_set: FrameSet, pool: Executor) -> Measurement:
        expected = self.stages.tracker.expect(frame_set)
        if expected is None:
            return _skipped(frame_set)
        measured = self._look(frame_set, expected, pool)
        if self.stages.look_again and measured.searched and measured.pose is not None:
            # A search only finds the balls; knowing where they are, they can be measured.
            expected = self.stages.tracker.expect(frame_set)
            if expected is not None:
                again = self._look(frame_set, expected, pool)
                measured = replace(again, searched=measured.searched)
        return measured

    def _look(
        self, frame_set: FrameSet, expected: Mapping[str, Sequence[Expectation]], pool: Executor
    ) -> Measurement:
        tracker = self.stages.tracker
        views = tracker.judge(frame_set, self._detect(frame_set, expected, pool))
        time_s = self._instant(frame_set)
        fixes = self._triangulate(views, time_s)
        prior = tracker.motion(time_s)
        pose = self._solve(views, fixes, time_s, prior)
        verdict = tracker.conclude(frame_set, views, fixes, pose)
        status = Status.LOST
        if verdict.pose is not None:
            status = Status.FLAGGED if verdict.pose.flags else Status.OK
        balls = len(self._body.balls)
        return Measurement(
            index=frame_set.index,
            time_s=time_s,
            frames=_frames(frame_set),
            views=views,
            fixes=fixes,
            pose=verdict.pose,
            status=status,
            reason=verdict.reason,
            residuals_px=self._residuals(views, verdict.pose, prior),
            searched=tuple(n for n in frame_set.images if len(expected.get(n, ())) < balls),
        )

    def _detect(
        self, frame_set: FrameSet, expected: Mapping[str, Sequence[Expectation]], pool: Executor
    ) -> dict[str, list[Detection]]:
        names = list(frame_set.images)

        def detect(name: str) -> list[Detection]:
            return self.stages.detectors[name].detect(
                frame_set.images[name], expected.get(name, ())
            )

        return dict(zip(names, pool.map(detect, names), strict=True))

    def _instant(self, frame_set: FrameSet) -> float:
        """With own times: the middle of the images' times, where moving them costs least."""
        if not self.stages.own_times or not frame_set.images:
            return frame_set.time_s
        return float(np.mean([image.time_s for image in frame_set.images.values()]))

    def _triangulate(self, views: Sequence[BallView], time_s: float) -> tuple[Fix, ...]:
        motion = self.stages.tracker.motion(time_s) if self.stages.own_times else None
        fixes = []
        for name in self._body.names:
            seen = [v.detection for v in views if v.ball == name and v.effective and v.detection]
            if motion is not None:
                seen = [detection_at(d, time_s, motion, self._body, self._cameras) for d in seen]
            if len(seen) < 2:
                continue
            fix = self.stages.triangulator.triangulate(seen, self._cameras)
            if fix is not None:
                fixes.append(replace(fix, time_s=time_s))
        return tuple(fixes)

    def _solve(
        self, views: Sequence[BallView], fixes: Sequence[Fix], time_s: float, prior: Motion | None
    ) -> Pose | None:
        seen = [v.detection for v in views if v.effective and v.detection is not None]
        if not seen:
            return None
        return self.stages.solver.solve(fixes, seen, self._cameras, time_s, prior)

    def _with_neighbours(self, measured: Iterable[Measurement]) -> Iterator[Measurement]:
        """Solve each pose again with the velocity between the poses before and after it."""
        before: Measurement | None = None
        current: Measurement | None = None
        for after in measured:
            if current is not None:
                yield self._again(before, current, after)
            before, current = current, after
        if current is not None:
            yield self._again(before, current, None)

    def _again(
        self, before: Measurement | None, current: Measurement, after: Measurement | None
    ) -> Measurement:
        if current.pose is None:
            return current
        around = [m.pose for m in (before, current, after) if m is not None and m.pose is not None]
        if len(around) < 2:
            return current
        first, last = around[0], around[-1]
        step = last.world_from_body.difference(first.world_from_body)
        motion = Motion(
            current.pose.world_from_body, current.time_s, step / (last.time_s - first.time_s)
        )
        pose = self._solve(current.views, current.fixes, current.time_s, motion)
        if pose is None:
            return current
        pose = replace(pose, flags=current.pose.flags)
        residuals = self._residuals(current.views, pose, motion)
        return replace(current, pose=pose, residuals_px=residuals)

    def _residuals(
        self, views: Sequence[BallView], pose: Pose | None, prior: Motion | None
    ) -> dict[tuple[str, str], Floats]:
        if pose is None:
            return {}
        if prior is None or not self.stages.own_times:
            still = Motion.at_rest(pose.world_from_body, pose.time_s)
            return center_residuals(views, still, self._body, self._cameras)
        moving = Motion(pose.world_from_body, pose.time_s, prior.velocity)
        return center_residuals(views, moving, self._body, self._cameras)


def _frames(frame_set: FrameSet) -> dict[str, int]:
    return {name: image.frame for name, image in frame_set.images.items()}


def _skipped(frame_set: FrameSet) -> Measurement:
    return Measurement(
        index=frame_set.index,
        time_s=frame_set.time_s,
        frames=_frames(frame_set),
        views=(),
        fixes=(),
        pose=None,
        status=Status.SKIPPED,
        reason="restarting",
    )
