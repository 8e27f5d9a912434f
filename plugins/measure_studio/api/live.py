"""Measuring live, from running cameras."""

# Annotations are no texts here: cyclopts reads them of records that inherit these in other modules.

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from measure.api import Cause, Keep, Measurement, Pipeline, Profile, RigWatch, relative_measurements
from measure.api.folders import mark_event
from measure.api.measuring import keep_cameras, live_pipelines, measure_frame_sets, why_not_kept
from measure.api.outputs import check_folder
from measure.api.profiles import build_pipeline
from measure.api.run import noted, provenance
from measure.api.run_log import LogOptions, RunLog
from measure.api.warming_up import warm_pipeline
from measure.errors import ConfigError
from measure.host import EventMark, Registry, SentPose, SentRun
from measure.model import Body, Camera, Doubt, FrameSet, Image
from measure.processes import share_heaps
from measure.results import Provenance, RunWriter, Summary, check_run_folder
from measure.session import Calibration, check_bodies, check_unit, read_body
from measure_studio.api import recording
from measure_studio.api.marks import check_marks, marks_received
from measure_studio.api.sending import Sending, SendOptions, open_sending, sent_pose
from measure_studio.capture import CameraAddress, CameraCount, Cameras, Gathering, check_names
from measure_studio.capture.sources import RECENT, Source

LEARNING = "learning how the balls look from the first pictures"
"""The last step before the first pose; pictures are recorded from here on."""


@dataclass(frozen=True)
class LiveOptions(recording.CaptureOptions, LogOptions, SendOptions):
    """How cameras are measured live.

    Attributes:
        record: a session folder to record the pictures into as well.
        reference: name of the body that the others are measured relative to.
        marks: where event marks come from, udp://:PORT or lsl:NAME; may be repeated.
        keep_calibration: if omitted, a camera that is moved meanwhile is left out and brought back;
            `follow` also follows one that drifts; `warn` only names it; `off` measures with it as
            it is.
        on_step: called with what is done next, before the first pose.
    """

    record: Path | None = None
    reference: str = ""
    marks: tuple[str, ...] = ()
    keep_calibration: Keep | None = None
    on_step: Callable[[str], None] = lambda _: None


@dataclass(frozen=True)
class LiveState:
    """State of a live measurement."""

    latest: Sequence[Measurement]  # the last measurement of each body
    frame_sets: int  # how many are measured
    rate_hz: float  # of late; NaN at first
    # from the middle of a frame set's pictures to its pose being there, median of late.
    age_s: float
    overtaken: int  # pictures a camera that were left out for newer ones
    unreadable: int  # pictures that could not be decoded
    cameras: Mapping[str, CameraCount]  # what has come of each
    images: Mapping[str, Image]  # the pictures that were measured, by camera
    away: tuple[str, ...] = ()  # the cameras that are away now
    causes: tuple[Cause, ...] = ()  # what has seemed wrong with the rig of late


@dataclass(frozen=True)
class LiveEnd:
    """A live measurement that has ended."""

    summary: Summary  # of the run
    state: LiveState | None  # at the end; None if there was no frame set
    changes: tuple[str, ...] = ()  # a sentence for each control of a camera that changed meanwhile
    # what came of the poses for each address.
    sent: Mapping[str, Mapping[str, int]] = field(default_factory=dict)


