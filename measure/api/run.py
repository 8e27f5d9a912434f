"""Measuring a session into a run folder."""

# Annotations are no texts here: cyclopts reads them of records that inherit these in other modules.

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, get_args

from measure.api.measuring import measure_bodies, why_not_kept
from measure.api.run_log import LogOptions, RunLog
from measure.checking import ColorCount, Finding, Level
from measure.checking.pictures import stamp_causes
from measure.errors import MeasureError
from measure.host import Registry
from measure.host.settings import read_settings
from measure.measuring import Measurement, Profile
from measure.measuring.kept_rig import Keep
from measure.measuring.pipeline import Stage
from measure.model import Body, FrameSet
from measure.model.body import USUAL_RADIUS_TOLERANCE_MM
from measure.processes import Progress, quiet
from measure.results import Provenance, Run, RunWriter, Summary, check_run_folder, digest
from measure.session import Session, Trajectory, open_session, read_trajectory

_FIRST_FRAME_SETS = 3  # Frame sets that are looked at for colour before a run


@dataclass(frozen=True)
class RunOptions(LogOptions):
    """How a session is measured, and what becomes of an earlier run.

    Attributes:
        calibration: a calibration to use instead of the session's.
        body: the body's file, instead of a session's own; may be repeated for several bodies.
        reference: name of the body that the others are measured relative to.
        resume: continue an interrupted run: its rows stay, the rest is measured.
        overwrite: Replace what is there.
        keep_calibration: if omitted, a camera that is moved meanwhile is left out and brought back;
            `follow` also follows one that drifts; `warn` only names it; `off` measures with it as
            it is.
    """

    calibration: Path | None = None
    body: Sequence[Path] = ()
    reference: str | None = None
    resume: bool = False
    overwrite: bool = False
    keep_calibration: Keep | None = None

    def open(self, session: Path) -> Session:
        """Open a session with these files."""
        return open_session(session, self.calibration, self.body or None, reference=self.reference)


def run(
    session_path: Path,
    out: Path,
    profile: Profile,
    registry: Registry,
    options: RunOptions | None = None,
    progress: Progress = quiet,
    on_note: Callable[[str], None] = lambda _: None,
) -> Summary:
    """Measure a session; every frame set becomes a row of the run, with or without a pose.

    A run that is resumed keeps its rows. Detectors calibrate themselves on the first frame sets
    again, and the last seconds of what is kept are measured once more as a run-up (`RUN_UP_S`):
    the poses that follow are those of an undisturbed run to within a small part of their error.

    Args:
        session_path: the session's folder, which is only read.
        on_note: called, from any thread, with a line that says where a run is resumed, what of it
            is mended, or that the viewer does not keep up.

    Raises:
        MeasureError: whatever is wrong with the session, calibration, plugins or settings; what was
            measured before it was met is kept.
    """
    options = options or RunOptions()
    with (
        opened_run(session_path, out, profile, registry, options, on_note) as (session, writer),
        ExitStack() as stack,
    ):
        total, kept = len(session.pair().times_s), writer.kept
        measured: Iterator[tuple[FrameSet, tuple[Measurement, ...]]] = iter(())
        if kept < total:
            keep, earlier = options.keep_calibration, writer.camera_changes
            measured = measure_bodies(session, profile, registry, kept, keep, earlier)
        # Stages that do not fit together or fail at the very first picture are met here: before a
        # folder is made, or an earlier run lost.
        first = list(islice(measured, 1))
        options = _recording_due(options, out, kept, total, on_note)
        kept_runs = writer.kept_runs if kept and options.wanted else ()
        writer.begin()
        log = stack.enter_context(_log(session, out, options, kept, total, on_note))
        for again in _measured_before(kept_runs, kept):
            log.add(again)
        for frame_set, measurements in chain(first, measured):
            writer.append(*measurements)
            log.add(measurements, frame_set)
            progress(measurements[0].index + 1, total)
        log.close()
        return writer.finish()


@contextmanager
def opened_run(
    session_path: Path,
    out: Path,
    profile: Profile,
    registry: Registry,
    options: RunOptions,
    on_note: Callable[[str], None],
) -> Iterator[tuple[Session, RunWriter]]:
    """A session and what writes its run, which knows what is kept of an earlier one; see `run`."""
    check_run_folder(out, options.resume, options.overwrite)
    with options.open(session_path) as session:
        total = len(session.pair().times_s)
        options.check_viewer()
        origin = made_from(session, profile, registry, options.keep_calibration)
        with _writer(session, out, origin, options) as writer:
            if writer.kept:
                on_note(f"resumed at frame set {writer.kept} of {total}")
            yield session, writer


def _measured_before(runs: Sequence[Run], kept: int) -> Iterator[list[Measurement]]:
    """The measurements of the frame sets that a run keeps, for its recording; none of no run."""
    if runs:
        from measure.api.reel import Reel

        reel = Reel(runs)
        yield from (reel.measurements(number) for number in range(kept))


