"""`contours`: one pose fitted to every outline point of every ball in every camera.

A ball seen by one camera counts, and each picture counts at its own time. Every view has one
unknown edge offset (the visible edge of a glossy ball lies inside its outline), and every ball-view
a shift of its own whose size is estimated from the residuals: that, not the pixel noise, is what
limits the pose, and it is what the covariance is made of. Outlines whose edges scatter more are
taken to be shifted further.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, align_points
from measure.host import PoseSolver, Settings, hookimpl, setting
from measure.model import Camera, Detection, Fix, Intrinsics, Motion, Pose, Rig
from measure_plugins.pose_solvers._outlines import Outlines

if TYPE_CHECKING:
    from measure_plugins._edges.contour_covariance import Solution

_MOST_SPREAD = 2.0
_LEAST_VARIANCE_PX2 = 1e-8
"""For detectors that claim no uncertainty at all."""


class ContoursConfig(Settings):
    """Settings of the `contours` solver."""

    min_points: int = setting(30, "Fewest outline points, over all views.", ge=10)
    max_shift_px: float = setting(
        1.5, "A ball-view whose outline sits further off than this is flagged.", unit="px", gt=0
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
    Config = ContoursConfig
    config: ContoursConfig

    def warm_up(self) -> None:
        """Compile the joint fit (seconds, once per machine), by fitting circles to nothing."""
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
        fixes: Sequence[Fix],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body from its outlines; None if they (and the prior) leave it open."""
        from measure_plugins._edges.contour_covariance import solve_contours

        outlines = self._pack(detections, cameras, time_s, prior)
        if outlines is None or len(outlines.contours.sd_px) < self.config.min_points:
            return None
        start = self._start(fixes, outlines, time_s, prior)
        if start is None:
            return None
        known = np.zeros((6, 6))
        if len(set(outlines.balls)) < 3:
            if prior is None or prior.covariance is None:
                return None
            known = np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)
        # Arrays laid out otherwise would be compiled for once more.
        rotation = np.ascontiguousarray(start.rotation)
        translation = np.ascontiguousarray(start.translation)
        rig = Rig.of(outlines.cameras)
        fit = solve_contours(
            outlines.contours,
            rotation,
            translation,
            known,
            outlines.ball_of,
            len(self.body.balls),
            rig.lenses,
            rig.covariances,
        )
        if not fit.solved:
            return None
        return self._pose(fit, outlines, fixes, time_s)

    def _pack(
        self,
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None,
    ) -> Outlines | None:
        """The outlines ready for the fit; None if there are none."""
        from measure_plugins._edges.contours import Balls, pack, views_of

        seen = [
            (d, d.outline_px, d.outline_sd_px)
            for d in detections
            if d.outline_px is not None and d.outline_sd_px is not None
        ]
        if not seen:
            return None
        names = sorted({d.camera for d, _, _ in seen})
        used = tuple(cameras[name] for name in names)
        times = list(dict.fromkeys(d.time_s for d, _, _ in seen))
        moved = np.zeros((len(times), 6))
        if prior is not None:
            moved[:] = [prior.moved(t) - prior.moved(time_s) for t in times]
        ball_of = np.array([self.body.index(d.ball) for d, _, _ in seen])
        balls = Balls(
            np.array([names.index(d.camera) for d, _, _ in seen]),
            self.body.centers[ball_of],
            self.body.radii[ball_of],
            moved[[times.index(d.time_s) for d, _, _ in seen]],
            _spread([d for d, _, _ in seen]),
        )
        points, sd = [one for _, one, _ in seen], [one for _, _, one in seen]
        contours, kept = pack(points, sd, balls, views_of(used))
        return Outlines(contours, [seen[i][0].ball for i in kept], ball_of[kept], used)

    def _start(
        self,
        fixes: Sequence[Fix],
        outlines: Outlines,
        time_s: float,
        prior: Motion | None,
    ) -> RigidTransform | None:
        """The prior, or the body laid on its fixes, or on where the outlines' sizes put it."""
        if prior is not None:
            return prior.at(time_s)
        located = {fix.ball: fix.center for fix in fixes}
        for i, name in enumerate(outlines.balls):
            if name not in located:
                center = outlines.center_by_size(i)
                if center is not None:
                    located[name] = center
        if len(located) < 3:
            return None
        source = np.stack([self.body.centers[self.body.index(name)] for name in located])
        try:
            return align_points(np.stack(list(located.values())), source)
        except DegenerateGeometryError:
            return None

    def _pose(self, fit: Solution, outlines: Outlines, fixes: Sequence[Fix], time_s: float) -> Pose:
        world_from_body = RigidTransform(fit.rotation, fit.translation)
        covariance = fit.covariance * _small_sample(max(2.0 * len(outlines.balls) - 6.0, 1.0))
        covariance += fit.shared
        covariance = (covariance + covariance.T) / 2
        balls = set(outlines.balls)
        return Pose(
            time_s=time_s,
            world_from_body=world_from_body,
            covariance=covariance,
            residual_mm=self._residual_mm(world_from_body, fixes),
            rms_px=_rms(fit.shifts_px[:, :2]),
            cameras=outlines.seen_by,
            balls=tuple(name for name in self.body.names if name in balls),
            flags=self._flags(fit, outlines, covariance),
        )

    def _residual_mm(self, world_from_body: RigidTransform, fixes: Sequence[Fix]) -> float:
        """RMS distance of the fixes from the body's balls; NaN without any."""
        if not fixes:
            return float("nan")
        placed = world_from_body.apply(self.body.centers[[self.body.index(f.ball) for f in fixes]])
        return _rms(np.concatenate([fix.center for fix in fixes]).reshape(-1, 3) - placed)

    def _flags(self, fit: Solution, outlines: Outlines, covariance: Floats) -> tuple[str, ...]:
        flags = []
        off = np.hypot(fit.shifts_px[:, 0], fit.shifts_px[:, 1])
        for i in np.flatnonzero(off > self.config.max_shift_px):
            camera = outlines.cameras[outlines.contours.view_of[i]].name
            flags.append(f"{outlines.balls[i]} in {camera} sits {off[i]:.1f} px off the fit")
        balls = len(set(outlines.balls))
        if balls < 3:
            flags.append(f"only {balls} balls seen: part of the pose is from the prediction")
        if len(outlines.seen_by) < 2:
            flags.append("only one camera: depth is from the balls' sizes")
        if not fit.converged:
            flags.append("the fit did not settle")
        variances = covariance.diagonal().tolist()
        position = math.sqrt(sum(variances[:3]))
        rotation = math.degrees(math.sqrt(sum(variances[3:])))
        if position > self.config.max_position_sd_mm or rotation > self.config.max_rotation_sd_deg:
            flags.append(f"poorly determined: {position:.2g} mm, {rotation:.2g} deg (1 sd)")
        return tuple(flags)


