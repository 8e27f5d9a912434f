"""Checking a recording before it is measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, islice
from pathlib import Path

import numpy as np

from measure.api.checking_channels import channel_causes
from measure.api.checking_files import check_files, clocks_apart, file_findings
from measure.api.measuring import measure_session, search_frame_sets
from measure.api.profiles import DEFAULT_PROFILE, build_detectors, load_profile
from measure.api.synchronising import find_offsets, shift_clocks
from measure.api.warming_up import warm_pipeline
from measure.arrays import Floats
from measure.checking import (
    ColorCount,
    Coverage,
    DuplicateCount,
    ExposureCount,
    Finding,
    Level,
    SearchSample,
    coverage_findings,
    expected_accuracy,
    repeated_causes,
    search_sample,
    worst_first,
)
from measure.checking.arrangement import arrangement_causes
from measure.checking.body import BodyCheck, check_body, locate_balls, size_causes, twin_findings
from measure.checking.causes import ALL, Cause, Word, beside, with_weak
from measure.checking.clocks import CameraClock
from measure.checking.coverage import disagreeing_causes
from measure.checking.diagnosis import Diagnosis, clock_cause, diagnose_recording
from measure.checking.evidence import Evidence
from measure.checking.motion import MotionCheck, check_motion, flag_findings
from measure.checking.pictures import gaps_alone, smear_causes, stamp_causes, woven_causes
from measure.checking.search import loose_sample
from measure.checking.sightings import evidence_of
from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.measuring import Measurement, Profile
from measure.measuring.image_faults import BallSteps, SmearedImages, WovenImages
from measure.model import Detection, Doubt
from measure.processes import Progress, quiet
from measure.session import Session, holds_jpeg, open_session, read_calibration, session_lacks

_REACH_MM = 40.0
_LEAST_NOISE_PX = 0.1
_LARGEST_OFFSET_S = 2.0
_LOOKED_AT_S = 6.0  # How much of each camera is searched for clocks' offsets
_BY_MOTION_S = 0.06  # Smaller offsets are left to the poses, which tell them from a turned camera
_FAR_S = 0.01
"""A clock this far off is set right before it is estimated at last: images are paired anew."""


@dataclass(frozen=True, eq=False)
class SessionCheck:
    """What was found in a recording."""

    session: str
    frame_sets: int
    looked_at: int  # how many of them were searched
    findings: tuple[Finding, ...]  # the likeliest cause first; behind the causes what else shows
    coverage: tuple[Coverage, ...] = ()
    causes: tuple[Cause, ...] = ()  # what may be wrong with the rig, the likeliest first
    # the balls' distances and radii against the body file.
    body: BodyCheck = field(default_factory=BodyCheck)
    clocks: tuple[CameraClock, ...] = ()  # of all cameras; empty if the motion was not measured
    # (27, 5) expected standard deviations round the place where the body was (see
    # `expected_accuracy`), or None if it was never found.
    accuracy: Floats | None = None

    @property
    def believable(self) -> bool:
        """Whether nothing was found that spoils results."""
        return all(finding.level is not Level.WRONG for finding in self.findings)


def check(
    session: Path,
    registry: Registry,
    profile: Profile | str = DEFAULT_PROFILE,
    calibration: Path | None = None,
    body: Path | None = None,
    samples: int = 24,
    clock_samples: int = 120,
    progress: Progress = quiet,
) -> SessionCheck:
    """Find faults of a session before you measure it.

    Looks for dropped frames, pictures that come twice or are damaged, uneven stamps, clocks that
    differ, a shutter that rolls, a body file that does not match, cameras that were moved or are
    calibrated badly, balls that are seldom seen; and says how accurate the set-up can be. Without a
    body or a calibration only the files are looked at.

    The command's exit code is 3 if anything is wrong.

    Args:
        session: the session's folder; it is only read.
        profile: `precise`, or the path of a profile of your own (.toml).
        calibration: a calibration to use instead of the session's.
        body: a body file to use instead of the session's.
        samples: frame sets, spread over the recording, in which everything is searched.
        clock_samples: frame sets measured to compare the clocks; 0 leaves the clocks out.
    """
    if samples < 1 or clock_samples < 0:
        raise ConfigError(
            f"{samples} samples, {clock_samples} clock samples: expected at least 1 and 0"
        )
    given = {"body": body, "calibration": calibration}
    if lacking := [name for name in session_lacks(session) if given[name] is None]:
        name, frame_sets, found = check_files(session, lacking, progress)
        return SessionCheck(name, frame_sets, frame_sets, found)
    with open_session(session, calibration, body, clocks_apart=clock_samples > 0) as opened:
        looking = Looking(opened, registry, load_profile(profile), samples, clock_samples, progress)
        look = looking.with_clocks_set() if clock_samples else looking.look()
        findings = [*look.pictures, *file_findings(opened.streams, opened.notes, looking.step)]
        return _concluded(opened, look, findings)


def _concluded(session: Session, look: Look, findings: list[Finding]) -> SessionCheck:
    if session.other_bodies:
        others = ", ".join(body.name for body in session.other_bodies)
        alone = Doubt("checked-alone", name=session.body.name, others=others)
        findings.append(Finding(Level.NOTE, "body", alone))
    motion, searched, causes = look.motion, look.searched, look.causes
    if causes and causes[0].cause in _FIRST_OF_ALL:
        reported = (*(cause.finding for cause in causes), *worst_first(findings))
        return SessionCheck(session.name, look.frame_sets, len(searched), reported, causes=causes)
    true_colors = not any(cause.cause is Word.EXPOSURE for cause in causes)
    coverage, weak = coverage_findings(
        searched, session.body, session.cameras, look.shape.distances, true_colors
    )
    findings += [*twin_findings(session.body), *weak, *flag_findings(motion)]
    return SessionCheck(
        session.name,
        look.frame_sets,
        len(searched),
        (*(cause.finding for cause in causes), *worst_first(findings)),
        coverage,
        causes,
        look.shape,
        motion.clocks,
        _accuracy(session, searched),
    )


def _together(
    pictures: Sequence[Cause],
    diagnosis: Diagnosis,
    shape: Sequence[Cause],
    searched: Sequence[SearchSample],
    sized: Sequence[Cause],
) -> list[Cause]:
    """Causes from all sources, the most certain first; what another explains is left out."""
    if file := [c for c in shape if c.cause in _FILE]:
        return beside(pictures, file)  # poses rest on those balls alone that fit the file
    known = [c for c in diagnosis.causes if c.cause is not Word.UNKNOWN and c.explains > _MOST]
    blamed = {cause.of for cause in known}
    elsewhere = [c for c in disagreeing_causes(searched) if not blamed & {ALL, c.of}]
    rest = [*elsewhere, *diagnosis.causes]
    if not known:
        shape = () if diagnosis.fits else shape  # two colours on one ball are two balls to it
        rest = elsewhere or list(shape) or list(diagnosis.causes) or list(sized)
    return beside(pictures, rest)


def _seen(searched: Sequence[SearchSample]) -> int:
    """How many sightings of balls agree with a pose."""
    return sum(len(sample.agreeing) for sample in searched)


_FILE = {Word.EXCHANGED_BALLS, Word.MIRRORED}
"""What the balls' distances alone say of the body file, and no fit of its pose."""
_BETTER = 1.5  # Times as many sightings make another search accepted
_MOST = 0.5  # Share of what is seen that a cause explains, from which it needs no second opinion
_FIRST_OF_ALL = (Word.EXCHANGED_CAMERAS, Word.MIRRORED, Word.EXCHANGED_CHANNELS)
"""Pictures that are not what their camera sees: nothing else is judged before."""


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
class Look:
    """What one look at a recording has shown."""

    frame_sets: int
    searched: Sequence[SearchSample]
    shape: BodyCheck  # the balls located against the body file
    motion: MotionCheck  # of frame sets measured in a row; empty if they were not
    pictures: Sequence[Finding]
    causes: tuple[Cause, ...]
    diagnosis: Diagnosis
    measured: Sequence[Measurement] = ()
    # what was seen of the body, where its pose is known; None if it never is.
    evidence: Evidence | None = None
    # by camera, what was added to its stamps before.
    ahead_s: Mapping[str, float] = field(default_factory=dict)
    as_stamped: Look | None = None  # the look before that, if there was one

    @property
    def doubtful(self) -> bool:
        """Whether a clock may be so far off that poses cannot tell."""
        first = self.causes[:1]
        explained = any(
            c.cause in (*_FIRST_OF_ALL, Word.SAME_PICTURES) or c.unit == "%" for c in first
        )
        return not explained and (
            0 < self.posed < len(self.searched) / 2 or self.diagnosis.unexplained
        )

    @property
    def late_s(self) -> dict[str, float]:
        """What the cameras' motion says is to be added to their stamps, where it is much."""
        clocks = [c for c in self.causes if c.cause is Word.CLOCK and c.unit == "ms"]
        found = {cause.of: 1e-3 * (cause.estimate or 0.0) for cause in clocks}
        return {name: off_s for name, off_s in found.items() if abs(off_s) > _FAR_S}

    def agrees_better(self, before: Look) -> bool:
        """Whether cameras agree as they are now at least as with all causes of before allowed."""
        left = max(2.0 * before.diagnosis.left, 0.5 * before.diagnosis.misfit)
        return self.posed >= before.posed and self.diagnosis.misfit <= left

    @property
    def posed(self) -> int:
        """In how many frame sets looked at the body was found."""
        return sum(sample.world_from_body is not None for sample in self.searched)


