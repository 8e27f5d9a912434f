"""Lenses that nothing is known of: where they start, how free they are, and when they stay open.

The sizes of balls tell their distance only together with the focal length, so a body that stays at
one distance and in the middle of the picture shows hardly anything of it. What a recording tells is
in the covariance of the joint adjustment, and a focal length that is not well known is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from measure.calibration.by_body.linking import Instant, LinkedRig, link
from measure.calibration.refining.freeing import ZOOM_SD, zoom_prior
from measure.calibration.refining.recording import Recording
from measure.errors import CalibrationError
from measure.estimation.focal_length import zoomed
from measure.model import Body, Camera, Intrinsics
from measure.model.camera import USUAL_FOCAL
from measure.processes import Progress, quiet

FOCAL_FACTORS = (1.0, 1.25, 1.55, 0.8, 1.95, 0.65)
"""Of the usual focal length (70 deg of view along the longer side): 94 deg to 39 deg."""
_TRIED = 40  # Instants by which they are distinguished
_ASPECT_SD, _POINT_SD = 0.003, 0.02
"""Standard deviations: of the focal length's two numbers against each other, and of the principal
point, as a share of the longer side."""
_DISTORTION_SD = {4: 0.1, 5: 0.2, 6: 0.002, 7: 0.002, 8: 0.2}
"""Of the distortion coefficients of usual lenses, by their place among the lens parameters."""
LENS_KINDS: tuple[tuple[int, ...], ...] = ((), (4,), (4, 5, 6, 7, 8))
"""Which distortion coefficients are free, from the stiffest lens to the freest."""
_MAX_FOCAL_SD = 0.01  # Focal lengths known worse than this share stay open
_DEPTH_RATIO, _COVERED_SHARE, _TURNED_DEG = 1.5, 0.6, 60.0
"""What a good motion has at least: the farthest over the nearest distance, the share of the
picture's width and height in which balls are seen, and the turn between two poses."""


def usual_lens(size_wh: tuple[int, int]) -> Intrinsics:
    """A lens of the usual focal length, without distortion."""
    width, height = size_wh
    focal = USUAL_FOCAL * max(size_wh)
    matrix = [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]
    return Intrinsics(size_wh, np.array(matrix), np.zeros(5))


def link_by_focal_lengths(
    lenses: Mapping[str, Intrinsics],
    body: Body,
    instants: Sequence[Instant],
    progress: Progress = quiet,
) -> LinkedRig:
    """The cameras linked by the factor of their focal lengths with which most sightings agree.

    The lenses come with the covariance of what is usual. CalibrationError as `link`, by the lenses
    as they are.
    """
    few = [instants[i] for i in np.unique(np.linspace(0, len(instants) - 1, _TRIED).astype(int))]
    tried, failed = list[tuple[int, float]](), None
    for number, factor in enumerate(FOCAL_FACTORS):
        progress(number, len(FOCAL_FACTORS) + 1)
        try:
            linked = link({n: zoomed(lens, factor) for n, lens in lenses.items()}, body, few)
            tried.append((linked.sightings, factor))
        except CalibrationError as problem:
            failed = failed or problem
    if not tried and failed:
        raise failed
    progress(len(FOCAL_FACTORS), len(FOCAL_FACTORS) + 1)
    best = max(tried)[1]
    linked = link({n: zoomed(lens, best) for n, lens in lenses.items()}, body, instants)
    return replace(linked, cameras=tuple(with_lens_kind(c, ()) for c in linked.cameras))


def is_open(lens: Intrinsics) -> bool:
    """Whether of a lens nothing is known but what is usual."""
    focal = lens.matrix[0, 0]
    return lens.covariance is not None and lens.covariance[0, 0] > (ZOOM_SD / 2 * focal) ** 2


def with_lens_kind(camera: Camera, distortion: Sequence[int]) -> Camera:
    """The camera with these distortion coefficients free, and what is usual of its lens."""
    lens = camera.intrinsics
    covariance = zoom_prior(lens, _ASPECT_SD, _POINT_SD * max(lens.size_wh))
    for place in distortion:
        covariance[place, place] = _DISTORTION_SD[place] ** 2
    return replace(camera, intrinsics=replace(lens, covariance=covariance))


def refuse_open(cameras: Sequence[Camera], recording: Recording, most: float = 1.0) -> None:
    """Refuse (CalibrationError) focal lengths that the motion leaves open; say what it lacks.

    `most` says how many times worse than needed they may be known as yet.
    """
    worst = max(cameras, key=_focal_sd)
    if _focal_sd(worst) > most * _MAX_FOCAL_SD:
        raise CalibrationError(
            f"this motion leaves the lenses open: the focal length of {worst.name} is known to "
            f"{_focal_sd(worst):.1%} only, and {_MAX_FOCAL_SD:.0%} is needed: "
            f"{_missing(worst, recording)}; or give the lenses with --lenses"
        )


def motion_lacks(cameras: Sequence[Camera], recording: Recording) -> str:
    """What the motion lacks for the focal length that it leaves open; empty if it leaves none."""
    worst = max(cameras, key=_focal_sd)
    return _missing(worst, recording) if _focal_sd(worst) > _MAX_FOCAL_SD else ""


def _focal_sd(camera: Camera) -> float:
    """The standard deviation of a focal length, as a share of it; 0 if the lens is known."""
    if (covariance := camera.intrinsics.covariance) is None:
        return 0.0
    return float(np.sqrt(covariance[0, 0])) / camera.intrinsics.focal_px


def _missing(camera: Camera, recording: Recording) -> str:
    """What the motion lacks most in a camera, in words."""
    track = recording.tracks[camera.name]
    poses = recording.world_from_body
    far = np.linalg.norm(poses.translation[np.unique(track.frame)] - camera.center, axis=1)
    across = np.ptp(track.pixels, axis=0) / camera.intrinsics.size_wh
    picked = poses[np.unique(np.linspace(0, len(far) - 1, 24).astype(int))]
    turns = np.einsum("aij,bij->ab", picked.rotation, picked.rotation)
    turned = float(np.degrees(np.arccos(np.clip((turns.min() - 1) / 2, -1, 1))))
    nearer = (
        f"wave the body nearer to {camera.name} and farther away (it was {far.min():.0f} to "
        f"{far.max():.0f} mm away)"
    )
    wider = (
        f"wave it through the whole picture of {camera.name} (its balls crossed {across[0]:.0%} "
        f"of the width and {across[1]:.0%} of the height)"
    )
    lacks = [
        ((far.max() / far.min() - 1) / (_DEPTH_RATIO - 1), nearer),
        (float(across.min()) / _COVERED_SHARE, wider),
        (turned / _TURNED_DEG, f"tilt it more (by {turned:.0f} deg at most)"),
    ]
    short = [words for share, words in sorted(lacks) if share < 1]
    return ", and ".join(short) if short else f"wave it for longer before {camera.name}"
