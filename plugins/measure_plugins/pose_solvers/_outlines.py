"""The outlines of one frame set with their names, and what is uncertain about them as a whole."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.model import Camera

if TYPE_CHECKING:
    from measure_plugins._edges.contour_fit import ContourFit
    from measure_plugins._edges.contours import Contours


@dataclass(frozen=True, eq=False)
class Outlines:
    """Packed outlines with the names that go with them.

    Attributes:
        contours: k ball-views in c views.
        balls: (k,) names.
        cameras: (c,).
    """

    contours: Contours
    balls: list[str]
    cameras: list[Camera]

    @property
    def seen_by(self) -> tuple[str, ...]:
        """Names of the cameras that have an outline in the fit."""
        return tuple(
            self.cameras[view].name for view in sorted(set(self.contours.view_of.tolist()))
        )

    def center_by_size(self, i: int) -> Floats | None:
        """World centre (3,) of a ball from the size and place of ball-view i."""
        from measure.geometry import fit_cone

        points = self.contours.points(i)
        try:
            cone = fit_cone(
                self.contours.bearings[:, points].T, 1 / self.contours.sd_px[points] ** 2
            )
        except DegenerateGeometryError:
            return None
        camera = self.cameras[self.contours.view_of[i]]
        return camera.world_from_camera.apply(cone.center(float(self.contours.radii[i])))

    def covariance_of_cameras(self, fit: ContourFit) -> Floats:
        """What the cameras' uncertain poses and lenses add to the pose's covariance (6, 6)."""
        out = np.zeros((6, 6))
        centers = self.contours.centers_body @ fit.rotation.T + fit.translation
        for view, camera in enumerate(self.cameras):
            if camera.covariance is None:
                continue
            lever = np.zeros((6, 18))
            lever[:, :6] = fit.by_camera[view]
            if camera.intrinsics.covariance is not None:
                own = self.contours.view_of == view
                shifts = shifts_by_lens(camera, centers[own], self.contours.radii[own])
                lever[:, 6:] = -np.einsum("kij,kjl->il", fit.by_shift[own], shifts)
            out += lever @ camera.covariance @ lever.T
        return out

    def covariance_of_light(self, fit: ContourFit) -> Floats:
        """What shifts a ball alike in all cameras adds to the pose's covariance (6, 6).

        Light falls on a ball from the same side whoever looks, and shifts its outlines by its
        colour: the part that all cameras share moves the ball and leaves little residual. It is
        taken to be as large as the part that differs and is seen, and each ball's own.
        """
        view = self.contours.view_of
        places = self.contours.centers_body @ fit.rotation.T + fit.translation
        cameras = np.stack([camera.center for camera in self.cameras])[view]
        focal = np.array([camera.intrinsics.focal_px for camera in self.cameras])[view]
        mm_per_px = float(np.mean(np.linalg.norm(places - cameras, axis=1) / focal))
        out, balls = np.zeros((6, 6)), np.array(self.balls)
        for ball in dict.fromkeys(self.balls):
            lever = fit.by_step[balls == ball].sum(axis=0)
            out += lever @ lever.T
        return out * (fit.shift_sd_px[0] * mm_per_px) ** 2


def shifts_by_lens(camera: Camera, centers: Floats, radii: Floats) -> Floats:
    """How outlines of balls move and grow (x, y, radius) by the camera's intrinsics: (k, 3, 12)."""
    middle, _, _, moved = camera.project_with_jacobians(centers)
    growth = np.zeros((len(centers), 12))
    for arm in (
        *camera.world_from_camera.rotation.T[:2],
        *-camera.world_from_camera.rotation.T[:2],
    ):
        at, _, _, edge_moved = camera.project_with_jacobians(centers + radii[:, None] * arm)
        outward = (at - middle) / np.linalg.norm(at - middle, axis=1, keepdims=True)
        growth += np.einsum("ki,kij->kj", outward, edge_moved - moved) / 4
    return np.concatenate([moved, growth[:, None]], axis=1)