@dataclass(eq=False)
class Looking:
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

    def with_clocks_set(self) -> Look:
        """Look, and where clocks are far off again with them set right.

        Where cameras disagree by much, their own motion is asked for their clocks. Its answer is
        kept if the cameras then agree; else the stamps stay as they are. SessionError: the stamps
        are of two clocks, and the motion does not tell which.
        """
        apart = clocks_apart(self.session.streams)
        look = None if apart else self.look()
        if look is None or look.doubtful:
            offsets = find_offsets(
                self.session,
                self.registry,
                self.profile,
                _LARGEST_OFFSET_S,
                _LOOKED_AT_S,
                self.progress,
            )
            late = {name: off_s for name, off_s in offsets.items() if abs(off_s) > _BY_MOTION_S}
            again = self._look_again(late, look)
            if apart and again is None:
                raise apart
            look = again or look
        assert look is not None
        return self._look_again(look.late_s, look) or look

    def _look_again(self, late_s: Mapping[str, float], before: Look | None) -> Look | None:
        """A look with clocks set right; None, and undone, if cameras do not agree better then."""
        if not late_s:
            return None
        shift_clocks(self.session, late_s)
        self._begin()
        look = self.look()
        if not look.late_s.keys() & late_s.keys() and (not before or look.agrees_better(before)):
            earlier = before.ahead_s if before else {}
            ahead_s = {n: earlier.get(n, 0.0) + late_s.get(n, 0.0) for n in {*earlier, *late_s}}
            clocks = {clock.camera: clock for clock in look.motion.clocks}
            late = [clock_cause(name, off_s, clocks.get(name)) for name, off_s in ahead_s.items()]
            rest = [cause for cause in look.causes if cause.cause is not Word.CLOCK]
            motion = look.motion.with_clocks_ahead(ahead_s)
            as_stamped = before and (before.as_stamped or before)
            return replace(
                look, motion=motion, ahead_s=ahead_s, causes=(*late, *rest), as_stamped=as_stamped
            )
        shift_clocks(self.session, {name: -late for name, late in late_s.items()})
        return None

    def look(self) -> Look:
        """Search some frame sets, and measure the first."""
        session = self.session
        searched, every = list[SearchSample](), list[Mapping[str, Sequence[Detection]]]()
        numbers = list[dict[str, int]]()
        duplicates, colors, overexposed = DuplicateCount(), ColorCount(), ExposureCount()
        steps, woven, smeared = BallSteps(), WovenImages(), SmearedImages()
        detectors = build_detectors(self.profile, self.registry, session.body, session.cameras)
        for frame_set, (found,) in search_frame_sets(session, [detectors], self._chosen):
            numbers.append({name: image.frame for name, image in frame_set.images.items()})
            old = self._repeated_in(numbers[-1], duplicates)
            seen = {name: own for name, own in found.items() if name not in old}
            searched.append(search_sample(seen, session.body, session.cameras, frame_set.time_s))
            duplicates.add(frame_set)
            colors.add(frame_set)
            overexposed.add(frame_set, searched[-1].agreeing)
            stepped = steps.of(frame_set, searched[-1].agreeing, look=True)
            woven.add(stepped)
            smeared.add(stepped)
            every.append(seen)
            self.step()
        self._leave_out(searched, every, [duplicates.copying(searched)] * len(searched))
        times_s = {name: s.times_s for name, s in session.streams.items()}
        causes = [
            *duplicates.causes(),
            *stamp_causes(times_s),
            *arrangement_causes(every, searched, session.body, session.cameras),
            *woven_causes(woven.cameras, len(session.cameras)),
            *smear_causes(smeared.smear, len(session.cameras)),
        ]
        causes += channel_causes(session, detectors, searched, every, self._chosen) * (not causes)
        certain = any(cause.cause in _FIRST_OF_ALL for cause in causes)
        measured = [] if certain else self._measured(searched, duplicates)
        self._leave_out(searched, every, [self._repeated_in(own, duplicates) for own in numbers])
        every = [
            seen if one.reflection is None else one.reflection.left_out_of(seen)
            for seen, one in zip(every, searched, strict=True)
        ]
        body, cameras = session.body, session.cameras
        shape = check_body([locate_balls(seen, body, cameras) for seen in every], body)
        motion, diagnosis = MotionCheck(), Diagnosis()
        if not certain:
            motion = check_motion(measured, body, cameras)
            diagnosis = self._diagnosed(searched, every, measured, shape)
            sized = size_causes(body, motion.sizes) if motion.sizes else []
            causes = _together(causes, diagnosis, [*shape.causes], searched, sized)
        causes = with_weak(
            causes, [*self._stalls(duplicates), *overexposed.causes(), *colors.causes()]
        )
        pictures = colors.findings()
        evidence = diagnosis.evidence or evidence_of(searched, every, measured, body, cameras)
        return Look(
            self._total, searched, shape, motion, pictures, tuple(causes), diagnosis, measured,
            evidence,
        )  # fmt: skip

    def _repeated_in(self, numbers: Mapping[str, int], duplicates: DuplicateCount) -> set[str]:
        """Cameras whose image of a frame set, by its number, is known to repeat the one before."""
        return {
            name
            for name, number in numbers.items()
            if number in self._again[name] or number in duplicates.repeated.get(name, ())
        }

    def _leave_out(
        self,
        searched: list[SearchSample],
        every: list[Mapping[str, Sequence[Detection]]],
        cameras: Sequence[set[str]],
    ) -> None:
        """Search again where cameras, by frame set, show what is not theirs or not of then."""
        for k, out in enumerate(cameras):
            left = {name: own for name, own in every[k].items() if name not in out}
            if len(left) < len(every[k]):
                sample = search_sample(
                    left, self.session.body, self.session.cameras, searched[k].time_s
                )
                every[k], searched[k] = left, sample

    def _diagnosed(
        self,
        searched: Sequence[SearchSample],
        found: Sequence[Mapping[str, Sequence[Detection]]],
        measured: Sequence[Measurement],
        shape: BodyCheck,
    ) -> Diagnosis:
        body, cameras, loose = self.session.body, self.session.cameras, False
        # As large as it looks the body is found, though the file or the calibration errs; and where
        # cameras stand far from where they should, if rays need not meet.
        ways = [(search_sample, shape.factor)] if shape.factor else []
        if _seen(searched) < len(searched) and not _FILE & {cause.cause for cause in shape.causes}:
            ways.append((loose_sample, 1.0))
        for search, factor in ways:
            grown = body.with_centers(factor * body.centers)
            grown = grown.with_radii(factor * body.radii, body.radius_covariance)
            again = [
                search(one, grown, cameras, sample.time_s)
                for one, sample in zip(found, searched, strict=True)
            ]
            if _seen(again) > _BETTER * _seen(searched):
                searched, measured, loose = again, (), search is loose_sample
                break
        gaps_s = gaps_alone({name: s.times_s for name, s in self.session.streams.items()})
        diagnosis = diagnose_recording(
            (searched, found), measured, body, cameras, gaps_s, squares=self._squares
        )
        # Rays that need not meet may also be of other things than the body.
        return Diagnosis() if loose and diagnosis.unexplained else diagnosis

    @cached_property
    def _squares(self) -> bool:
        """Whether a board gave the calibration its scale."""
        return "board" in str(read_calibration(self.session.calibration_path).provenance)

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

    def _measured(
        self, searched: Sequence[SearchSample], duplicates: DuplicateCount
    ) -> list[Measurement]:
        """Frame sets measured in a row, if the body can be followed at all."""
        session = self.session
        found = sum(sample.world_from_body is not None for sample in searched)
        measured = list[Measurement]()
        if not self.clock_samples or found < len(searched) / 2:
            return measured
        frame_sets = measure_session(session, self.profile, self.registry)
        for frame_set, measurement in islice(frame_sets, self.clock_samples):
            duplicates.add(frame_set)
            duplicates.leave_out(frame_set, measurement.repeated)
            self.step()
            measured.append(measurement)
        return measured

    @cached_property
    def _again(self) -> dict[str, set[int]]:
        """By camera, the numbers of images whose files hold the content of the one before."""
        out = dict[str, set[int]]()
        for name, stream in self.session.streams.items():
            again = stream.repeated()
            out[name] = set() if again is None else {*stream.frames[again].tolist()}
        return out

    def _stalls(self, passed: DuplicateCount) -> list[Cause]:
        """Pictures that come twice: in all files, or among those that were decoded in a row."""
        out = []
        for name, stream in self.session.streams.items():
            again = {*self._again[name], *passed.repeated.get(name, ())}
            positions = np.nonzero(np.isin(stream.frames, sorted(again)))[0]
            whole = stream.repeated() is not None
            compared = len(stream) - 1 if whole else len(passed.compared.get(name, ()))
            out += repeated_causes(name, positions, compared, stream.times_s, stream.frames)
        return out
