"""A measured recording for bundle adjustment: observations, poses, and the motion between."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.limits import FEWEST
from measure.measuring import Measurement
from measure.model import BallView, Body, Detection
from measure.model.observations import Reason

_MOST_FRAMES = 1500  # The first ones are kept, because motion needs neighbours
_MIN_AGREEING_SHARE = 0.2
"""A camera that agrees in a smaller share of the frame sets is not refined but refused."""
_WINDOW_FRAMES = 9
_POLYNOMIAL_DEGREE = 4
_GAP_STEPS = 3.0  # Times the usual step, over which no polynomial reaches
MIN_MOTION_MM = 20.0
_DOUBTFUL_SHARE = 0.2
_DISAGREEING = (Reason.INCONSISTENT, Reason.JUMPED, Reason.RECOVERING)
_CALIBRATION_MAY_CAUSE = (Reason.INCONSISTENT, Reason.JUMPED)
"""Why views of the right ball are left out if the calibration is off: they can put it right."""


@dataclass(frozen=True, eq=False)
class Track:
    """What one camera saw of the moving body."""

    frame: Ints  # (n,) number of the frame set in `Recording.times_s`
    ball: Ints  # (n,) index of the ball
    pixels: Floats  # (n, 2) projections of ball centres
    covariance: Floats  # (n, 2, 2) of those
    lead_s: Floats  # (n,) time of the picture after the frame set's


@dataclass(frozen=True, eq=False)
class Recording:
    """A measured recording as bundle adjustment needs it."""

    times_s: Floats  # (f,) of the frame sets, increasing
    world_from_body: RigidTransform  # batch of (f,) measured poses
    tracks: dict[str, Track]

    def part(self, start: int, stop: int) -> Recording:
        """Only the frame sets from `start` up to `stop`."""
        tracks = {}
        for name, track in self.tracks.items():
            keep = (track.frame >= start) & (track.frame < stop)
            own = {field.name: getattr(track, field.name)[keep] for field in fields(track)}
            tracks[name] = Track(**own | {"frame": own["frame"] - start})
        return Recording(self.times_s[start:stop], self.world_from_body[start:stop], tracks)


def calibration_disagrees(measurements: Sequence[Measurement]) -> bool:
    """Whether the cameras disagree so much that good views were suspended, or poses flagged."""
    flagged = [m.pose is None or bool(m.pose.flags) for m in measurements]
    if np.mean(flagged) > _DOUBTFUL_SHARE:
        return True
    inconsistent: dict[str, list[bool]] = {}
    for m in measurements:
        for view in m.views:
            if view.detection is not None:
                inconsistent.setdefault(view.camera, []).append(view.reason is Reason.INCONSISTENT)
    return any(np.mean(views) > _DOUBTFUL_SHARE for views in inconsistent.values())


def recording_of(
    measurements: Sequence[Measurement],
    body: Body,
    lead_s: Callable[[Detection], float] | None = None,
    doubtful_too: bool = False,
    least_motion_mm: float = MIN_MOTION_MM,
) -> Recording:
    """Collect the poses and effective detections of measured frame sets.

    `lead_s` is added to the time of a detection, if the clocks are known to be off; `doubtful_too`
    takes flagged poses and inconsistent views too, for a first rough refinement. CalibrationError:
    too few frame sets with a pose, the body hardly moved, or a camera sees the balls where the
    others do not.
    """
    kept = [m for m in measurements if m.pose is not None and (doubtful_too or not m.pose.flags)]
    if len(kept) < FEWEST:
        raise CalibrationError(
            f"{len(kept)} of {len(measurements)} frame sets have "
            f"{'a' if doubtful_too else 'an unflagged'} pose, and at least {FEWEST} are needed"
            f"{_why_few(measurements, len(kept))}"
        )
    _refuse_disagreeing(kept, doubtful_too)
    kept = [m for m in kept if _fixes_its_pose(m, doubtful_too)][:_MOST_FRAMES]
    if len(kept) < FEWEST:
        raise CalibrationError(
            f"in {len(kept)} frame sets three balls are seen as they should be, and at least "
            f"{FEWEST} are needed"
        )
    poses = RigidTransform.stack([m.pose.world_from_body for m in kept if m.pose is not None])
    refuse_rest(poses, least_motion_mm)
    return Recording(
        np.array([m.time_s for m in kept]), poses, _tracks(kept, body, lead_s, doubtful_too)
    )


def refuse_rest(world_from_body: RigidTransform, least_motion_mm: float) -> None:
    """Refuse (CalibrationError) a body that hardly moved."""
    spread = float(np.linalg.norm(np.ptp(world_from_body.translation, axis=0)))
    if spread < least_motion_mm:
        raise CalibrationError(
            f"the body moved {spread:.1f} mm only: carry it through the whole workspace"
        )


def _refuse_disagreeing(kept: Sequence[Measurement], doubtful_too: bool) -> None:
    """Refuse a camera that sees balls, but hardly ever where the others do."""
    for name, apart in _disagreements(kept).items():
        agreeing = sum(
            any(view.camera == name and _usable(view, doubtful_too) for view in m.views)
            for m in kept
        )
        if apart >= FEWEST and agreeing < _MIN_AGREEING_SHARE * (agreeing + apart):
            raise CalibrationError(
                f"camera {name} sees the balls elsewhere than the others in {apart} of {len(kept)} "
                "frame sets: it does not stand where the first calibration says; if it was moved "
                "since, calibrate it again"
            )


def _disagreements(measurements: Sequence[Measurement]) -> dict[str, int]:
    """In how many frame sets each camera sees balls, but none where the others do."""
    out: dict[str, int] = {}
    for m in measurements:
        for name in dict.fromkeys(view.camera for view in m.views):
            own = [view for view in m.views if view.camera == name]
            elsewhere = any(view.reason in _DISAGREEING for view in own)
            out[name] = out.get(name, 0) + (elsewhere and not any(v.effective for v in own))
    return out


def _why_few(measurements: Sequence[Measurement], kept: int) -> str:
    """A short recording, or the camera that contradicts the others most often, in words."""
    if kept > (1 - _DOUBTFUL_SHARE) * len(measurements):
        return ": record for longer"
    apart = _disagreements(measurements)
    if not any(apart.values()):
        return "; `measure check` names a camera that was moved"
    name = max(apart, key=lambda camera: apart[camera])
    return (
        f"; camera {name} sees the balls elsewhere than the others in {apart[name]} of "
        f"{len(measurements)}: if it was moved, calibrate it again"
    )


def _fixes_its_pose(measured: Measurement, doubtful_too: bool) -> bool:
    """Whether three balls are seen: the turn about a line through two of them stays open."""
    return len({v.ball for v in measured.views if _usable(v, doubtful_too)}) > 2


def _usable(view: BallView, doubtful_too: bool) -> bool:
    if view.detection is None:
        return False
    return view.effective or (doubtful_too and view.reason in _CALIBRATION_MAY_CAUSE)


def _tracks(
    kept: Sequence[Measurement],
    body: Body,
    lead_s: Callable[[Detection], float] | None,
    doubtful_too: bool,
) -> dict[str, Track]:
    return tracks_of(
        [
            (number, d, d.time_s - m.time_s + (0.0 if lead_s is None else lead_s(d)))
            for number, m in enumerate(kept)
            for view in m.views
            if (d := view.detection) is not None and _usable(view, doubtful_too)
        ],
        body,
    )


def tracks_of(seen: Iterable[tuple[int, Detection, float]], body: Body) -> dict[str, Track]:
    """By camera, what was seen: numbers of frame sets, detections, and how much later, s."""
    rows: dict[str, list[tuple[int, int, Floats, Floats, float]]] = {}
    for number, d, lead_s in seen:
        row = number, body.index(d.ball), d.center_px, d.covariance_px, lead_s
        rows.setdefault(d.camera, []).append(row)
    return {n: Track(*map(np.array, zip(*own, strict=True))) for n, own in rows.items()}


class BallMotion:
    """Position of each ball shortly before or after its frame set's instant.

    A polynomial fitted to the nine nearest frame sets. Its coefficients are in the body's axes:
    rotations of the whole world leave it unchanged, and so are not penalised.
    """

    def __init__(self, times_s: Floats, poses: RigidTransform, centers: Floats) -> None:
        points = ball_places(poses, centers).reshape(len(times_s), -1)
        window, operator = _polynomials(times_s)
        near = points[window].reshape(len(times_s), window.shape[1], -1)
        in_world = (operator @ near).reshape(len(times_s), -1, len(centers), 3)
        self._coefficients = np.einsum("fpkj,fji->fpki", in_world, poses.rotation)

    def at(self, frame: Ints, ball: Ints, lead_s: Floats) -> tuple[Floats, Floats]:
        """Way and velocity (n, 3) of each ball from its frame set's instant, in the body's axes."""
        slopes = self._coefficients[frame, 1:, ball]
        powers = np.arange(1, slopes.shape[1] + 1)
        way = lead_s[:, None] ** powers
        rate = powers * lead_s[:, None] ** (powers - 1)
        return np.einsum("np,npi->ni", way, slopes), np.einsum("np,npi->ni", rate, slopes)


def _polynomials(times_s: Floats) -> tuple[Ints, Floats]:
    """Windows (f, w) of frame sets, and operators (f, d + 1, w) from values to coefficients.

    Those behind a gap do not count, and as few coefficients are left as there are frame sets.
    """
    count = len(times_s)
    width = min(_WINDOW_FRAMES, count)
    first = np.clip(np.arange(count) - width // 2, 0, count - width)
    window = first[:, None] + np.arange(width)
    steps_s = np.diff(times_s)
    stretch = np.concatenate([[0], np.cumsum(steps_s > _GAP_STEPS * np.median(steps_s))])
    together = stretch[window] == stretch[:, None]
    offset = np.where(together, times_s[window] - times_s[:, None], 0.0)
    scale = np.abs(offset).max(axis=1)
    scale[scale == 0] = 1.0
    powers = np.arange(_POLYNOMIAL_DEGREE + 1)
    vandermonde = (offset / scale[:, None])[:, :, None] ** powers * together[:, :, None]
    vandermonde *= powers < together.sum(axis=1)[:, None, None]
    return window, np.linalg.pinv(vandermonde) / scale[:, None, None] ** powers[:, None]


def ball_places(poses: RigidTransform, centers: Floats) -> Floats:
    """All ball centres at all instants (f * k, 3) in the world."""
    points = np.einsum("fij,kj->fki", poses.rotation, centers) + poses.translation[:, None]
    return points.reshape(-1, 3)
