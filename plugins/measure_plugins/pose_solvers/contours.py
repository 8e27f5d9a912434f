"""`contours`: one pose fitted to every outline point of every ball in every camera.

A ball seen by one camera counts, and each picture counts at its own time. Every view has one
unknown edge offset (the visible edge of a glossy ball lies inside its outline), and every ball-view
a shift of its own whose size is estimated from the residuals: that, not the pixel noise, is what
limits the pose, and it is what the covariance is made of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, align_points
from measure.host import PoseSolver, Settings, hookimpl, setting
from measure.model import Camera, Detection, Fix, Intrinsics, Motion, Pose
from measure_plugins.pose_solvers._outlines import Outlines

if TYPE_CHECKING:
    from measure_plugins._edges.contour_fit import ContourFit


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
        from measure_plugins._edges.contour_fit import fit_contours

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
        fit = fit_contours(outlines.contours, rotation, translation, known)
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
        from measure_plugins._edges.contours import Seen, pack

        detections = [d for d in detections if d.outline_px is not None]
        if not detections:
            return None
        used = [cameras[name] for name in sorted({d.camera for d in detections})]
        views = {camera.name: i for i, camera in enumerate(used)}
        times = {d.time_s for d in detections}
        still = np.zeros(6)
        moved = {t: still if prior is None else prior.moved(t) - prior.moved(time_s) for t in times}
        seen = []
        for d in detections:
            ball = self.body.balls[self.body.index(d.ball)]
            assert d.outline_px is not None
            assert d.outline_sd_px is not None
            points, sd, view = d.outline_px, d.outline_sd_px, views[d.camera]
            seen.append(Seen(points, sd, view, ball.center_mm, ball.radius_mm, moved[d.time_s]))
        contours, kept = pack(
            seen,
            np.stack([camera.intrinsics.row for camera in used]),
            np.array([camera.camera_from_world.rotation for camera in used], order="C"),
            np.stack([camera.camera_from_world.translation for camera in used]),
        )
        names = [detections[i].ball for i in kept]
        return Outlines(contours, names, used)

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

    def _pose(
        self, fit: ContourFit, outlines: Outlines, fixes: Sequence[Fix], time_s: float
    ) -> Pose:
        world_from_body = RigidTransform(fit.rotation, fit.translation)
        covariance = fit.covariance * _small_sample(max(2.0 * len(outlines.balls) - 6.0, 1.0))
        covariance += outlines.shared_covariance(fit)
        covariance = (covariance + covariance.T) / 2
        centers = dict(zip(self.body.names, world_from_body.apply(self.body.centers), strict=True))
        distances = [float(np.sum((fix.center - centers[fix.ball]) ** 2)) for fix in fixes]
        balls = set(outlines.balls)
        return Pose(
            time_s=time_s,
            world_from_body=world_from_body,
            covariance=covariance,
            residual_mm=float(np.sqrt(np.mean(distances))) if distances else float("nan"),
            rms_px=float(np.sqrt(np.mean(np.sum(fit.shifts_px[:, :2] ** 2, axis=1)))),
            cameras=outlines.seen_by,
            balls=tuple(name for name in self.body.names if name in balls),
            flags=self._flags(fit, outlines, covariance),
        )

    def _flags(self, fit: ContourFit, outlines: Outlines, covariance: Floats) -> tuple[str, ...]:
        flags = []
        off = np.hypot(fit.shifts_px[:, 0], fit.shifts_px[:, 1])
        for i in np.nonzero(off > self.config.max_shift_px)[0]:
            camera = outlines.cameras[outlines.contours.view_of[i]].name
            flags.append(f"{outlines.balls[i]} in {camera} sits {off[i]:.1f} px off the fit")
        balls = len(set(outlines.balls))
        if balls < 3:
            flags.append(f"only {balls} balls seen: part of the pose is from the prediction")
        if len(outlines.seen_by) < 2:
            flags.append("only one camera: depth is from the balls' sizes")
        if not fit.converged:
            flags.append("the fit did not settle")
        position = float(np.sqrt(np.trace(covariance[:3, :3])))
        rotation = float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))))
        if position > self.config.max_position_sd_mm or rotation > self.config.max_rotation_sd_deg:
            flags.append(f"poorly determined: {position:.2g} mm, {rotation:.2g} deg (1 sd)")
        return tuple(flags)


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
