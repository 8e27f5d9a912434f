"""A measured recording as bundle adjustment needs it: sightings, poses, and the way between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.lens import stack
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.measuring import Measurement
from measure.model import BallView, Body, Detection
from measure.model.observations import Reason

MIN_FRAMES = 10
_HARDLY_EVER = 0.2
"""A camera that agrees in a smaller share of the frame sets is not refined but refused."""
_WINDOW = 9
_DEGREE = 4
_LEAST_SPREAD_MM = 20.0
_DOUBTFUL_SHARE = 0.2
_ELSEWHERE = (Reason.INCONSISTENT, Reason.JUMPED, Reason.RECOVERING)
_DOUBTED = (Reason.INCONSISTENT, Reason.JUMPED)
"""Why views of the right ball are left out if the calibration is off: they can put it right."""


@dataclass(frozen=True, eq=False)
class Track:
    """What one camera saw of the moving body.

    Attributes:
        frame: (n,) number of the frame set in `Recording.times_s`.
        ball: (n,) index of the ball.
        pixels: (n, 2) projections of ball centres.
        covariance: (n, 2, 2) of those.
        lead_s: (n,) time of the picture after the frame set's.
    """

    frame: Ints
    ball: Ints
    pixels: Floats
    covariance: Floats
    lead_s: Floats


@dataclass(frozen=True, eq=False)
class Recording:
    """A measured recording as bundle adjustment needs it.

    Attributes:
        times_s: (f,) of the frame sets, increasing.
        world_from_body: batch of (f,) measured poses.
        tracks: by camera name.
    """

    times_s: Floats
    world_from_body: RigidTransform
    tracks: dict[str, Track]

    def part(self, start: int, stop: int) -> Recording:
        """Only the frame sets from `start` up to `stop`."""
        tracks = {}
        for name, track in self.tracks.items():
            keep = (track.frame >= start) & (track.frame < stop)
            tracks[name] = Track(
                track.frame[keep] - start,
                track.ball[keep],
                track.pixels[keep],
                track.covariance[keep],
                track.lead_s[keep],
            )
        return Recording(self.times_s[start:stop], self.world_from_body[start:stop], tracks)


def calibration_doubted(measurements: Sequence[Measurement]) -> bool:
    """Whether the cameras disagree so much that good views were set aside, or poses flagged."""
    flagged = [m.pose is None or bool(m.pose.flags) for m in measurements]
    if np.mean(flagged) > _DOUBTFUL_SHARE:
        return True
    aside: dict[str, list[bool]] = {}
    for m in measurements:
        for view in m.views:
            if view.detection is not None:
                aside.setdefault(view.camera, []).append(view.reason is Reason.INCONSISTENT)
    return any(np.mean(views) > _DOUBTFUL_SHARE for views in aside.values())


def recording_of(
    measurements: Sequence[Measurement],
    body: Body,
    lead_s: Callable[[Detection], float] | None = None,
    limit: int = 1500,
    doubted: bool = False,
) -> Recording:
    """Collect the poses and effective detections of measured frame sets.

    Args:
        measurements: of one session; those without a pose are passed over.
        body: the body.
        lead_s: what to add to the time of a detection, if the clocks are known to be off.
        limit: most frame sets to keep: the first ones, because motion needs neighbours.
        doubted: take flagged poses too, and views that disagree with the other cameras: for a first
            rough refinement of cameras too far off to agree.

    Raises:
        CalibrationError: too few frame sets with a pose, the body hardly moved, or a camera sees
            the balls where the others do not.
    """
    kept = [m for m in measurements if m.pose is not None and (doubted or not m.pose.flags)]
    if len(kept) < MIN_FRAMES:
        raise CalibrationError(
            f"{len(kept)} frame sets with {'a' if doubted else 'an unflagged'} pose, at least "
            f"{MIN_FRAMES} are needed to refine cameras from motion{_most_aside(measurements)}"
        )
    _refuse_strangers(kept, doubted)
    kept = kept[:limit]
    poses = stack([m.pose.world_from_body for m in kept if m.pose is not None])
    spread = float(np.linalg.norm(np.ptp(poses.translation, axis=0)))
    if spread < _LEAST_SPREAD_MM:
        raise CalibrationError(
            f"the body moved {spread:.1f} mm only: carry it through the whole workspace"
        )
    return Recording(
        np.array([m.time_s for m in kept]), poses, _tracks(kept, body, lead_s, doubted)
    )


def _refuse_strangers(kept: Sequence[Measurement], doubted: bool) -> None:
    """Refuse a camera that sees balls, but hardly ever where the others do."""
    for name, aside in _aside(kept).items():
        agreeing = sum(
            any(view.camera == name and _usable(view, doubted) for view in m.views) for m in kept
        )
        if aside >= MIN_FRAMES and agreeing < _HARDLY_EVER * (agreeing + aside):
            raise CalibrationError(
                f"camera {name} sees the balls elsewhere than the others in {aside} of {len(kept)} "
                "frame sets: it does not stand where the first calibration says; if it was moved "
                "since, calibrate it again"
            )


def _aside(measurements: Sequence[Measurement]) -> dict[str, int]:
    """In how many frame sets each camera sees balls, but none where the others do."""
    out: dict[str, int] = {}
    for m in measurements:
        for name in dict.fromkeys(view.camera for view in m.views):
            own = [view for view in m.views if view.camera == name]
            elsewhere = any(view.reason in _ELSEWHERE for view in own)
            out[name] = out.get(name, 0) + (elsewhere and not any(v.effective for v in own))
    return out


def _most_aside(measurements: Sequence[Measurement]) -> str:
    """The camera that contradicts the others most often, in words."""
    aside = _aside(measurements)
    if not any(aside.values()):
        return "; `measure check` names a camera that was moved"
    name = max(aside, key=lambda camera: aside[camera])
    return (
        f"; camera {name} sees the balls elsewhere than the others in {aside[name]} of "
        f"{len(measurements)}: if it was moved, calibrate it again"
    )


def _usable(view: BallView, doubted: bool) -> bool:
    if view.detection is None:
        return False
    return view.effective or (doubted and view.reason in _DOUBTED)


def _tracks(
    kept: Sequence[Measurement],
    body: Body,
    lead_s: Callable[[Detection], float] | None,
    doubted: bool,
) -> dict[str, Track]:
    rows: dict[str, list[tuple[int, int, Floats, Floats, float]]] = {}
    for number, m in enumerate(kept):
        for view in m.views:
            d = view.detection
            if d is None or not _usable(view, doubted):
                continue
            lead = d.time_s - m.time_s + (0.0 if lead_s is None else lead_s(d))
            rows.setdefault(d.camera, []).append(
                (number, body.index(d.ball), d.center_px, d.covariance_px, lead)
            )
    return {
        name: Track(
            np.array([r[0] for r in seen], dtype=np.int64),
            np.array([r[1] for r in seen], dtype=np.int64),
            np.stack([r[2] for r in seen]),
            np.stack([r[3] for r in seen]),
            np.array([r[4] for r in seen]),
        )
        for name, seen in rows.items()
    }


class Motion:
    """Where each ball is a little before or after its frame set's instant.

    A polynomial through the nine nearest frame sets: it smooths, so that the noise of one pose does
    not come back through the neighbours' motion. Its coefficients are in the body's axes, so that
    it turns with the body when the whole world is turned: held in the world's, it would speak
    against every such turn, from noise alone.
    """

    def __init__(self, times_s: Floats, poses: RigidTransform, centers: Floats) -> None:
        points = ball_places(poses, centers).reshape(len(times_s), -1)
        window, operator = _polynomials(times_s)
        near = points[window].reshape(len(times_s), window.shape[1], -1)
        in_world = (operator @ near).reshape(len(times_s), -1, len(centers), 3)
        self._coefficients = np.einsum("fpkj,fji->fpki", in_world, poses.rotation)

    def at(self, frame: Ints, ball: Ints, lead_s: Floats) -> tuple[Floats, Floats]:
        """Way of each ball from its frame set's instant, and its velocity there.

        Returns:
            Both (n, 3), in the axes of the body at the frame set's instant.
        """
        slopes = self._coefficients[frame, 1:, ball]
        powers = np.arange(1, slopes.shape[1] + 1)
        way = lead_s[:, None] ** powers
        rate = powers * lead_s[:, None] ** (powers - 1)
        return np.einsum("np,npi->ni", way, slopes), np.einsum("np,npi->ni", rate, slopes)


def _polynomials(times_s: Floats) -> tuple[Ints, Floats]:
    """Windows (f, w) of frame sets, and operators (f, d + 1, w) from values to coefficients."""
    count = len(times_s)
    width = min(_WINDOW, count)
    first = np.clip(np.arange(count) - width // 2, 0, count - width)
    window = first[:, None] + np.arange(width)
    offset = times_s[window] - times_s[:, None]
    scale = np.abs(offset).max(axis=1)
    powers = np.arange(_DEGREE + 1)
    vandermonde = (offset / scale[:, None])[:, :, None] ** powers
    return window, np.linalg.pinv(vandermonde) / scale[:, None, None] ** powers[:, None]


def ball_places(poses: RigidTransform, centers: Floats) -> Floats:
    """All ball centres at all instants (f * k, 3) in the world."""
    points = np.einsum("fij,kj->fki", poses.rotation, centers) + poses.translation[:, None]
    return points.reshape(-1, 3)
