"""`contours`: one pose fitted to every outline point of every ball in every camera.

A ball seen by one camera counts, and each picture counts at its own time. Every view has an unknown
edge offset (the visible edge of a glossy ball lies inside its outline), and every ball-view random
effects (shift and growth of its outline) whose variance is estimated from the residuals: that, not
pixel noise, limits the pose and determines its covariance. Outlines whose edges scatter more have
effects of larger variance, and outlying effects smaller weights (Student's t).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import median_high, median_low
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import ConfigError, DegenerateGeometryError
from measure.estimation.multiview import calibration_noise
from measure.geometry import RigidTransform, align_points
from measure.host import PoseSolver, Settings, hookimpl, setting
from measure.model import BallPosition, Body, Camera, Detection, Intrinsics, Motion, Pose, Rig
from measure.model.doubts import Doubt
from measure.model.observations import stacked_detections, stacked_positions

if TYPE_CHECKING:
    from measure_plugins._joint_fit.outlines import BallRows, PackedOutlines
    from measure_plugins._joint_fit.solve import JointFit


@dataclass(frozen=True, eq=False)
class BallViewNames:
    """Which balls in which cameras k ball-views show; the same from frame set to frame set."""

    balls: tuple[str, ...]  # (k,) names
    ball_of: Ints  # (k,) the balls' places in the body
    shown: tuple[str, ...]  # the balls' names, each once, in the order of the body
    seen_by: tuple[str, ...]  # (c,) names of the cameras, sorted
    cameras: tuple[Camera, ...]  # (c,) the same
    rig: Rig  # (c,) the same, stacked
    rows: BallRows


class NamedOutlines(NamedTuple):
    """The outlines of one frame set with the names of their balls and cameras."""

    packed: PackedOutlines  # k ball-views in c views, of a body at rest
    detections: tuple[Detection, ...]  # (k,) they come from
    named: BallViewNames
    instants: set[float]

    def moved(self, motion: Motion, time_s: float) -> Floats:
        """How far (k, 6) the body has moved in each picture from where it is at `time_s`."""
        times = np.array([d.time_s for d in self.detections])
        return motion.moved(times) - motion.moved(time_s)

    def center_by_size(self, i: int) -> Floats | None:
        """World centre (3,) of a ball from the size and place of ball-view i."""
        from measure.geometry import fit_cone

        points, packed = self.packed.points(i), self.packed
        try:
            cone = fit_cone(packed.rays[:3, points].T, packed.sharpness[points] ** 2)
        except DegenerateGeometryError:
            return None
        camera = self.named.cameras[self.packed.view_of[i]]
        return camera.world_from_camera.apply(cone.center(float(self.packed.radii[i])))


def outlines_of(
    detections: Sequence[Detection], body: Body, cameras: Mapping[str, Camera]
) -> NamedOutlines | None:
    """The outlines of detections, ready for the fit; None if they have none."""
    seen = [d for d in detections if d.outline_px is not None and d.outline_sd_px is not None]
    return _packed(tuple(seen), body, tuple([cameras[d.camera] for d in seen]))


@lru_cache(maxsize=16)
def _packed(
    seen: tuple[Detection, ...], body: Body, cameras: tuple[Camera, ...]
) -> NamedOutlines | None:
    """Kept: the same detections (compared by identity) are solved again with a better motion."""
    from measure_plugins._joint_fit.outlines import pack

    if not seen:
        return None
    named = _named(tuple([d.ball for d in seen]), body, cameras)
    points = [d.outline_px for d in seen if d.outline_px is not None]
    sd = [d.outline_sd_px for d in seen if d.outline_sd_px is not None]
    covariances = stacked_detections(seen)[1]
    packed, kept = pack(points, sd, covariances, named.rows)
    if len(kept) < len(seen):
        return _packed(tuple(seen[i] for i in kept), body, tuple(cameras[i] for i in kept))
    return NamedOutlines(packed, seen, named, {d.time_s for d in seen})


@lru_cache(maxsize=64)
def _named(balls: tuple[str, ...], body: Body, cameras: tuple[Camera, ...]) -> BallViewNames:
    """Of k ball-views; bodies and cameras compare by identity."""
    from measure_plugins._joint_fit.outlines import BallRows

    used = {camera.name: camera for camera in cameras}
    names = tuple(sorted(used))
    own = tuple(used[name] for name in names)
    ball_of = np.array([body.index(name) for name in balls])
    view_of = np.array([names.index(camera.name) for camera in cameras])
    rig, inward = Rig.of(own), [camera.camera_from_world for camera in own]
    rows = BallRows(
        view_of,
        body.centers[ball_of],
        body.radii[ball_of],
        rig.rows.lenses,
        np.array([into.rotation for into in inward], order="C"),
        np.stack([into.translation for into in inward]),
    )
    shown = tuple(name for name in body.names if name in balls)
    return BallViewNames(balls, ball_of, shown, names, own, rig, rows)


_MAX_EFFECT_SQUARE = 13.8
"""Squared Mahalanobis distance of a shift beyond which it is flagged: exceeded by 1 in 1000
(chi-square, 2 degrees of freedom)."""
_ENOUGH_OTHERS = 2
"""Balls in its camera, and cameras with its ball, less than half as far off, beside which a single
ball-view that is off is none of the rig's errors."""
_OUTLINE_SHARES = np.array([3.0, 3.0, 2.0]) / 16
"""Shares of the variance of a ball's surface, half oval (spherical harmonics of degree 2) and half
three-lobed (degree 3), that shift an outline to x and y and let it grow. See
docs/explanation/joint_fit.md, formula 23."""


