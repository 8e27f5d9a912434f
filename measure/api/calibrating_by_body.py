"""Calibrating the cameras of a session by the waved body itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from measure.api.calibrating import CalibrationResult
from measure.api.lenses import tagged_px
from measure.api.measuring import search_frame_sets
from measure.api.profiles import build_detectors, build_pipeline, load_profile
from measure.api.refining import clock_shifts, lenient
from measure.api.warming_up import warm_pipeline
from measure.arrays import Ints
from measure.calibration import RigCalibration, judge, provenance
from measure.calibration.by_body.adjustment import (
    adjusted,
    freed_lenses,
    is_settled,
    loose_prior,
    moved_to,
    recording_of_links,
    shape_of,
)
from measure.calibration.by_body.lenses import link_by_focal_lengths, refuse_open, usual_lens
from measure.calibration.by_body.linking import Instant, LinkedInstant, least_motion_mm, link
from measure.calibration.refining.procedure import AdjustedRig, adjust_measured
from measure.calibration.refining.recording import ball_places, recording_of
from measure.calibration.starts import mm_per_px
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.estimation.focal_length import zoomed
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.measuring import Measurement, Pipeline, Profile
from measure.measuring.burn_in import calibrated
from measure.measuring.tracking.predictive import PredictiveTracker
from measure.model import Body, Camera, FrameSet, Intrinsics, Pose, RigObservations
from measure.processes import Progress, quiet
from measure.session import (
    JOINT_COVARIANCE,
    Calibration,
    Session,
    clock_values,
    open_session,
    picture_bytes,
    picture_tags,
    read_intrinsics,
)
from measure.session.streams import ImageStream, Stream

_SEARCHED = 60  # Instants at which whole pictures are searched, spread over the recording
_BESIDE = 1  # Frame sets before and after these that are measured as well, at last
_KNOWN_SD = np.repeat([4.0, 0.05], 3)  # mm and rad, of the body by cameras that are rough
_LINKING_SETS = 20  # Frame sets whose search takes as long as linking, about
_MOST_ROUNDS = 6
_ROUGH = 4.0  # Times as well as from single pictures lenses are known from what is measured
BY_BODY = "body"


def calibrate_by_body(
    session: Path | str,
    body: Path | str | None,
    registry: Registry,
    lenses: Path | str | None = None,
    profile: str = "precise",
    progress: Progress = quiet,
) -> CalibrationResult:
    """Calibrate a session's cameras by the body that is waved before them.

    The session needs no calibration. The world is the first camera's frame.

    Args:
        body: body file; the session's own if omitted.
        lenses: calibration; only its lenses are used.
        profile: how to measure, by name or TOML file.

    Raises:
        CalibrationError: a camera is not located, or the motion leaves something open.
    """
    known = None if lenses is None else read_intrinsics(lenses)
    source = f"in {lenses}"
    with open_session(session, _cameras_of(known, session, source), body) as opened:
        chosen = load_profile(profile)
        total = len(opened.pair().times_s)
        searched = np.unique(np.linspace(0, total - 1, min(_SEARCHED, total)).round().astype(int))
        beside = searched[:, None] + np.arange(-_BESIDE, _BESIDE + 1)
        beside = np.unique(beside.clip(0, total - 1))
        steps = _Steps(progress, len(searched), len(beside))
        few = replace(opened, chosen=searched)
        linked = _linked(few, known is not None, chosen, registry, steps)
        measure = partial(_measured, opened, lenient(chosen), registry, steps)
        rig = _settled(opened.body, linked, measure, searched, beside)
        if known is None:
            refuse_open(rig.refinement.cameras, rig.recording)
        clocks = clock_values(opened.clock_digest, clock_shifts(rig, opened.clock_shifts_s))
        shape = shape_of(rig.refinement, opened.body, rig.recording)
        located = RigCalibration(
            shape.cameras,
            BY_BODY,
            {},
            None,
            RigObservations(),
            MarkerField(),
            cameras_before=linked.first,
            around=ball_places(rig.recording.world_from_body, opened.body.centers),
            joint=shape.joint,
        )
        held_out_px = rig.halves.held_out_px[1]
        worth = np.mean([mm_per_px(camera, located.around) for camera in shape.cameras])
        verdict = replace(
            judge(located, opened.body),
            held_out_px=held_out_px,
            held_out_mm=held_out_px * float(worth),
        )
        values = provenance(located, verdict, opened.name) | clocks
        values |= {
            "body": opened.body.name,
            "frame_sets": rig.refinement.frames,
            JOINT_COVARIANCE: shape.joint,
        }
    calibration = Calibration(shape.cameras, values, shape.scale_sd)
    return CalibrationResult(calibration, located, verdict)


def _cameras_of(
    known: Mapping[str, Intrinsics] | None, session: Path | str, source: str
) -> Callable[[Mapping[str, Stream]], Calibration]:
    """Gives the session's cameras with their lenses, usual ones if none are known, in one place."""

    def lens_of(name: str, stream: Stream) -> Intrinsics:
        if known is None:
            usual, tagged_px = usual_lens(stream.size_wh), _tagged_px(stream)
            return zoomed(usual, tagged_px / usual.focal_px) if tagged_px else usual
        if name not in known:
            raise CalibrationError(
                f"camera '{name}' of {session} has no lens {source}; there is one of "
                f"{', '.join(known)}"
            )
        have, want = stream.size_wh, known[name].size_wh
        if have != tuple(want):
            raise CalibrationError(
                f"camera '{name}': the images ({stream.source}) are {have[0]}x{have[1]} px, but "
                f"its lens {source} is one for {want[0]}x{want[1]} px"
            )
        return known[name]

    def calibration(streams: Mapping[str, Stream]) -> Calibration:
        world = RigidTransform.identity()
        return Calibration(tuple(Camera(n, lens_of(n, s), world) for n, s in streams.items()))

    return calibration


