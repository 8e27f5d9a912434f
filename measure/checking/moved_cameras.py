"""Cameras that do not stand where the calibration says: which, how far off, and since when.

A pose from all other cameras predicts where a camera should see the balls. A constant difference is
a calibration that does not fit; a step is a camera that was knocked.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.checking.finding import Finding, Level
from measure.checking.sampled_search import Surveyed
from measure.errors import DegenerateGeometryError
from measure.estimation.pose_fit import Sightings, fit_pose
from measure.model import Body, Camera

_EXTRA_PX = 0.5
_LEAST_STEP_PX, _LEAST_BIAS_PX = 2.5, 3.5
"""Steps are told apart from edges that are a little off; a constant difference is not."""
_LEAST_INSTANTS = 3
_LEAST_SHARE = 0.25
_SIGMAS = 5.0
_ALIKE_PX = 0.7
_FAR_OFF = 6.0


@dataclass(frozen=True)
class Misfit:
    """How one camera differs from what the others predict.

    Attributes:
        camera: its name.
        shift_px: mean length of the difference.
        turn_deg: the turn of the camera that explains it best.
        since_s: when it began; None if it was there from the start.
        instants: how many frame sets it was seen in.
    """

    camera: str
    shift_px: float
    turn_deg: float
    since_s: float | None
    instants: int


@dataclass(frozen=True, eq=False)
class _Differences:
    """One camera's differences over time.

    Attributes:
        times_s: (k,) instants.
        shifts_px: (k, 2) mean difference of its balls.
        turns: (k, 3) least rotation vectors of the camera that explain them, rad.
        unsure_px: standard deviation of what the others predict; cameras that face each other see
            the body's place along their common line badly.
        others_off: how far the others are off among themselves, mean in standard deviations.
    """

    times_s: Floats
    shifts_px: Floats
    turns: Floats
    unsure_px: float
    others_off: float


def camera_misfits(
    surveys: Sequence[Surveyed], body: Body, cameras: Sequence[Camera]
) -> tuple[Misfit, ...]:
    """Find cameras that do not fit, each judged without those before it.

    A camera that is off spoils the pose by which the others are judged, so those seem to be off as
    well. It is taken for the culprit if the others agree best without it, not if it differs most.
    Needs three cameras: of two that disagree nobody can tell which one errs.
    """
    found: list[Misfit] = []
    while len(cameras) - len(found) >= 3:
        out = {misfit.camera for misfit in found}
        rest = [camera for camera in cameras if camera.name not in out]
        judged = [_judged(camera, surveys, body, rest) for camera in rest]
        doubted = [pair for pair in judged if pair is not None]
        if not doubted:
            break
        found.append(min(doubted, key=lambda pair: pair[1])[0])
    return tuple(found)


def misfit_findings(misfits: Collection[Misfit]) -> list[Finding]:
    """One line for each."""
    out = []
    for m in misfits:
        amount = f"{m.shift_px:.1f} px ({m.turn_deg:.2f} deg)"
        if m.since_s is None:
            text = f"{m.camera} sees the balls {amount} from where the others do: calibrate it"
        else:
            text = (
                f"{m.camera} was moved by {amount} at about {m.since_s:.2f} s: "
                "measure up to there, or calibrate it again for the rest"
            )
        out.append(Finding(Level.WRONG, "calibration", text))
    return out


def _judged(
    camera: Camera, surveys: Sequence[Surveyed], body: Body, cameras: Sequence[Camera]
) -> tuple[Misfit, float] | None:
    """How a camera differs, and how badly the others fit without it; None if it does not."""
    differences = _differences(camera, surveys, body, cameras)
    if differences is None:
        return None
    shifts, turns = differences.shifts_px, differences.turns
    split = _step(shifts, differences.unsure_px)
    since = None
    if split is not None:
        since = float(differences.times_s[split])
        shift = shifts[split:].mean(axis=0) - shifts[:split].mean(axis=0)
        turn = turns[split:].mean(axis=0) - turns[:split].mean(axis=0)
    else:
        shift, turn = np.median(shifts, axis=0), np.median(turns, axis=0)
        noise = np.hypot(_spread(shifts) / np.sqrt(len(shifts)), differences.unsure_px)
        if np.linalg.norm(shift) < max(_LEAST_BIAS_PX, _SIGMAS * noise):
            return None
    size, angle = float(np.linalg.norm(shift)), float(np.degrees(np.linalg.norm(turn)))
    return Misfit(camera.name, size, angle, since, len(shifts)), differences.others_off


def _differences(
    camera: Camera, surveys: Sequence[Surveyed], body: Body, cameras: Sequence[Camera]
) -> _Differences | None:
    """Seen minus predicted, instant by instant; None if too few."""
    rows = [_difference(camera, survey, body, cameras) for survey in surveys]
    kept = [row for row in rows if row is not None]
    if len(kept) < max(_LEAST_INSTANTS, _LEAST_SHARE * len(surveys)):
        return None
    times, shifts, turns, unsure, off = zip(*kept, strict=True)
    return _Differences(
        np.array(times),
        np.stack(shifts),
        np.stack(turns),
        float(np.median(unsure)),
        float(np.mean(off)),
    )


def _difference(
    camera: Camera, survey: Surveyed, body: Body, cameras: Sequence[Camera]
) -> tuple[float, Floats, Floats, float, float] | None:
    """A row of `_Differences`; None if too little was seen, or a ball is off by itself."""
    by_name = {c.name: c for c in cameras}
    own = [d for d in survey.nearest if d.camera == camera.name]
    others = [d for d in survey.nearest if d.camera != camera.name and d.camera in by_name]
    if len(own) < 2 or len(others) < 4 or survey.world_from_body is None:
        return None
    try:
        seen = Sightings.of(others, body, by_name, survey.time_s, _EXTRA_PX)
        fit = fit_pose(survey.world_from_body, seen, survey.velocity)
    except DegenerateGeometryError:
        return None
    mine = Sightings.of(own, body, by_name, survey.time_s)
    residuals, by_body, _ = mine.residuals(fit.world_from_body, survey.velocity)
    if not _alike(residuals):
        return None
    _, _, by_pose, _ = camera.project_with_jacobians(fit.world_from_body.apply(mine.points_body))
    # The least turn: half-hidden balls tell nothing of one about the line of sight.
    turn = np.linalg.lstsq(by_pose[:, :, 3:].mean(axis=0), np.median(residuals, axis=0))[0]
    together = by_body.mean(axis=0)
    variance = np.linalg.eigvalsh(together @ fit.covariance @ together.T)[-1]
    off = float(np.mean(np.minimum(np.sqrt(fit.distances), _FAR_OFF)))
    return survey.time_s, np.median(residuals, axis=0), turn, float(np.sqrt(variance)), off


def _alike(residuals: Floats) -> bool:
    """Whether all balls (n, 2) are off in the same way, as a camera that stands wrong makes them.

    One that is half hidden is off by itself.
    """
    middle = residuals.mean(axis=0)
    apart = np.max(np.linalg.norm(residuals - middle, axis=1))
    return bool(apart < _ALIKE_PX + 0.3 * np.linalg.norm(middle))


def _step(shifts: Floats, unsure_px: float) -> int | None:
    """Where a step in (k, 2) is, by least deviations; None if there is none beyond doubt."""
    best: tuple[float, int] | None = None
    for split in range(_LEAST_INSTANTS, len(shifts) - _LEAST_INSTANTS + 1):
        before, after = shifts[:split], shifts[split:]
        left = np.sum(np.abs(before - np.median(before, axis=0)))
        left += np.sum(np.abs(after - np.median(after, axis=0)))
        if best is None or left < best[0]:
            best = (float(left), split)
    if best is None:
        return None
    split = best[1]
    before, after = shifts[:split], shifts[split:]
    step = float(np.linalg.norm(np.median(after, axis=0) - np.median(before, axis=0)))
    noise = np.hypot(_spread(before) / np.sqrt(len(before)), _spread(after) / np.sqrt(len(after)))
    noise = float(np.hypot(noise, unsure_px))
    return split if step > max(_LEAST_STEP_PX, _SIGMAS * noise) else None


def _spread(shifts: Floats) -> float:
    """Robust standard deviation of (k, 2) about their median, with a floor."""
    off = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
    return max(0.1, 1.2 * float(np.median(off)))
