"""The way of an image, by a profile's plugins: detector, tracker, triangulator, pose solver."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from measure.arrays import Floats
from measure.errors import MeasureError
from measure.host import Detector, Plugin, PoseSolver, Tracker, Triangulator
from measure.measuring import plugin_calls
from measure.measuring.body_size import ScaleMonitor
from measure.measuring.image_faults import (
    BallSteps,
    DuplicateImages,
    NewImages,
    SmearedImages,
    WovenImages,
)
from measure.measuring.kept_rig import Keeper, KeptRig
from measure.measuring.measurement import Draft, FrameSetObservations, Measurement, Status
from measure.measuring.pose_spline import motion_at, with_surrounding_poses
from measure.model import BallPosition, Body, Camera, Detection, Expectation, FrameSet, Motion, Pose
from measure.model.doubts import Doubt
from measure.processes import usable_cores

Stage = Literal["detector", "triangulator", "solver", "tracking"]


class Profile(BaseModel):
    """A named choice of stages; `measure/profiles/*.toml` hold those that come with the program."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str  # how a user selects it
    detector: str  # name of the detector plugin
    triangulator: str  # name of the triangulator plugin
    solver: str  # name of the pose-solver plugin
    tracking: str  # "frame-update" (the paper's section II.D), "predictive" or "memoryless"
    # whether each image counts at its own time (else all images of a frame set count at one
    # instant).
    per_image_timestamps: bool
    # whether poses wait for later ones: each is solved again with the motion of a spline through
    # the poses before and after it.
    smoothing: bool
    # whether, after a search of whole frames, the balls are measured once more.
    remeasure_after_search: bool = True
    # by stage name, the settings that differ from the defaults.
    settings: dict[Stage, dict[str, Any]] = Field(default_factory=dict)

    def with_stage(self, stage: Stage, name: str) -> Profile:
        """The same profile with another plugin for one stage, at its default settings."""
        settings = {key: value for key, value in self.settings.items() if key != stage}
        return self.model_copy(update={stage: name, "settings": settings})

    def with_setting(self, stage: Stage, name: str, value: Any) -> Profile:
        """The same profile with one setting changed."""
        settings = {key: dict(values) for key, values in self.settings.items()}
        settings.setdefault(stage, {})[name] = value
        return self.model_copy(update={"settings": settings})


_SAME_BALL = 0.6
"""A circle nearer to a ball than this share of its radius, and of about its size, is that ball."""


@dataclass(frozen=True, eq=False)
class Stages:
    """The parts a pipeline is made of."""

    detectors: Mapping[str, Detector]  # one per camera, by name
    tracker: Tracker  # holds the state between frame sets
    triangulator: Triangulator  # locates single balls
    solver: PoseSolver  # locates the body
    per_image_timestamps: bool  # whether each image counts at its own time
    # whether poses wait for later ones: each is solved again with the motion of a spline through
    # the poses around it.
    smoothing: bool
    # whether, after a search of whole frames, the balls are measured once more where they were
    # found, and images in which the body was lost are searched.
    remeasure_after_search: bool