def _tagged_px(stream: Stream) -> float | None:
    """The focal length by the tags of the first picture, if they state one."""
    if not isinstance(stream, ImageStream) or not stream.files:
        return None
    focal_35mm = picture_tags(picture_bytes(stream.files[0])).focal_35mm
    return None if focal_35mm is None else tagged_px(focal_35mm, stream.size_wh)


class _Steps:
    """Progress over what is searched, linked and measured, one after the other."""

    def __init__(self, progress: Progress, searched: int, measured: int) -> None:
        self._progress, self._before, self._now = progress, 0, 0
        self._expected = _LINKING_SETS + 4 * searched + (measured > searched) * measured

    def begin(self) -> None:
        """Something new begins."""
        self._before += self._now
        self._now = 0

    def __call__(self, done: int, total: int | None = None) -> None:
        """So many frame sets of it are done."""
        del total
        self._now = done
        so_far = self._before + done
        self._progress(so_far, max(self._expected, so_far))

    def linking(self, done: int, total: int | None = None) -> None:
        """So many of the steps of linking are done."""
        self(_LINKING_SETS * done // (total or done or 1))


class _Located(NamedTuple):
    """Cameras, and where the body was at some times by them."""

    first: tuple[Camera, ...]  # what is known of their lenses before any adjustment
    cameras: tuple[Camera, ...]
    body_at: tuple[LinkedInstant, ...]


def _linked(
    session: Session, lenses_known: bool, profile: Profile, registry: Registry, steps: _Steps
) -> _Located:
    """The cameras as single pictures place them, and adjusted to these."""
    detectors = build_detectors(profile, registry, session.body, session.cameras)
    chosen, found = range(len(session.pair().times_s)), list[Instant]()
    for frame_set, (seen,) in search_frame_sets(session, [detectors], chosen):
        found.append(Instant(frame_set.time_s, seen))
        steps(len(found))
    lenses = {camera.name: camera.intrinsics for camera in session.cameras}
    steps.begin()
    if lenses_known:
        linked = link(lenses, session.body, found, steps.linking)
    else:
        linked = link_by_focal_lengths(lenses, session.body, found, steps.linking)
    first, recording = linked.cameras, recording_of_links(linked, session.body)
    try:
        now = adjusted(first, session.body, recording).cameras
    except CalibrationError:
        return _Located(first, first, linked.instants)  # measured with them as they are
    if lenses_known:
        return _Located(first, now, linked.instants)
    refuse_open(now, recording, _ROUGH)
    return _Located(first, now, ())  # other lenses place the body elsewhere


def _measured(
    session: Session,
    profile: Profile,
    registry: Registry,
    steps: _Steps,
    cameras: tuple[Camera, ...],
    body_at: Sequence[LinkedInstant],
    chosen: Ints,
) -> list[Measurement]:
    """Some frame sets measured, as if the cameras were known exactly.

    The tracker gets the place of the body where it knows that worse: from one of them to the next
    it may have moved far.
    """
    steps.begin()
    exact = tuple(
        Camera(c.name, replace(c.intrinsics, covariance=None), c.world_from_camera) for c in cameras
    )
    warm, known = warm_pipeline(profile, registry, session.body, exact), np.diag(_KNOWN_SD**2)
    tracking = [warm.stages.tracker]  # of the pipeline that was built last
    reach_s = (_BESIDE + 0.5) * float(np.median(np.diff(session.pair().times_s)))
    session = replace(session, cameras=exact, chosen=chosen)

    def build_known(body: Body, cameras: Sequence[Camera]) -> Pipeline:
        pipeline = build_pipeline(profile, registry, body, cameras)
        tracking[:] = [pipeline.stages.tracker]
        return pipeline

    def frame_sets() -> Iterator[FrameSet]:
        for frame_set in session.frame_sets():
            at = min(body_at, key=lambda one: abs(one.time_s - frame_set.time_s), default=None)
            near = at is not None and abs(at.time_s - frame_set.time_s) <= reach_s
            if at and near and isinstance(tracking[0], PredictiveTracker):
                pose = Pose(at.time_s, at.world_from_body, known, 0.0, 0.0, (), ())
                tracking[0].begin_near(pose)
            yield frame_set

    measured = list[Measurement]()
    for one in calibrated(warm, build_known, frame_sets).measure(frame_sets()):
        measured.append(one)
        steps(len(measured))
    return measured


def _settled(
    body: Body,
    linked: _Located,
    measure: Callable[[tuple[Camera, ...], Sequence[LinkedInstant], Ints], list[Measurement]],
    few: Ints,
    beside: Ints,
) -> AdjustedRig:
    """Measured with the cameras found and adjusted again, until they stay where they are.

    Until then only a few frame sets are measured, then also those beside them: these tell the
    motion, and with it the clocks. Unknown lenses get as free in the second round as suits instants
    that are held out.
    """
    first, cameras, body_at = linked
    for number in range(_MOST_ROUNDS):
        measured = measure(cameras, body_at, few)
        recording = recording_of(measured, body, None, True, least_motion_mm(body))
        first = moved_to(first, cameras)
        if number == 1:
            first = freed_lenses(first, body, recording)
        refinement = adjusted(first, body, recording)
        settled = is_settled(cameras, refinement)
        cameras = refinement.cameras
        poses = [one.pose for one in measured if one.pose is not None]
        if body_at:
            body_at = tuple(LinkedInstant(p.time_s, p.world_from_body, ()) for p in poses)
        if settled and number:
            break
    if len(beside) > len(few):
        measured = measure(cameras, body_at, beside)
    first = moved_to(first, cameras)
    return adjust_measured(first, body, measured, None, loose_prior(first), least_motion_mm(body))