def _spread(seen: Sequence[Detection]) -> Floats:
    """Variances (k,) of the outlines' own shifts relative to each other.

    Where the edges of an outline scatter more, all of them together sit off further as well. Their
    scatter tells part of that only: it counts by its root, within limits.
    """
    claimed = np.array([d.covariance_px[0, 0] + d.covariance_px[1, 1] for d in seen])
    typical = max(float(np.median(claimed)), _LEAST_VARIANCE_PX2)
    return np.clip(np.sqrt(claimed / typical), 1 / _MOST_SPREAD, _MOST_SPREAD)


def _rms(vectors: Floats) -> float:
    """Root mean square length of vectors (n, d)."""
    return math.sqrt(float(np.sum(vectors * vectors)) / len(vectors))


@lru_cache(maxsize=64)
def _small_sample(degrees: float) -> float:
    """Widening that lets the 95 % ellipsoid hold 95 % though its scale is estimated (F for chi^2).

    Below four degrees of freedom the estimate says next to nothing; the widening stops there.
    """
    from scipy.special import chdtri, fdtri

    return float(6 * fdtri(6, max(degrees, 4.0), 0.95) / chdtri(6, 0.05))


def _camera_for_warming_up() -> Camera:
    matrix = np.array([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]])
    return Camera("any", Intrinsics((1000, 1000), matrix), RigidTransform.identity())


@hookimpl
def measure_pose_solvers() -> list[type[PoseSolver]]:
    """Register `contours`."""
    return [ContoursSolver]