class ContoursConfig(Settings):
    """Settings of the `contours` solver."""

    min_points: int = setting(30, "Fewest outline points, over all views.", ge=10)
    max_shift_px: float = setting(
        1.5,
        "A ball-view whose outline sits further off, and more than it may by its own and its "
        "camera's covariance and the body's tolerance, is flagged.",
        unit="px",
        gt=0,
    )
    max_growth_px: float = setting(
        0.4,
        "A pose whose outlines lie further outside or inside than the balls' radii put them, in "
        "more than half of the cameras, is flagged.",
        unit="px",
        gt=0,
    )
    max_position_sd_mm: float = setting(
        2.0, "A pose known no better than this is flagged.", unit="mm", gt=0
    )
    max_rotation_sd_deg: float = setting(
        3.0, "A pose whose rotation is known no better than this is flagged.", unit="deg", gt=0
    )


class ContoursSolver(PoseSolver):
    """Joint fit of the pose to all outlines."""

    name = "contours"
    requires_outlines = True
    Config = ContoursConfig
    config: ContoursConfig

    def warm_up(self) -> None:
        """Compile the joint fit (seconds, once per machine), by fitting a pose to circles."""
        camera, turns = _camera_for_warming_up(), np.linspace(0, 6, 12)
        circle = 50.0 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        seen = [
            Detection(
                ball.name,
                camera.name,
                0.0,
                np.zeros(2),
                50.0,
                np.eye(2),
                outline_px=circle + 200.0 * i,
                outline_sd_px=np.ones(12),
            )
            for i, ball in enumerate(self.body.balls)
        ]
        self.solve([], seen, {camera.name: camera}, 0.0, None)

    def solve(
        self,
        positions: Sequence[BallPosition],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body from its outlines; None if they (and the prior) leave it open.

        Raises:
            ConfigError: the detector measures no outlines.
        """
        outlines = outlines_of(detections, self.body, cameras)
        if outlines is None and detections:
            raise ConfigError(
                "solver 'contours' fits outlines, and this detector measures none: take another "
                "solver with it (--solver kabsch)"
            )
        if outlines is None or len(outlines.packed.sharpness) < self.config.min_points:
            return None
        start = self._start(positions, outlines, time_s, prior)
        information = _prior_information(prior, len(outlines.named.shown))
        if start is None or information is None:
            return None
        view_noise = calibration_noise(outlines.named.rig, start.apply(self.body.middle))
        fit = self._fit(outlines, start, information, prior, time_s, view_noise)
        if not fit.found.solved:
            return None
        placed = self.body.centers_of([position.ball for position in positions])
        pose = RigidTransform(fit.found.rotation, fit.found.translation)
        off_mm = stacked_positions(tuple(positions))[0] - pose.apply(placed)
        return Pose(
            time_s=time_s,
            world_from_body=pose,
            covariance=fit.covariance,
            residual_mm=math.sqrt(np.sum(off_mm**2) / len(off_mm)) if positions else math.nan,
            rms_px=fit.rms_px,
            cameras=outlines.named.seen_by,
            balls=outlines.named.shown,
            flags=self._flags(fit, outlines, view_noise),
            by_camera=dict(zip(outlines.named.rig.names, fit.by_camera, strict=True)),
        )

    def _fit(
        self,
        outlines: NamedOutlines,
        start: RigidTransform,
        information: Floats,
        prior: Motion | None,
        time_s: float,
        view_noise: Floats,
    ) -> JointFit:
        """The joint fit at `time_s`, each image at its own time where the motion is known."""
        from measure_plugins._joint_fit.solve import Start, UncertainBalls, solve_outlines

        named, packed = outlines.named, outlines.packed
        if prior is not None and outlines.instants != {time_s}:
            packed = packed._replace(motion=outlines.moved(prior, time_s))
        return solve_outlines(
            packed,
            # Arrays laid out otherwise would be compiled for once more.
            Start(*map(np.ascontiguousarray, (start.rotation, start.translation, information))),
            named.ball_of,
            UncertainBalls(
                self.body.radius_covariance, self.body.radius_tolerance_mm**2 * _OUTLINE_SHARES
            ),
            named.rig.rows,
            view_noise,
            _small_sample(2 * len(named.balls) - 6),
        )

    def _start(
        self,
        positions: Sequence[BallPosition],
        outlines: NamedOutlines,
        time_s: float,
        prior: Motion | None,
    ) -> RigidTransform | None:
        """The prior, or the body laid on its positions, or on where the outlines' sizes put it."""
        if prior is not None:
            return prior.at(time_s)
        located = {position.ball: position.center for position in positions}
        for i, name in enumerate(outlines.named.balls):
            if name not in located and (center := outlines.center_by_size(i)) is not None:
                located[name] = center
        if len(located) < 3:
            return None
        source = self.body.centers_of(list(located))
        try:
            return align_points(np.stack(list(located.values())), source)
        except DegenerateGeometryError:
            return None

    def _off_the_fit(
        self, fit: JointFit, outlines: NamedOutlines, view_noise: Floats
    ) -> Iterator[str]:
        """Ball-views beside their places; not a single one that all others leave alone.

        What shifts one ball in one picture is in that picture: an error of a camera or of the body
        shifts others too. It counts little in the fit, whose covariance has grown by it.
        """
        off, view = np.hypot(*fit.found.effects_px[:, :2].T), outlines.packed.view_of
        beyond = list[int]()
        for k in np.flatnonzero(off > self.config.max_shift_px).tolist():
            seen, (right, down, _) = outlines.detections[k], fit.found.effects_px[k].tolist()
            px_per_mm = seen.radius_px / self.body.radii[self.body.index(seen.ball)]
            own_px = self.body.tolerance_mm * px_per_mm
            stated = seen.covariance_px + view_noise[view[k]] + own_px**2 * np.eye(2)
            if _beyond(stated, right, down):
                beyond.append(k)
        if len(beyond) == 1:
            near, ball_of = off < off[beyond[0]] / 2, outlines.named.ball_of
            alike = (near & (view == view[beyond[0]]), near & (ball_of == ball_of[beyond[0]]))
            if min(np.count_nonzero(one) for one in alike) >= _ENOUGH_OTHERS:
                return
        for k in beyond:
            seen = outlines.detections[k]
            yield Doubt("off-the-fit", ball=seen.ball, camera=seen.camera, off_px=off[k])

    def _flags(self, fit: JointFit, outlines: NamedOutlines, view_noise: Floats) -> tuple[str, ...]:
        flags = list(self._off_the_fit(fit, outlines, view_noise))
        balls, offsets = len(outlines.named.shown), fit.found.offsets_px.tolist()
        # What more than half of the views agree on: of two, the one that is less off.
        growth = max(median_low(offsets), 0.0) + min(median_high(offsets), 0.0)
        if balls < 3:
            flags.append(Doubt("part-predicted", balls=balls))
        if len(outlines.named.seen_by) < 2:
            flags.append(Doubt("depth-by-size"))
        elif abs(growth) > self.config.max_growth_px:
            side = "outside" if growth > 0 else "inside"
            flags.append(Doubt("outlines", off_px=abs(growth), side=side))
        if not fit.found.converged:
            flags.append(Doubt("unsettled"))
        variances = fit.covariance.diagonal().tolist()
        position = math.sqrt(sum(variances[:3]))
        rotation = math.degrees(math.sqrt(sum(variances[3:])))
        if position > self.config.max_position_sd_mm or rotation > self.config.max_rotation_sd_deg:
            flags.append(Doubt("poorly-determined", sd_mm=position, sd_deg=rotation))
        return tuple(flags)


def _beyond(covariance: Floats, right: float, down: float) -> bool:
    """Whether a shift in px is implausibly large under its covariance (2, 2), px^2."""
    (xx, xy), (_, yy) = covariance.tolist()
    square = yy * right**2 - 2 * xy * right * down + xx * down**2
    return bool(square > _MAX_EFFECT_SQUARE * (xx * yy - xy**2))


@lru_cache(maxsize=64)
def _prior_information(prior: Motion | None, balls: int) -> Floats | None:
    """Information (6, 6) of the prior: none of three balls or more, which determine the pose.

    None if there are fewer, and no prior.
    """
    if balls >= 3:
        return np.zeros((6, 6))
    if prior is None or prior.covariance is None:
        return None
    return np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)


def _small_sample(degrees: int) -> float:
    """Factor by which the 95 % ellipsoid holds 95 % though its scale is estimated.

    The quantile of F(6, `degrees`) instead of chi-square's; below four degrees of freedom the
    estimate of the scale is worth next to nothing, and the factor stays. See
    docs/explanation/joint_fit.md, formula 16.
    """
    from scipy.special import chdtri, fdtri

    return float(6 * fdtri(6, max(degrees, 4), 0.95) / chdtri(6, 0.05))


def _camera_for_warming_up() -> Camera:
    matrix = np.array([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]])
    return Camera("any", Intrinsics((1000, 1000), matrix), RigidTransform.identity())


@hookimpl
def measure_pose_solvers() -> list[type[PoseSolver]]:
    """Register `contours`."""
    return [ContoursSolver]