def live(
    cameras: Sequence[CameraAddress],
    out: Path,
    calibration: Path,
    bodies: Sequence[Path],
    profile: Profile,
    registry: Registry,
    options: LiveOptions | None = None,
    on_state: Callable[[LiveState], None] = lambda _: None,
) -> LiveEnd:
    """Measure live, from running cameras, for a time or until interrupted.

    Unlike those of a recording, poses do not wait for later pictures. Where measuring is slower
    than the cameras, frame sets are left out.

    Args:
        cameras: where their pictures come from; at least two.
        out: the run's folder.
        bodies: the bodies' files, one or several.
        options: what else is to be done with pictures and poses.
        on_state: called after every frame set.

    Raises:
        MeasureError: whatever is wrong with cameras, calibration, body, plugins or settings; what
            was measured before it was met is kept.
    """
    share_heaps()
    options = options or LiveOptions()
    options.on_step("loading what was compiled")
    prepared = _prepare(cameras, out, calibration, bodies, profile, registry, options)
    sent = prepared.sent
    options.on_step("connecting the cameras")
    with ExitStack() as stack:
        opened = stack.enter_context(recording.open_rig(prepared.sources, sent.cameras, options))
        rig = opened.cameras
        gathering = Gathering(list(rig.addresses), on_read=rig.note_read)
        takers = [gathering.add, *_recorders(stack, opened, prepared, options.record)]
        sending = stack.enter_context(prepared.sending)
        writer = stack.enter_context(_writer(out, prepared, options))
        writer.begin()
        log = stack.enter_context(
            RunLog(sent.name, sent.bodies, sent.cameras, out, options, note=options.on_note)
        )

        def on_mark(time_s: float, what: str) -> None:
            mark_event(out, what, time_s)
            sending.send((), [EventMark(time_s, time_s, what)])

        stack.enter_context(marks_received(options.marks, rig.clock_s, on_mark))
        # Each call begins with the frame sets that come then.
        frame_sets = partial(gathering.frame_sets, opened.begin(*takers), rig.check)
        options.on_step(LEARNING)
        pipelines = live_pipelines(prepared.warm, prepared.build, frame_sets)
        keep_cameras(pipelines, options.keep_calibration)
        looking = stack.enter_context(ThreadPoolExecutor(1))
        watches = [RigWatch(body, sent.cameras, looking) for body in sent.bodies]
        state, watch = None, _PaceMeter(gathering, rig, watches)
        for frame_set, known in _measured(pipelines, frame_sets(), rig):
            sending.send(_sent_poses(sent, known, rig.clock_s()), images=frame_set.images)
            writer.append(*known)
            log.add(known, frame_set)
            state = watch.state(known, frame_set.images)
            on_state(state)
        rig.check()
        log.close()
        summary = writer.finish()
    return LiveEnd(summary, state, tuple(opened.controls.changed.values()), sending.counts)


def _writer(out: Path, prepared: "_Prepared", options: LiveOptions) -> RunWriter:
    sent, overwrite = prepared.sent, options.overwrite
    return RunWriter(
        out,
        prepared.made_from,
        sent.bodies,
        sent.cameras,
        overwrite=overwrite,
        reference=sent.reference,
    )


def _measured(
    pipelines: Sequence[Pipeline], frame_sets: Iterable[FrameSet], rig: Cameras
) -> Iterator[tuple[FrameSet, list[Measurement]]]:
    """Each frame set and its measurements, which say which cameras are away."""
    for frame_set, found in measure_frame_sets(pipelines, frame_sets):
        rig.note_copies(frame_set.images, found[0].copies)
        yield frame_set, [_with_away(each, rig.away) for each in found]


def _recorders(
    stack: ExitStack, opened: recording.OpenRig, prepared: "_Prepared", folder: Path | None
) -> Iterator[Callable[[Image], None]]:
    """What takes pictures to be recorded, if they are."""
    if folder is not None:
        sent = prepared.sent
        rig = Calibration(sent.cameras, scale_sd=prepared.made_from.scale_sd)
        recorder = recording.new_recorder(folder, opened, sent.bodies, rig, sent.reference)
        yield stack.enter_context(recorder).add


@dataclass(frozen=True)
class _Prepared:
    """What a live measurement needs, all of it checked, before a camera is asked for pictures."""

    sent: SentRun
    sending: Sending
    sources: Mapping[str, Source]
    build: Callable[[Body, Sequence[Camera]], Pipeline]
    warm: Sequence[Pipeline]  # of each body
    made_from: Provenance