def provenance(
    calibration: Path,
    bodies: Sequence[Body],
    profile: Profile,
    registry: Registry,
    *,
    session: str,
    session_digest: str,
    session_name: str,
    notes: tuple[Finding, ...],
    scale_sd: float,
    keep: Keep | None = None,
) -> Provenance:
    """Everything that a run with this profile is made from; see `Provenance`."""
    loaded = {
        stage: registry.find(stage, getattr(profile, stage))
        for stage in ("detector", "triangulator", "solver")
    }
    return Provenance(
        session=session,
        session_digest=session_digest,
        calibration=str(calibration.resolve()),
        calibration_digest=digest([calibration.read_bytes()]),
        body_digest=_body_digest(bodies),
        profile=resolved(profile, registry),
        plugins={stage: f"{one.name} of {one.distribution}" for stage, one in loaded.items()},
        notes=notes,
        session_name=session_name,
        scale_sd=scale_sd,
        keep=keep or "",
    )


def made_from(
    session: Session, profile: Profile, registry: Registry, keep: Keep | None = None
) -> Provenance:
    """Everything that a run of this session with this profile is made from."""
    refused = why_not_kept(len(session.bodies), len(session.cameras)) if keep else ""
    causes = stamp_causes({name: stream.times_s for name, stream in session.streams.items()})
    blamed = [cause.of for cause in causes]
    return provenance(
        session.calibration_path,
        session.bodies,
        profile,
        registry,
        session=str(session.path.resolve()),
        session_digest=session.digest(),
        session_name=session.name,
        notes=(
            *noted("frames", session.notes, code="opened"),
            *(cause.finding for cause in causes),
            *noted("clock", session.clock_notes(blamed), code="stamps"),
            *_without_color(session),
            *noted("cameras", [refused] if keep != "off" else [], code="not-followed"),
        ),
        scale_sd=session.scale_sd,
        keep=keep,
    )


def _writer(session: Session, out: Path, origin: Provenance, options: RunOptions) -> RunWriter:
    return RunWriter(
        out,
        origin,
        session.bodies,
        session.cameras,
        resume=options.resume,
        overwrite=options.overwrite,
        reference=session.reference,
    )


def noted(topic: str, texts: Iterable[str], code: str = "") -> tuple[Finding, ...]:
    """Texts as notes, but for empty ones."""
    return tuple(Finding(Level.NOTE, topic, text, code=code) for text in texts if text)


def _without_color(session: Session) -> list[Finding]:
    """One for each camera whose first pictures have no colour, though they have channels."""
    count = ColorCount()
    with suppress(MeasureError):
        for frame_set in islice(session.frame_sets(1), _FIRST_FRAME_SETS):
            count.add(frame_set)
    return count.findings()


def _body_digest(bodies: Sequence[Body]) -> str:
    """A fingerprint of all that body files say of balls and where they are."""
    described = []
    for body in bodies:
        described += [body.name] if len(bodies) > 1 else []
        described += [f"{ball!r}" for ball in body.balls]
        if body.tolerance_mm:
            described.append(f"{body.tolerance_mm!r}")
        if body.radius_tolerance_mm != USUAL_RADIUS_TOLERANCE_MM:
            described.append(f"radii {body.radius_tolerance_mm!r}")
    return digest([text.encode() for text in described])


def resolved(profile: Profile, registry: Registry) -> Mapping[str, Any]:
    """A profile with the defaults of all its settings written out."""
    settings = {}
    for stage in get_args(Stage):
        name = getattr(profile, stage)
        kind = "tracker" if stage == "tracking" else stage
        config = registry.find(kind, name).plugin.Config
        values = read_settings(config, profile.settings.get(stage, {}), f"{stage} '{name}'")
        settings[stage] = values.model_dump(mode="json")
    return profile.model_dump(exclude={"settings"}) | {"settings": settings}


def _log(
    session: Session,
    out: Path,
    options: RunOptions,
    kept: int,
    total: int,
    note: Callable[[str], None],
) -> RunLog:
    """The recording of a run of this session, its truth and its videos in it."""
    truths, videos = dict[str, Trajectory](), None
    if options.wanted:
        from measure.viewing.recording import passed_videos

        truths = _truths(session)
        videos = passed_videos(session) if options.image_every else None
    return RunLog(
        session.name, session.bodies, session.cameras, out, options, kept, truths, videos, note,
        total,
    )  # fmt: skip


def _recording_due(
    options: RunOptions, out: Path, kept: int, total: int, on_note: Callable[[str], None]
) -> RunOptions:
    """The same, but without a recording where that of a finished run is whole."""
    path = out / "run.rrd"
    if not (kept and options.recording):
        return options
    if kept == total:
        from measure.viewing.recording import is_whole

        if is_whole(path):
            return replace(options, recording=False, connect=None)
    on_note(
        f"{path}: made anew from the tables up to there, without pictures and what was detected "
        "in them"
    )
    return options


def _truths(session: Session) -> dict[str, Trajectory]:
    """By body the true poses that can be read; truth never stops a measurement."""
    out = dict[str, Trajectory]()
    if session.truth_path is None:
        return out
    for body in session.bodies:
        with suppress(MeasureError):
            name = body.name if len(session.bodies) > 1 else None
            out[body.name] = read_trajectory(session.truth_path, body=name)
    return out
