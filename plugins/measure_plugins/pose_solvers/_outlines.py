"""The outlines of one frame set with their names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.model import Camera

if TYPE_CHECKING:
    from measure_plugins._edges.contours import Contours


@dataclass(frozen=True, eq=False)
class Outlines:
    """Packed outlines with the names that go with them.

    Attributes:
        contours: k ball-views in c views.
        balls: (k,) names.
        ball_of: (k,) their places in the body.
        cameras: (c,).
    """

    contours: Contours
    balls: list[str]
    ball_of: Ints
    cameras: tuple[Camera, ...]

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
