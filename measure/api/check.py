"""Checking a recording before it is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from measure.api.measuring import measure_session
from measure.api.profiles import load_profile
from measure.api.warming_up import warm_pipeline
from measure.arrays import Floats
from measure.checking import (
    CameraMisfit,
    ColorlessCount,
    Coverage,
    DuplicateCount,
    Finding,
    Level,
    OverexposedCount,
    SearchSample,
    camera_misfits,
    coverage_findings,
    damage_findings,
    duplicate_findings,
    expected_accuracy,
    misfit_findings,
    search_sample,
    stamp_findings,
    with_velocities,
    worst_first,
)
from measure.checking.body import BodyCheck, LocatedBalls, check_body, locate_balls
from measure.checking.body_explanations import size_findings, twin_findings
from measure.checking.camera_errors import CameraError
from measure.checking.clocks import CameraClock
from measure.checking.motion import MotionCheck, check_motion, motion_findings, scale_findings
from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.measuring import Measurement, Profile
from measure.processes import Progress
from measure.session import Session, damaged_frames, holds_jpeg, open_session

if TYPE_CHECKING:
    from measure.model import Body, Detection, FrameSet

_REACH_MM = 40.0
_LEAST_NOISE_PX = 0.1


@dataclass(frozen=True, eq=False)
class SessionCheck:
    """What was found in a recording.

    Attributes:
        session: its name.
        frame_sets: how many it has.
        looked_at: how many of them were searched.
        findings: the worst first.
        coverage: who saw which ball how often.
        misfits: cameras that do not stand where the calibration says.
        body: the balls' distances and radii against the body file.
        clocks: of all cameras; empty if the motion was not measured.
        camera_errors: cameras whose clock, direction or focal length is off.
        scale: how many times as far apart as in the body file the balls are; NaN if unknown.
        scale_sd: its standard deviation.
        accuracy: (27, 5) expected standard deviations round the place where the body was (see
            `expected_accuracy`), or None if it was never found.
    """

    session: str
    frame_sets: int
    looked_at: int
    findings: tuple[Finding, ...]
    coverage: tuple[Coverage, ...]
    misfits: tuple[CameraMisfit, ...]
    body: BodyCheck
    clocks: tuple[CameraClock, ...]
    camera_errors: tuple[CameraError, ...]
    scale: float
    scale_sd: float
    accuracy: Floats | None

    @property
    def believable(self) -> bool:
        """Whether nothing was found that spoils results."""
        return all(finding.level is not Level.WRONG for finding in self.findings)


def check(
    session_path: Path,
    registry: Registry,
    profile: Profile | None = None,
    calibration: Path | None = None,
    body: Path | None = None,
    samples: int = 24,
    clock_samples: int = 120,
    progress: Progress | None = None,
) -> SessionCheck:
    """Find what is wrong or weak in a recording.

    Args:
        session_path: the session's folder, which is only read.
        registry: where the plugins come from.
        profile: whose detector searches the pictures, and whose stages measure the motion.
        calibration: a calibration file to use instead of the session's own.
        body: a body file to use instead of the session's own.
        samples: frame sets, spread over the recording, in which all is searched.
        clock_samples: frame sets from the start that are measured to compare the clocks; 0: none.
        progress: called with how many frame sets are done, and of how many.

    Raises:
        MeasureError: the recording cannot be opened or read at all, or no samples.
    """
    if samples < 1 or clock_samples < 0:
        raise ConfigError(
            f"{samples} samples, {clock_samples} clock samples: expected at least 1 and 0"
        )
    profile = profile or load_profile()
    with open_session(session_path, calibration, body) as session:
        total = len(session.pair().times_s)
        chosen = _spread_pairs(total, samples)
        warm_pipeline(profile, registry, session.body, session.cameras)
        searched, located, duplicates, colorless = [], [], DuplicateCount(), ColorlessCount()
        overexposed = OverexposedCount()
        jpeg = [stream for stream in session.streams.values() if holds_jpeg(stream)]
        longest = max(map(len, jpeg), default=0)
        step = _steps(progress, len(chosen) + min(clock_samples, total) + longest)
        for frame_set, seen in _search(session, chosen, registry, profile):
            searched.append(search_sample(seen, session.body, session.cameras, frame_set.time_s))
            duplicates.add(frame_set)
            colorless.add(frame_set)
            overexposed.add(frame_set, searched[-1].agreeing)
            located.append(locate_balls(seen, session.body, session.cameras))
            step()
        motion = _motion(session, searched, registry, profile, clock_samples, duplicates, step)
        pictures = _stalls(session, duplicates) + colorless.findings() + overexposed.findings()
        for name, frames in damaged_frames(jpeg, step).items():
            pictures += damage_findings(name, frames, len(session.streams[name]))
        return _concluded(session, total, searched, located, motion, pictures)


def _steps(progress: Progress | None, total: int) -> Callable[[], None]:
    """A function to call after every frame set."""
    done = count(1)

    def step() -> None:
        if progress is not None:
            progress(next(done), total)

    return step


def _spread_pairs(total: int, samples: int) -> list[int]:
    """About `samples` of `total` indices, in pairs of neighbours, which tell speeds."""
    firsts = np.linspace(0, max(total - 2, 0), max(1, samples // 2))
    pairs = {round(float(first)) + k for first in firsts for k in (0, 1)}
    return sorted(index for index in pairs if index < total)


def _search(
    session: Session, chosen: Sequence[int], registry: Registry, profile: Profile
) -> Iterator[tuple[FrameSet, Mapping[str, Sequence[Detection]]]]:
    """Search whole pictures of some frame sets, the cameras side by side."""
    settings = profile.settings.get("detector", {})
    detectors = {
        c.name: registry.detector(profile.detector, settings, session.body, c)
        for c in session.cameras
    }
    with ThreadPoolExecutor(len(detectors)) as pool:
        for index in chosen:
            frame_set = next(iter(session.frame_sets(start=index, prefetch=1)))
            names = list(frame_set.images)
            found = pool.map(lambda n, f=frame_set: detectors[n].detect(f.images[n], ()), names)
            yield frame_set, dict(zip(names, found, strict=True))


def _motion(
    session: Session,
    searched: Sequence[SearchSample],
    registry: Registry,
    profile: Profile,
    samples: int,
    duplicates: DuplicateCount,
    step: Callable[[], None],
) -> MotionCheck:
    """Measure frame sets in a row, if the body can be followed at all."""
    found = sum(sample.world_from_body is not None for sample in searched)
    if not samples or found < len(searched) / 2:
        return MotionCheck()
    measured = list[Measurement]()
    for frame_set, measurement in islice(measure_session(session, profile, registry), samples):
        duplicates.add(frame_set)
        step()
        measured.append(measurement)
    return check_motion(measured, session.body, session.cameras)


def _stalls(session: Session, passed: DuplicateCount) -> list[Finding]:
    """Pictures that come twice: in all files, or among those of a video that were decoded."""
    out = []
    for name, stream in session.streams.items():
        positions, compared = stream.repeated(), len(stream) - 1
        if positions is None:
            again = sorted(passed.repeated.get(name, ()))
            positions = np.nonzero(np.isin(stream.frames, again))[0]
            compared = len(passed.compared.get(name, ()))
        out += duplicate_findings(name, positions, compared, stream.times_s, stream.frames)
    return out


def _concluded(
    session: Session,
    total: int,
    searched: Sequence[SearchSample],
    located: Sequence[LocatedBalls],
    motion: MotionCheck,
    pictures: list[Finding],
) -> SessionCheck:
    findings = pictures + [Finding(Level.NOTE, "frames", note) for note in session.notes]
    findings += [Finding(Level.WRONG, "clock", text) for text in session.clock_notes()]
    for stream in session.streams.values():
        findings += stamp_findings(stream.name, stream.times_s, stream.frames)
    # A late camera sees a moving body elsewhere than the others do: it does not stand elsewhere.
    misfits = tuple(
        misfit
        for misfit in camera_misfits(with_velocities(searched), session.body, session.cameras)
        if misfit.since_s is not None or misfit.camera not in motion.late
    )
    misplaced = misfit_findings(misfits)
    by_motion = motion_findings(motion, {misfit.camera for misfit in misfits})
    shape = check_body(located, session.body)
    cameras_agree = all(f.topic != "calibration" for f in (*misplaced, *by_motion))
    findings += (
        _body_findings(shape, cameras_agree)
        or scale_findings(motion, cameras_agree)
        or _size_findings(session.body, motion, cameras_agree)
    )
    findings += twin_findings(session.body)
    coverage, weak = coverage_findings(searched, session.body, session.cameras, misfits)
    findings += weak + misplaced + by_motion
    return SessionCheck(
        session.name,
        total,
        len(searched),
        worst_first(findings),
        coverage,
        misfits,
        shape,
        motion.clocks,
        motion.errors,
        motion.scale,
        motion.scale_sd,
        _accuracy(session, searched),
    )


def _body_findings(shape: BodyCheck, cameras_agree: bool) -> list[Finding]:
    """What is wrong with the body; only weak where cameras do not stand as they should."""
    if cameras_agree:
        return [Finding(Level.WRONG, "body", text) for text in shape.findings]
    doubt = "measured with cameras that do not agree: calibrate them first"
    return [Finding(Level.WEAK, "body", f"{text} ({doubt})") for text in shape.findings]


def _size_findings(body: Body, motion: MotionCheck, cameras_agree: bool) -> list[Finding]:
    """Balls that are larger or smaller than in the file, if cameras can tell."""
    if motion.sizes is None or not cameras_agree:
        return []
    return size_findings(body, motion.sizes)


def _accuracy(session: Session, searched: Sequence[SearchSample]) -> Floats | None:
    poses = [s.world_from_body for s in searched if s.world_from_body is not None]
    if not poses:
        return None
    place = np.median([pose.translation for pose in poses], axis=0)
    turn = poses[len(poses) // 2].rotation
    noise = [d.variance_px2 for s in searched for d in s.agreeing]
    noise_px = float(np.hypot(_LEAST_NOISE_PX, np.sqrt(np.median(noise))))
    return expected_accuracy(
        RigidTransform(turn, place), _REACH_MM, session.body, session.cameras, noise_px
    )