class Pipeline:
    """Measures frame sets one after the other, the cameras of each in parallel."""

    def __init__(self, body: Body, cameras: Sequence[Camera], stages: Stages) -> None:
        self.body, self.cameras = body, tuple(cameras)
        self._cameras = {camera.name: camera for camera in cameras}
        self._rolling = any(camera.readout_s for camera in cameras)
        self._duplicates, self._steps = DuplicateImages(), BallSteps()
        self._woven, self._smeared = WovenImages(), SmearedImages()
        self.stages = stages
        self.others: tuple[Pipeline, ...] = ()
        self.keeper: Keeper | None = None  # of cameras that are moved meanwhile; None for none
        self._rig: KeptRig | None = None

    def judge_pictures_as(self, other: Pipeline) -> None:
        """Begin with what another one has seen of the cameras' pictures: how they are taken."""
        self._woven, self._smeared = other._woven, other._smeared

    def warm_up(self, backwards: bool = False) -> None:
        """Let every stage compile or load what is slow; of the detectors one, as all share it.

        Args:
            backwards: the last part first, for a process that shares the work with another.
        """
        stages, order = self.stages, -1 if backwards else 1
        plugins: list[tuple[str, Plugin]]
        plugins = [("detector", one) for one in list(stages.detectors.values())[:1]]
        plugins += [("triangulator", stages.triangulator), ("solver", stages.solver)]
        for kind, plugin in plugins[::order]:
            plugin_calls.warm_up(kind, plugin, order)
        stages.tracker.warm_up()

    def measure(self, frame_sets: Iterable[FrameSet]) -> Generator[Measurement]:
        """Measure frame sets in order of time; yields one measurement for each, in order.

        Raises:
            MeasureError: what the frame sets raise, after those before it have been measured.
        """
        errors = list[MeasureError]()
        scale = ScaleMonitor(self.body)
        with ThreadPoolExecutor(max(min(len(self._cameras), usable_cores()), 1)) as pool:
            readable = _until_error(frame_sets, errors)
            drafts: Iterable[Draft] = (self._draft(frame_set, pool) for frame_set in readable)
            if self.stages.smoothing:
                drafts = map(self._smooth, with_surrounding_poses(drafts))
            for draft in drafts:
                yield scale.judged(draft.measurement.with_tolerance(self.body))
        if errors:
            raise errors[0]

    def _draft(self, frame_set: FrameSet, pool: Executor) -> Draft:
        new = self._duplicates.without_duplicates(frame_set, pool.map)
        frame_set = self._without_cameras_away(new.frame_set)
        expected = self.stages.tracker.expect(frame_set)
        if expected is None:
            skipped = Measurement(
                index=frame_set.index,
                time_s=frame_set.time_s,
                frames=_frames(frame_set),
                views=(),
                positions=(),
                pose=None,
                status=Status.SKIPPED,
                reasons=(Doubt("restarting"),),
            )
            return Draft(skipped.without_images({}, (), frame_set.damaged), ())
        draft = self._measure_once(frame_set, expected, pool)
        if self.stages.remeasure_after_search:
            draft = self._remeasured(frame_set, self._searched(frame_set, draft, pool), pool)
        review = self.stages.tracker.doubt(frame_set)
        if review is not None:
            review(self._detect(frame_set, {}, pool))
        if self.keeper is not None:
            draft = self._kept(self.keeper, new.frame_set, draft, pool)
        return self._with_picture_faults(draft, new)

    def _without_cameras_away(self, frame_set: FrameSet) -> FrameSet:
        """The frame set without cameras that are left out by now; the others as they stand now."""
        if self.keeper is None:
            return frame_set
        rig = self.keeper.rig(frame_set.index)
        if rig is not self._rig:
            if rig.changes:
                self._cameras = {camera.name: camera for camera in rig.cameras}
                self.stages.tracker.use_cameras(rig.cameras)
            self._rig = rig
        if not rig.away:
            return frame_set
        images = {n: image for n, image in frame_set.images.items() if n not in rig.away}
        return replace(frame_set, images=images)

    def _kept(self, keeper: Keeper, frame_set: FrameSet, draft: Draft, pool: Executor) -> Draft:
        """Look at cameras that may have been moved; the draft with what they show."""
        measured = replace(draft.measurement, frames=_frames(frame_set), rig=self._rig)
        motion = self.stages.tracker.motion(measured.time_s)
        wanted = keeper.looks(frame_set, measured, motion)
        images = {name: frame_set.images[name] for name in wanted}
        found = self._detect(replace(frame_set, images=images), wanted, pool)
        return replace(draft, measurement=keeper.note(measured, found))

    def _with_picture_faults(self, draft: Draft, new: NewImages) -> Draft:
        """Name cameras whose images are not theirs, woven or blurred; flag what those spoil."""
        pose, duplicates = draft.measurement.pose, self._duplicates
        shared = duplicates.judge(new.shared, () if pose is None else pose.cameras)
        measured = draft.measurement.without_images(
            duplicates.copies, new.repeated, new.frame_set.damaged
        )
        draft = replace(draft, measurement=measured)
        seen = (v.detection for v in draft.measurement.views if v.effective and v.detection)
        steps = self._steps.of(new.frame_set, seen, self._steps.due(draft.measurement.index))
        self._woven.add(steps)
        self._smeared.add(steps)
        smeared, flags = self._smeared.doubt(() if pose is None else pose.cameras)
        if not flags:
            draft = replace(draft, measurement=draft.measurement.noted(*smeared))
        return draft.flagged(*new.flags, *shared, *self._woven.flags, *(smeared if flags else ()))

    def _searched(self, frame_set: FrameSet, draft: Draft, pool: Executor) -> Draft:
        """Search the images in which the tracker just lost the body, so that no pose is missed."""
        if draft.measurement.searched or draft.measurement.status is Status.OK:
            return draft
        expected = self.stages.tracker.expect(frame_set)
        if expected is None or any(expected.values()):
            return draft
        found = self._measure_once(frame_set, expected, pool)
        return draft if found.measurement.pose is None else found

    def _remeasured(self, frame_set: FrameSet, draft: Draft, pool: Executor) -> Draft:
        """Measure again in predicted windows what a search of whole frames has found."""
        measured = draft.measurement
        if not measured.searched or measured.pose is None:
            return draft
        expected = self.stages.tracker.expect(frame_set)
        if expected is None:
            return draft
        again = self._measure_once(frame_set, expected, pool)
        return replace(again, measurement=replace(again.measurement, searched=measured.searched))

    def _measure_once(
        self, frame_set: FrameSet, expected: Mapping[str, Sequence[Expectation]], pool: Executor
    ) -> Draft:
        tracker = self.stages.tracker
        views = tracker.judge(frame_set, self._detect(frame_set, expected, pool))
        time_s = self._instant(frame_set)
        prior = tracker.motion(time_s)
        time_sds_s = {n: i.time_sd_s for n, i in frame_set.images.items() if i.time_sd_s}
        seen = FrameSetObservations.of(views, time_s, self.body, self._cameras, time_sds_s)
        positions = self._triangulate(seen, prior)
        pose = self._solve(seen, positions, prior)
        residuals_px = self._residuals(seen, pose, prior)
        conclusion = tracker.conclude(frame_set, views, positions, pose, residuals_px)
        balls = len(self.body.balls)
        measured = Measurement(
            index=frame_set.index,
            time_s=time_s,
            frames=_frames(frame_set),
            views=views,
            positions=positions,
            pose=conclusion.pose,
            status=_status(conclusion.pose),
            reasons=(conclusion.reason,) if conclusion.reason else (),
            residuals_px=residuals_px if conclusion.pose is not None else {},
            searched=tuple(n for n in frame_set.images if len(expected.get(n, ())) < balls),
        )
        by_solver = () if pose is None else pose.flags
        flags = () if conclusion.pose is None else conclusion.pose.flags
        return Draft(measured, tuple(flag for flag in flags if flag not in by_solver), seen)

    def _detect(
        self, frame_set: FrameSet, expected: Mapping[str, Sequence[Expectation]], pool: Executor
    ) -> dict[str, list[Detection]]:
        def detect(name: str) -> list[Detection]:
            detector, image = self.stages.detectors[name], frame_set.images[name]
            found = plugin_calls.detections(detector, image, expected.get(name, ()), self.body)
            if self.others and not expected.get(name):
                found = self._without_others(found, self._cameras[name], image.time_s)
            return self._at_row_times(found) if self.stages.per_image_timestamps else found

        names = list(frame_set.images)
        return dict(zip(names, pool.map(detect, names), strict=True))

    def _without_others(
        self, found: list[Detection], camera: Camera, time_s: float
    ) -> list[Detection]:
        """What a search has found, less the balls of other bodies that are being tracked."""
        for other in self.others:
            motion = other.stages.tracker.motion(time_s)
            if motion is None:
                continue
            centers = motion.at(time_s).apply(other.body.centers)
            pixels = camera.project(centers)
            depth_mm = np.linalg.norm(centers - camera.center, axis=1)
            radii = camera.intrinsics.focal_px * other.body.radii / depth_mm
            found = [d for d in found if not _is_one_of(d, pixels, radii)]
        return found

    def _at_row_times(self, found: list[Detection]) -> list[Detection]:
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
        """With per-image timestamps their mean: moving detections there costs least accuracy."""
        if not self.stages.per_image_timestamps or not frame_set.images:
            return frame_set.time_s
        return sum(image.time_s for image in frame_set.images.values()) / len(frame_set.images)

    def _triangulate(
        self, seen: FrameSetObservations, motion: Motion | None
    ) -> tuple[BallPosition, ...]:
        if not seen.detections:
            return ()
        used: Sequence[Detection] = seen.detections
        if motion is not None and self.stages.per_image_timestamps:
            used = seen.at_instant(motion)
        positions = plugin_calls.positions(
            self.stages.triangulator, used, seen.cameras, self.body, seen.time_s
        )
        return tuple(
            [p if p.time_s == seen.time_s else replace(p, time_s=seen.time_s) for p in positions]
        )

    def _solve(
        self, seen: FrameSetObservations, positions: Sequence[BallPosition], prior: Motion | None
    ) -> Pose | None:
        if not seen.detections:
            return None
        solver, cameras = self.stages.solver, seen.cameras
        pose = plugin_calls.pose(solver, positions, seen.detections, cameras, seen.time_s, prior)
        if pose is None or prior is None or not self.stages.per_image_timestamps:
            return pose
        for share in (seen.motion_covariance(pose, prior), seen.stamp_covariance(pose, prior)):
            if share is not None:
                pose = replace(pose, covariance=pose.covariance + share)
        return pose

    def _smooth(self, surrounded: tuple[Sequence[Pose], Draft, Sequence[Pose]]) -> Draft:
        """Solve a pose again with the motion of a spline through the poses before and after it."""
        before, draft, after = surrounded
        current, seen = draft.measurement, draft.seen
        if current.pose is None or seen is None or seen.simultaneous:
            return draft
        motion = motion_at(current.pose, before, after)
        if motion is None:
            return draft
        positions = self._triangulate(seen, motion)
        pose = self._solve(seen, positions, motion)
        if pose is None:
            return draft
        pose = replace(
            pose,
            covariance=pose.covariance * motion.error_growth(seen.times_s) ** 2,
            flags=tuple(dict.fromkeys((*pose.flags, *draft.tracker_flags))),
        )
        again = replace(
            current,
            positions=positions,
            pose=pose,
            status=_status(pose),
            residuals_px=self._residuals(seen, pose, motion),
        )
        return replace(draft, measurement=again)

    def _residuals(
        self, seen: FrameSetObservations, pose: Pose | None, prior: Motion | None
    ) -> dict[tuple[str, str], Floats]:
        if pose is None:
            return {}
        return seen.residuals_px(pose, prior if self.stages.per_image_timestamps else None)


def _until_error(frame_sets: Iterable[FrameSet], errors: list[MeasureError]) -> Iterator[FrameSet]:
    """Frame sets up to one that cannot be read: the error is kept until those are measured."""
    try:
        yield from frame_sets
    except MeasureError as error:
        errors.append(error)


def _is_one_of(found: Detection, pixels: Floats, radii: Floats) -> bool:
    """Whether a detection is one of balls at pixels (n, 2) of radii (n,) px."""
    off = np.linalg.norm(pixels - found.center_px, axis=1) / radii
    size = found.radius_px / radii
    return bool(np.any((off < _SAME_BALL) & (size > _SAME_BALL) & (size < 1 / _SAME_BALL)))


def _status(pose: Pose | None) -> Status:
    if pose is None:
        return Status.LOST
    return Status.FLAGGED if pose.flags else Status.OK


def _frames(frame_set: FrameSet) -> dict[str, int]:
    return {name: image.frame for name, image in frame_set.images.items()}
