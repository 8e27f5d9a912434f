"""Cameras that do not stand where the calibration says: which, how far off, and since when.

A pose from all other cameras predicts where a camera should see the balls. A constant difference is
a calibration that does not fit; a step is a camera that was knocked.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.measuring.checks.finding import Finding, Level
from measure.measuring.checks.survey import Surveyed
from measure.measuring.pose_fit import Sightings, fit_pose
from measure.model import Body, Camera

_EXTRA_PX = 0.5
_LEAST_STEP_PX, _LEAST_BIAS_PX = 2.5, 3.5
"""Steps are told apart from edges that are a little off; a constant difference is not."""
_LEAST_INSTANTS = 3
_LEAST_SHARE = 0.25
_SIGMAS = 5.0
_WELL_SEEN = 0.75
_ALIKE_PX = 0.7


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
        turns: (k, 3) rotation vectors of the camera that explain them, rad.
    """

    times_s: Floats
    shifts_px: Floats
    turns: Floats


def camera_misfits(
    surveys: Sequence[Surveyed], body: Body, cameras: Sequence[Camera]
) -> tuple[Misfit, ...]:
    """Find cameras that do not fit, the worst first, each judged without those before it.

    Needs three cameras: of two that disagree nobody can tell which one errs.
    """
    found: list[Misfit] = []
    while len(cameras) - len(found) >= 3:
        out = {misfit.camera for misfit in found}
        rest = [camera for camera in cameras if camera.name not in out]
        candidates = [
            misfit
            for camera in rest
            if (misfit := _misfit(camera, surveys, body, rest)) is not None
        ]
        if not candidates:
            break
        found.append(max(candidates, key=lambda misfit: misfit.shift_px))
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


def _misfit(
    camera: Camera, surveys: Sequence[Surveyed], body: Body, cameras: Sequence[Camera]
) -> Misfit | None:
    differences = _differences(camera, surveys, body, cameras)
    if differences is None:
        return None
    shifts = differences.shifts_px
    split = _step(shifts)
    if split is not None:
        after, before = shifts[split:], shifts[:split]
        turn = differences.turns[split:].mean(axis=0) - differences.turns[:split].mean(axis=0)
        return Misfit(
            camera.name,
            float(np.linalg.norm(after.mean(axis=0) - before.mean(axis=0))),
            float(np.degrees(np.linalg.norm(turn))),
            float(differences.times_s[split]),
            len(shifts),
        )
    middle = np.median(shifts, axis=0)
    if np.linalg.norm(middle) < max(
        _LEAST_BIAS_PX, _SIGMAS * _spread(shifts) / np.sqrt(len(shifts))
    ):
        return None
    turn = np.median(differences.turns, axis=0)
    return Misfit(
        camera.name,
        float(np.linalg.norm(middle)),
        float(np.degrees(np.linalg.norm(turn))),
        None,
        len(shifts),
    )


def _differences(
    camera: Camera, surveys: Sequence[Surveyed], body: Body, cameras: Sequence[Camera]
) -> _Differences | None:
    """Seen minus predicted, instant by instant; None if too few."""
    by_name = {c.name: c for c in cameras}
    times, shifts, turns = [], [], []
    for survey in surveys:
        own = [d for d in survey.nearest if d.camera == camera.name]
        others = [d for d in survey.agreeing if d.camera != camera.name and d.camera in by_name]
        if len(own) < 2 or len(others) < 4 or survey.world_from_body is None:
            continue
        try:
            seen = Sightings.of(others, body, by_name, survey.time_s, _EXTRA_PX)
            pose = fit_pose(survey.world_from_body, seen, survey.velocity).world_from_body
        except DegenerateGeometryError:
            continue
        centers = np.stack(
            [
                pose.perturb(survey.velocity * (d.time_s - survey.time_s)).apply(
                    body.centers[body.index(d.ball)]
                )
                for d in own
            ]
        )
        pixels, _, by_pose, _ = camera.project_with_jacobians(centers)
        residuals = np.stack([d.center_px for d in own]) - pixels
        if not _alike(residuals):
            continue
        turn = np.linalg.lstsq(by_pose[:, :, 3:].reshape(-1, 3), residuals.reshape(-1))[0]
        times.append(survey.time_s)
        shifts.append(np.median(residuals, axis=0))
        turns.append(turn)
    if len(times) < max(_LEAST_INSTANTS, _LEAST_SHARE * len(surveys)):
        return None
    return _Differences(np.array(times), np.stack(shifts), np.stack(turns))


def _alike(residuals: Floats) -> bool:
    """Whether all balls (n, 2) are off in the same way, as a camera that stands wrong makes them.

    One that is half hidden is off by itself.
    """
    middle = residuals.mean(axis=0)
    apart = np.max(np.linalg.norm(residuals - middle, axis=1))
    return bool(apart < _ALIKE_PX + 0.3 * np.linalg.norm(middle))


def _step(shifts: Floats) -> int | None:
    """Where a step in (k, 2) is, by least squares; None if there is none beyond doubt."""
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
    return split if step > max(_LEAST_STEP_PX, _SIGMAS * float(noise)) else None


def _spread(shifts: Floats) -> float:
    """Robust standard deviation of (k, 2) about their median, with a floor."""
    off = np.linalg.norm(shifts - np.median(shifts, axis=0), axis=1)
    return max(0.1, 1.2 * float(np.median(off)))
