"""The outlines of one frame set with their names, and what is uncertain about them as a whole."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.model import Camera, Rig

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

    def shared_covariance(self, fit: ContourFit) -> Floats:
        """What light and uncertain cameras add to the pose's covariance (6, 6)."""
        from measure_plugins._edges.contour_covariance import of_cameras, of_light

        rig, names = Rig.of(self.cameras), list(dict.fromkeys(self.balls))
        ball_of = np.array([names.index(name) for name in self.balls])
        light = of_light(self.contours, fit, ball_of, len(names), rig.lenses)
        return light + of_cameras(self.contours, fit, rig.lenses, rig.covariances)
