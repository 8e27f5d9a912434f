"""What frame sets measured one after the other show: clocks, sizes, flags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from measure.checking.clocks import CameraClock, estimate_clocks
from measure.checking.finding import Finding, Level
from measure.measuring.body_size import OutlineGrowth, outline_growth, seen_balls
from measure.measuring.measurement import Measurement, Status
from measure.model import Body, Camera, Doubt
from measure.model.doubts import counted

_MAX_FLAGGED_SHARE = 0.2


@dataclass(frozen=True)
class MotionCheck:
    """What the frame sets measured show."""

    clocks: tuple[CameraClock, ...] = ()  # of all cameras; empty if the motion was not measured
    measured: int = 0  # how many frame sets have a pose
    # how many of these are flagged, by the most frequent reasons.
    flags: tuple[tuple[str, int], ...] = ()
    # how much larger than expected the balls' outlines are; None if too few were measured.
    sizes: OutlineGrowth | None = None

    def with_clocks_ahead(self, ahead_s: Mapping[str, float]) -> MotionCheck:
        """The same, of stamps to which so much had been added."""
        clocks = [replace(c, offset_s=c.offset_s + ahead_s.get(c.camera, 0.0)) for c in self.clocks]
        return replace(self, clocks=tuple(clocks))


def check_motion(
    measurements: Sequence[Measurement], body: Body, cameras: Sequence[Camera]
) -> MotionCheck:
    """Compare clocks and sizes over frame sets measured one after the other."""
    posed = [m for m in measurements if m.pose is not None]
    if not measurements:
        return MotionCheck()
    flags = counted(m.pose.flags[:1] for m in posed if m.pose and m.status is Status.FLAGGED)
    return MotionCheck(
        estimate_clocks(posed, body, cameras),
        len(posed),
        tuple(flags.items()),
        outline_growth(seen_balls(posed), body, cameras),
    )


def flag_findings(motion: MotionCheck) -> list[Finding]:
    """A line if many poses are flagged."""
    flagged = sum(count for _, count in motion.flags)
    if not flagged > _MAX_FLAGGED_SHARE * motion.measured:
        return []
    first, measured = motion.flags[0][0], motion.measured
    text = Doubt("poses-flagged", flagged=flagged, measured=measured, first=first)
    return [Finding(Level.WEAK, "poses", text)]
