"""`contours`: one pose fitted to every outline point of every ball in every camera.

A ball seen by one camera counts, and each picture counts at its own time. Every view has one
unknown edge offset (the visible edge of a glossy ball lies inside its outline), and every ball-view
a shift of its own whose size is estimated from the residuals: that, not the pixel noise, is what
limits the pose, and it is what the covariance is made of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, align_points
from measure.host import PoseSolver, Settings, hookimpl, setting
from measure.model import Body, Camera, Detection, Fix, Motion, Pose

if TYPE_CHECKING:
    from measure_plugins._edges.contour_fit import BallOutline, ContourFit


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

    def solve(
        self,
        fixes: Sequence[Fix],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body from its outlines; None if they (and the prior) leave it open."""
        from measure_plugins._edges.contour_fit import fit_contours, outlines_of

        velocity = np.zeros(6) if prior is None else prior.velocity
        outlines = outlines_of(detections, cameras, self.body, time_s, velocity)
        start = self._start(fixes, outlines, time_s, prior)
        if start is None or sum(len(o.bearings) for o in outlines) < self.config.min_points:
            return None
        balls = {outline.ball for outline in outlines}
        known: Floats | None = None
        if len(balls) < 3:
            if prior is None or prior.covariance is None:
                return None
            known = np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)
        fit = fit_contours(outlines, self.body, start, known)
        if fit is None or not np.all(np.isfinite(fit.information)):
            return None
        return self._pose(fit, outlines, fixes, time_s)

    def _start(
        self,
        fixes: Sequence[Fix],
        outlines: Sequence[BallOutline],
        time_s: float,
        prior: Motion | None,
    ) -> RigidTransform | None:
        """The prior, or the body laid on its fixes, or on where the outlines' sizes put it."""
        if prior is not None:
            return prior.at(time_s)
        located = {fix.ball: fix.center for fix in fixes}
        for outline in outlines:
            name = self.body.balls[outline.ball].name
            if name not in located:
                center = _center_by_size(outline, self.body.balls[outline.ball].radius_mm)
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
        self,
        fit: ContourFit,
        outlines: Sequence[BallOutline],
        fixes: Sequence[Fix],
        time_s: float,
    ) -> Pose:
        covariance = np.asarray(np.linalg.inv(fit.information), dtype=np.float64)
        covariance *= _small_sample(fit.degrees)
        covariance[:3, :3] += _common_shift_mm(fit, outlines, self.body) ** 2 * np.eye(3)
        covariance = covariance + self._from_cameras(fit, outlines)
        covariance = (covariance + covariance.T) / 2
        centers = {b.name: fit.world_from_body.apply(b.center_mm) for b in self.body.balls}
        distances = [float(np.sum((fix.center - centers[fix.ball]) ** 2)) for fix in fixes]
        shifts = fit.shifts_px[:, :2]
        return Pose(
            time_s=time_s,
            world_from_body=fit.world_from_body,
            covariance=covariance,
            residual_mm=float(np.sqrt(np.mean(distances))) if distances else float("nan"),
            rms_px=float(np.sqrt(np.mean(np.sum(shifts**2, axis=1)))),
            cameras=tuple(sorted({o.camera.name for o in outlines})),
            balls=tuple(
                self.body.balls[i].name for i in sorted({outline.ball for outline in outlines})
            ),
            flags=self._flags(fit, outlines, covariance),
        )

    def _from_cameras(self, fit: ContourFit, outlines: Sequence[BallOutline]) -> Floats:
        """What the cameras' own uncertain poses add to the pose's covariance (6, 6)."""
        from measure_plugins._edges.contour_fit import camera_sensitivity

        out = np.zeros((6, 6))
        for camera in {o.camera.name: o.camera for o in outlines}.values():
            if camera.pose_covariance is not None:
                lever = camera_sensitivity(fit, outlines, self.body, camera)
                out += lever @ camera.pose_covariance @ lever.T
        return out

    def _flags(
        self, fit: ContourFit, outlines: Sequence[BallOutline], covariance: Floats
    ) -> tuple[str, ...]:
        flags = []
        for outline, shift in zip(outlines, fit.shifts_px, strict=True):
            off = float(np.hypot(*shift[:2]))
            if off > self.config.max_shift_px:
                ball = self.body.balls[outline.ball].name
                flags.append(f"{ball} in {outline.camera.name} sits {off:.1f} px off the fit")
        balls = {outline.ball for outline in outlines}
        if len(balls) < 3:
            flags.append(f"only {len(balls)} balls seen: part of the pose is from the prediction")
        if len({outline.camera.name for outline in outlines}) < 2:
            flags.append("only one camera: depth is from the balls' sizes")
        if not fit.converged:
            flags.append("the fit did not settle")
        position = float(np.sqrt(np.trace(covariance[:3, :3])))
        rotation = float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))))
        if position > self.config.max_position_sd_mm or rotation > self.config.max_rotation_sd_deg:
            flags.append(f"poorly determined: {position:.2g} mm, {rotation:.2g} deg (1 sd)")
        return tuple(flags)


def _center_by_size(outline: BallOutline, radius_mm: float) -> Floats | None:
    """World centre (3,) of a ball from the size and place of its outline in one camera."""
    from measure.geometry import fit_cone

    try:
        cone = fit_cone(outline.bearings, 1 / outline.sd_px**2)
    except DegenerateGeometryError:
        return None
    return outline.camera.world_from_camera.apply(cone.center(radius_mm))


def _common_shift_mm(fit: ContourFit, outlines: Sequence[BallOutline], body: Body) -> float:
    """Standard deviation per axis of what shifts all ball-views alike, in mm.

    Light falls on all balls from the same side in all cameras, so part of what shifts their
    outlines is common to them; it moves the body and leaves no residual. It is taken to be as large
    as the part that differs and is seen.
    """
    scales = [
        float(np.linalg.norm(fit.world_from_body.apply(body.centers[o.ball]) - o.camera.center))
        / o.camera.intrinsics.focal_px
        for o in outlines
    ]
    return float(fit.shift_sd_px[0] * np.mean(scales))


def _small_sample(degrees: float) -> float:
    """Widening that lets the 95 % ellipsoid hold 95 % though its scale is estimated (F for chi^2).

    Below four degrees of freedom the estimate says next to nothing; the widening stops there.
    """
    from scipy.special import chdtri, fdtri

    return float(6 * fdtri(6, max(degrees, 4.0), 0.95) / chdtri(6, 0.05))


@hookimpl
def measure_pose_solvers() -> list[type[PoseSolver]]:
    """Register `contours`."""
    return [ContoursSolver]