def _prepare(
    cameras: Sequence[CameraAddress],
    out: Path,
    calibration: Path,
    bodies: Sequence[Path],
    profile: Profile,
    registry: Registry,
    options: LiveOptions,
) -> _Prepared:
    options.check()
    _check_outputs(out, options, [one.name for one in cameras])
    if len(cameras) < 2:
        raise ConfigError(f"a measurement needs at least two cameras, got {len(cameras)}")
    known = recording.calibration_of(cameras, calibration)
    calibrated = known.cameras
    measured = [read_body(body) for body in bodies]
    check_bodies(measured, options.reference, "--body")
    cure = 'write mm, or into another program\'s file its unit, as in unit = "m"'
    check_unit(known, measured[0], str(calibration), cure)
    profile = profile.model_copy(update={"smoothing": False})
    sent = SentRun(out.resolve().name, tuple(measured), calibrated, options.reference)
    sending = open_sending(options, registry, sent)
    sources = recording.sources_of(cameras, calibrated, options.request)
    options.check_viewer()
    return _Prepared(
        sent,
        sending,
        sources,
        partial(build_pipeline, profile, registry),
        [warm_pipeline(profile, registry, body, calibrated) for body in measured],
        _made_from(options, known.scale_sd, len(cameras), calibration, measured, profile, registry),
    )


def _made_from(
    options: LiveOptions,
    scale_sd: float,
    cameras: int,
    calibration: Path,
    bodies: Sequence[Body],
    profile: Profile,
    registry: Registry,
) -> Provenance:
    record = None if options.record is None else options.record.resolve()
    keep, said = options.keep_calibration, ["measured live"]
    if keep not in (None, "off"):
        said.append(why_not_kept(len(bodies), cameras))
    return provenance(
        calibration,
        bodies,
        profile,
        registry,
        session="" if record is None else str(record / "session.toml"),
        session_digest="",  # of pictures that are yet to come
        session_name="live" if record is None else record.name,
        notes=noted("cameras", said),
        scale_sd=scale_sd,
        keep=keep,
    )


def _check_outputs(out: Path, options: LiveOptions, names: Sequence[str]) -> None:
    """Refuse what must not be overwritten, before anything is slow."""
    if options.record is not None:
        recording.check_apart(options.record, out)
        check_folder(options.record, options.overwrite, recording.SESSION)
        check_names(names)
    check_run_folder(out, None, options.overwrite)
    check_marks(options.marks)


def _with_away(measured: Measurement, away: Sequence[str]) -> Measurement:
    """The same, saying which cameras are away; a pose without them is as good as it states."""
    known = {*measured.frames, *measured.copies}
    return measured.noted(*(Doubt("away", camera=name) for name in away if name not in known))


def _sent_poses(run: SentRun, measured: Sequence[Measurement], known_s: float) -> list[SentPose]:
    """The poses of a frame set, and those relative to the reference."""
    names = [body.name for body in run.bodies]
    own = [sent_pose(one, name, known_s=known_s) for one, name in zip(measured, names, strict=True)]
    relative = relative_measurements(run.bodies, measured, run.reference, run.cameras)
    return own + [sent_pose(one, name, run.reference, known_s) for name, one in relative.items()]


class _PaceMeter:
    """Rate of measurements and age of poses, and what is wrong with the rig."""

    def __init__(self, gathering: Gathering, rig: Cameras, watches: Sequence[RigWatch]) -> None:
        self._gathering, self._rig, self._watches = gathering, rig, watches
        self._done: deque[float] = deque(maxlen=RECENT)
        self._ages: deque[float] = deque(maxlen=RECENT)

    def state(self, measured: Sequence[Measurement], images: Mapping[str, Image]) -> LiveState:
        """The state after these measurements of a frame set's pictures."""
        now = time.monotonic()
        self._done.append(now)
        self._ages.append(self._rig.clock_s() - measured[0].time_s)
        span = self._done[-1] - self._done[0]
        for watch, one in zip(self._watches, measured, strict=True):
            watch.add(one)
        return LiveState(
            measured,
            measured[0].index + 1,
            (len(self._done) - 1) / span if span > 0 else math.nan,
            float(np.median(self._ages)),
            self._gathering.overtaken,
            self._gathering.unreadable,
            self._rig.counts,
            images,
            self._rig.away,
            tuple(cause for watch in self._watches for cause in watch.causes),
        )
