"""Checking a recording before it is measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, islice
from pathlib import Path

import numpy as np

from measure.api.checking_files import check_files, clocks_apart, file_findings
from measure.api.measuring import measure_session, search_frame_sets
from measure.api.profiles import build_detectors, load_profile
from measure.api.synchronising import find_offsets, shift_clocks
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
    duplicate_findings,
    expected_accuracy,
    misfit_findings,
    search_sample,
    with_velocities,
    worst_first,
)
from measure.checking.arrangement import arrangement_findings
from measure.checking.body import (
    BodyCheck,
    LocatedBalls,
    body_finding,
    check_body,
    locate_balls,
    size_findings,
    twin_findings,
)
from measure.checking.camera_errors import CameraError
from measure.checking.clocks import CameraClock
from measure.checking.motion import MotionCheck, check_motion, motion_findings, scale_findings
from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.measuring import Measurement, Profile
from measure.processes import Progress, quiet
from measure.session import Session, holds_jpeg, open_session, session_lacks

_REACH_MM = 40.0
_LEAST_NOISE_PX = 0.1
_LARGEST_OFFSET_S = 2.0
_LOOKED_AT_S = 6.0  # How much of each camera is searched for clocks' offsets
_UNCERTAIN_CLOCK_S, _MANY = 0.02, 0.3
"""And share of flagged poses, beyond which cameras may contradict each other."""
_NEAR_S = 0.04  # A clock that is right by the cameras' own motion is right by the poses within this
_BY_MOTION_S = 0.06  # Smaller offsets are left to the poses, which tell them from a turned camera
_FEW, _FAR_S = 0.1, 0.01
"""A clock this far off is set right before it is estimated at last: images are paired anew."""


@dataclass(frozen=True, eq=False)
class SessionCheck:
    """What was found in a recording."""

    session: str
    frame_sets: int
    looked_at: int  # how many of them were searched
    findings: tuple[Finding, ...]
    coverage: tuple[Coverage, ...] = ()
    misfits: tuple[CameraMisfit, ...] = ()  # cameras that do not stand where the calibration says
    # the balls' distances and radii against the body file.
    body: BodyCheck = field(default_factory=BodyCheck)
    clocks: tuple[CameraClock, ...] = ()  # of all cameras; empty if the motion was not measured
    camera_errors: tuple[CameraError, ...] = ()  # whose clock, direction or focal length is off
    scale: float = math.nan  # times as far apart as in the body file the balls are, if known
    scale_sd: float = math.nan
    # (27, 5) expected standard deviations round the place where the body was (see
    # `expected_accuracy`), or None if it was never found.
    accuracy: Floats | None = None

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
    progress: Progress = quiet,
) -> SessionCheck:
    """Find what is wrong or weak in a recording; without a body or a calibration, in its files.

    Args:
        profile: whose detector searches the pictures, and whose stages measure the motion.
        samples: frame sets, spread over the recording, in which all is searched.
        clock_samples: frame sets from the start that are measured to compare the clocks; 0: none.
    """
    if samples < 1 or clock_samples < 0:
        raise ConfigError(
            f"{samples} samples, {clock_samples} clock samples: expected at least 1 and 0"
        )
    given = {"body": body, "calibration": calibration}
    if lacking := [name for name in session_lacks(session_path) if given[name] is None]:
        name, frame_sets, found = check_files(session_path, lacking, progress)
        return SessionCheck(name, frame_sets, frame_sets, found)
    with open_session(session_path, calibration, body, clocks_apart=clock_samples > 0) as session:
        looking = _Looking(
            session, registry, profile or load_profile(), samples, clock_samples, progress
        )
        look = looking.with_clocks_set() if clock_samples else looking.look()
        findings = [*look.pictures, *file_findings(session.streams, session.notes, looking.step)]
        return _concluded(session, look, findings)


def _concluded(session: Session, look: _Look, findings: list[Finding]) -> SessionCheck:
    if session.other_bodies:
        others = ", ".join(body.name for body in session.other_bodies)
        alone = f"checked with '{session.body.name}' alone; with --body FILE also {others}"
        findings.append(Finding(Level.NOTE, "body", alone))
    motion, searched, misfits = look.motion, look.searched, look.misfits
    if look.arrangement:
        findings += look.arrangement
        return SessionCheck(session.name, look.frame_sets, len(searched), worst_first(findings))
    misplaced = misfit_findings(misfits, look.tried_s)
    by_motion = motion_findings(motion, {misfit.camera for misfit in misfits}, look.instead)
    shape = check_body(look.located, session.body)
    cameras_agree = all(f.topic != "calibration" for f in (*misplaced, *by_motion))
    findings += (
        [body_finding(text, Level.WRONG, cameras_agree) for text in shape.findings]
        or scale_findings(motion, cameras_agree)
        # Balls that are larger or smaller than in the file, if cameras can tell.
        or (size_findings(session.body, motion.sizes) if motion.sizes and cameras_agree else [])
    )
    findings += twin_findings(session.body)
    coverage, weak = coverage_findings(searched, session.body, session.cameras, misfits)
    findings += weak + misplaced + by_motion
    return SessionCheck(
        session.name,
        look.frame_sets,
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


@dataclass(frozen=True, eq=False)
class _Look:
    """What one look at a recording has shown."""

    frame_sets: int
    searched: Sequence[SearchSample]
    located: Sequence[LocatedBalls]
    motion: MotionCheck  # of frame sets measured in a row; empty if they were not
    pictures: Sequence[Finding]
    arrangement: Sequence[Finding]  # pictures that are not what their camera sees
    misfits: tuple[CameraMisfit, ...]  # cameras that do not stand where the calibration says
    # by camera, what was added to its stamps before; `motion.clocks` include it.
    ahead_s: Mapping[str, float] = field(default_factory=dict)
    # clocks that did not make the cameras agree.
    tried_s: Mapping[str, float] = field(default_factory=dict)
    # misfits that there were no more when clocks were set right.
    instead: tuple[CameraMisfit, ...] = ()

    @property
    def doubtful(self) -> bool:
        """Whether cameras disagree by so much that a clock may be far off."""
        found = sum(sample.world_from_body is not None for sample in self.searched)
        known = [clock.offset_sd_s < _UNCERTAIN_CLOCK_S for clock in self.motion.clocks]
        return not self.arrangement and (
            bool(self.misfits)
            or 0 < found < len(self.searched) / 2
            or self._flagged_share > _MANY
            or 0 < sum(known) < len(known)
        )

    def agrees_better(self, before: _Look) -> bool:
        """Whether no more cameras misfit than before, and few poses, or half as many, are flagged.

        A clock takes some of the misfit of a camera that is turned: that alone is no reason.
        """
        fewer = self._flagged_share <= max(_FEW, 0.5 * before._flagged_share)
        return fewer and len(self.misfits) <= len(before.misfits)

    @property
    def _flagged_share(self) -> float:
        return sum(n for _, n in self.motion.flags) / max(self.motion.measured, 1)


@dataclass(eq=False)
class _Looking:
    """How a recording is looked at; the arguments of `measure.api.check`."""

    session: Session
    registry: Registry
    profile: Profile
    samples: int
    clock_samples: int
    progress: Progress

    def __post_init__(self) -> None:
        warm_pipeline(self.profile, self.registry, self.session.body, self.session.cameras)
        self._begin()

    def with_clocks_set(self) -> _Look:
        """Look, and where clocks are far off again with them set right.

        Where cameras disagree by much, their own motion is asked for their clocks. Its answer is
        kept if the cameras then agree; else the stamps stay as they are. SessionError: the stamps
        are of two clocks, and the motion does not tell which.
        """
        apart = clocks_apart(self.session.streams)
        look = None if apart else self.look()
        if look is None or look.doubtful:
            given = self.session, self.registry, self.profile
            offsets = find_offsets(*given, _LARGEST_OFFSET_S, _LOOKED_AT_S, self.progress)
            late = {name: off_s for name, off_s in offsets.items() if abs(off_s) > _BY_MOTION_S}
            again = self._look_again(late, look)
            if apart and again is None:
                raise apart
            look = again or replace(look, tried_s=late) if look else again
        assert look is not None
        clocks = [c for c in look.motion.clocks if c.offset_visible]
        rest = {c.camera: c.offset_s - look.ahead_s.get(c.camera, 0.0) for c in clocks}
        far = {n: s for n, s in rest.items() if abs(s) > _FAR_S and n in look.motion.late}
        return self._look_again(far, look) or look

    def _look_again(self, late_s: Mapping[str, float], before: _Look | None) -> _Look | None:
        """A look with clocks set right; None, and undone, if cameras do not agree better then."""
        if not late_s:
            return None
        shift_clocks(self.session, late_s)
        self._begin()
        look = self.look()
        clocks = {c.camera: c for c in look.motion.clocks if c.offset_sd_s < np.inf}
        near = {name for name, clock in clocks.items() if abs(clock.offset_s) < _NEAR_S}
        off, earlier = {m.camera for m in look.misfits}, before.ahead_s if before else {}
        if late_s.keys() <= near - off and (not before or look.agrees_better(before)):
            ahead_s = {n: earlier.get(n, 0.0) + late_s.get(n, 0.0) for n in {*earlier, *late_s}}
            instead = (*before.misfits, *before.instead) if before else ()
            return replace(
                look,
                motion=look.motion.with_clocks_ahead(ahead_s),
                ahead_s=ahead_s,
                instead=tuple(m for m in instead if m.camera in ahead_s),
            )
        shift_clocks(self.session, {name: -late for name, late in late_s.items()})
        return None

    def look(self) -> _Look:
        """Search some frame sets, and measure the first."""
        session = self.session
        searched, located, every = [], [], []
        duplicates, colorless, overexposed = DuplicateCount(), ColorlessCount(), OverexposedCount()
        detectors = build_detectors(self.profile, self.registry, session.body, session.cameras)
        for frame_set, (seen,) in search_frame_sets(session, [detectors], self._chosen):
            searched.append(search_sample(seen, session.body, session.cameras, frame_set.time_s))
            duplicates.add(frame_set)
            colorless.add(frame_set)
            overexposed.add(frame_set, searched[-1].agreeing)
            located.append(locate_balls(seen, session.body, session.cameras))
            every.append(seen)
            self.step()
        arrangement = arrangement_findings(every, searched, session.body, session.cameras)
        motion = MotionCheck() if arrangement else self._motion(searched, duplicates)
        # A late camera sees a moving body elsewhere than the others do: it does not stand there.
        misfits = tuple(
            misfit
            for misfit in camera_misfits(with_velocities(searched), session.body, session.cameras)
            if misfit.since_s is not None or misfit.camera not in motion.late
        )
        pictures = [*self._stalls(duplicates), *duplicates.findings()]
        pictures += colorless.findings() + overexposed.findings()
        return _Look(self._total, searched, located, motion, pictures, arrangement, misfits)

    def step(self) -> None:
        """Count what is done: a frame set, or one damaged picture looked for in all cameras."""
        self.progress(next(self._done), self._steps)

    def _begin(self) -> None:
        self._total = len(self.session.pair().times_s)
        # About `samples` of `total` indices, in pairs of neighbours, which tell speeds.
        firsts = np.linspace(0, max(self._total - 2, 0), max(1, self.samples // 2))
        pairs = {round(float(first)) + k for first in firsts for k in (0, 1)}
        self._chosen = sorted(index for index in pairs if index < self._total)
        jpeg = [len(stream) for stream in self.session.streams.values() if holds_jpeg(stream)]
        measured = min(self.clock_samples, self._total)
        self._steps = len(self._chosen) + measured + max(jpeg, default=0)
        self._done = count(1)

    def _motion(self, searched: Sequence[SearchSample], duplicates: DuplicateCount) -> MotionCheck:
        """Measure frame sets in a row, if the body can be followed at all."""
        session = self.session
        found = sum(sample.world_from_body is not None for sample in searched)
        if not self.clock_samples or found < len(searched) / 2:
            return MotionCheck()
        measured = list[Measurement]()
        frame_sets = measure_session(session, self.profile, self.registry)
        for frame_set, measurement in islice(frame_sets, self.clock_samples):
            duplicates.add(frame_set)
            self.step()
            measured.append(measurement)
        return check_motion(measured, session.body, session.cameras)

    def _stalls(self, passed: DuplicateCount) -> list[Finding]:
        """Pictures that come twice: in all files, or among those of a video that were decoded."""
        out = []
        for name, stream in self.session.streams.items():
            positions, compared = stream.repeated(), len(stream) - 1
            if positions is None:
                again = sorted(passed.repeated.get(name, ()))
                positions = np.nonzero(np.isin(stream.frames, again))[0]
                compared = len(passed.compared.get(name, ()))
            out += duplicate_findings(name, positions, compared, stream.times_s, stream.frames)
        return out
