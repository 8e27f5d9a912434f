"""What frame sets measured one after the other show: clocks, cameras, scale, flags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.checking.body import body_finding
from measure.checking.camera_errors import (
    CameraError,
    Kind,
    camera_errors,
    error_findings,
    rivals_text,
)
from measure.checking.clocks import CameraClock, estimate_clocks, measured_instants
from measure.checking.finding import Finding, Level
from measure.checking.moved_cameras import CameraMisfit
from measure.measuring.ball_radii import OutlineGrowth, outline_growth, seen_balls
from measure.measuring.body_scale import relative_scale
from measure.measuring.measurement import Measurement, Status
from measure.model import Body, Camera

_OFFSET_WORTH_A_LINE_S = 0.0005
_OFFSET_WRONG_S = 0.002
_SCALE_WEAK_SIGMAS, _SCALE_WRONG_SIGMAS = 3.0, 4.0
_MIN_FRAME_SETS = 5
_MAX_FLAGGED_SHARE = 0.2


@dataclass(frozen=True)
class MotionCheck:
    """What the frame sets measured show."""

    clocks: tuple[CameraClock, ...] = ()  # of all cameras; empty if the motion was not measured
    errors: tuple[CameraError, ...] = ()  # of cameras, the most important first
    # how many times as far apart as in the body file the balls are; NaN if unknown.
    scale: float = np.nan
    scale_sd: float = np.nan
    measured: int = 0  # how many frame sets have a pose
    # how many of these are flagged, by the most frequent reasons.
    flags: tuple[tuple[str, int], ...] = ()
    # how much larger than expected the balls' outlines are; None if too few were measured.
    sizes: OutlineGrowth | None = None

    @property
    def late(self) -> set[str]:
        """Names of cameras whose disagreement a clock explains best."""
        return {error.camera for error in self.errors if error.kind is Kind.CLOCK}

    def with_clocks_ahead(self, ahead_s: Mapping[str, float]) -> MotionCheck:
        """The same, of stamps to which so much had been added."""
        clocks = [replace(c, offset_s=c.offset_s + ahead_s.get(c.camera, 0.0)) for c in self.clocks]
        return replace(self, clocks=tuple(clocks))


def check_motion(
    measurements: Sequence[Measurement], body: Body, cameras: Sequence[Camera]
) -> MotionCheck:
    """Compare cameras, clocks and scale over frame sets measured one after the other."""
    posed = [m for m in measurements if m.pose is not None]
    instants = measured_instants(posed, body, cameras)
    flags = Counter(m.pose.flags[0] for m in posed if m.pose and m.status is Status.FLAGGED)
    return MotionCheck(
        estimate_clocks(posed, body, cameras),
        camera_errors(instants, body, cameras),
        *_scale(posed, body),
        len(posed),
        tuple(flags.most_common()),
        outline_growth(seen_balls(posed), body, cameras),
    )


def _scale(posed: Sequence[Measurement], body: Body) -> tuple[float, float]:
    """Median over the frame sets; their errors are alike, so its deviation is one frame set's."""
    found = [relative_scale(m.pose, m.positions, body) for m in posed if m.pose is not None]
    known = np.array([one for one in found if one is not None]).reshape(-1, 2)
    if len(known) < _MIN_FRAME_SETS:
        return np.nan, np.nan
    off, variance = np.median(known, axis=0)
    return float(1 + off), float(np.sqrt(variance))


def motion_findings(
    motion: MotionCheck, misplaced: Collection[str], instead: Collection[CameraMisfit]
) -> list[Finding]:
    """One line for every clock and camera that is off, but for cameras known to be `misplaced`.

    Those of `instead` seemed to stand elsewhere until their clocks were set right.
    """
    errors = [error for error in motion.errors if error.camera not in misplaced]
    findings = error_findings(errors)
    blamed = {*misplaced, *(e.camera for e in errors if e.kind is not Kind.CLOCK)}
    late = {e.camera: rivals_text(e) for e in errors if e.kind is Kind.CLOCK}
    late |= {
        m.camera: f" (else the camera seems to be {m.shift_px:.1f} px off its place)"
        for m in instead
    }
    # Where a camera stands elsewhere, clocks seem to differ: only what is left then counts.
    clocks = [c for c in motion.clocks if not blamed or c.camera in late.keys() - blamed]
    findings += _clock_findings(clocks, late)
    flagged = sum(count for _, count in motion.flags)
    if flagged > _MAX_FLAGGED_SHARE * motion.measured:
        text = (
            f"{flagged} of {motion.measured} poses measured in a row are flagged, "
            f"first of all: {motion.flags[0][0]}"
        )
        findings.append(Finding(Level.WEAK, "poses", text))
    return findings


def scale_findings(motion: MotionCheck, cameras_agree: bool) -> list[Finding]:
    """A line if the balls are not as far apart as the body file says."""
    off = abs(motion.scale - 1) / motion.scale_sd
    if not off > _SCALE_WEAK_SIGMAS:
        return []
    text = (
        f"the balls are {motion.scale:.4f} +- {motion.scale_sd:.4f} times as far apart as the body "
        "file says: the body file or the scale of the calibration is off, and poses with it; "
        "callipers on two balls tell which"
    )
    level = Level.WRONG if off > _SCALE_WRONG_SIGMAS else Level.WEAK
    return [body_finding(text, level, cameras_agree)]


def _clock_findings(clocks: Sequence[CameraClock], rivals: Mapping[str, str]) -> list[Finding]:
    """A line for every clock that is off and every shutter that rolls."""
    out = []
    for clock in clocks:
        sd = 1e3 * clock.offset_sd_s
        if clock.offset_visible and abs(clock.offset_s) > _OFFSET_WORTH_A_LINE_S:
            level = Level.WRONG if abs(clock.offset_s) > _OFFSET_WRONG_S else Level.WEAK
            text = (
                f"{clock.camera}: the clock is {1e3 * clock.offset_s:+.1f} +- {sd:.1f} ms off the "
                f"others: add {clock.offset_s:+.4f} to its time_offset_s in session.toml"
                f"{rivals.get(clock.camera, '')}"
            )
            out.append(Finding(level, "clock", text))
        if clock.rolling:
            text = (
                f"{clock.camera}: its shutter rolls, {1e3 * clock.readout_s:.1f} +- "
                f"{1e3 * clock.readout_sd_s:.1f} ms from the first row to the last"
            )
            out.append(Finding(Level.WEAK, "clock", text))
    return out
