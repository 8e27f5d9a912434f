"""Where every ball should appear in every picture, each at its own time, and how surely."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.geometry import propagate, skew
from measure.measuring.tracking.motion_filter import MotionState
from measure.model import Body, Camera, Expectation, Rig

_OUT_OF_SIGHT_PX = -1e4


@dataclass(frozen=True, eq=False)
class Windows:
    """Predictions of n rows, all balls of the first camera, then of the second, and so on.

    Attributes:
        keys: (camera, ball) of each row.
        centers_px: (n, 2).
        radii_px: (n,).
        centers_camera: (n, 3) in mm.
        covariances_px: (n, 2, 2) from the predicted pose's covariance.
        jacobians: (n, 2, 6) by the pose's `perturb` chart.
    """

    keys: tuple[tuple[str, str], ...]
    centers_px: Floats
    radii_px: Floats
    centers_camera: Floats
    covariances_px: Floats
    jacobians: Floats

    def expectations(
        self, sigmas: float, floor_px: float, size_slack: float
    ) -> dict[str, list[Expectation]]:
        """As detectors want them, by camera.

        Args:
            sigmas: how many standard deviations of the prediction to search.
            floor_px: searched in any case.
            size_slack: relative error of the outline's radius that is still believed.
        """
        reach = sigmas * np.sqrt(np.linalg.eigvalsh(self.covariances_px)[:, 1]) + floor_px
        distances = np.linalg.norm(self.centers_camera, axis=1)
        out: dict[str, list[Expectation]] = {}
        for row, (camera, ball) in enumerate(self.keys):
            radius = float(self.radii_px[row])
            slack = size_slack + reach[row] / max(distances[row], 1e-9)
            out.setdefault(camera, []).append(
                Expectation(
                    ball=ball,
                    center_px=self.centers_px[row],
                    radius_px=(radius * (1 - slack), radius * (1 + slack)),
                    min_distance_px=0.5 * radius,
                    reach_px=float(reach[row]),
                    center_camera=self.centers_camera[row],
                )
            )
        return out


def predict_windows(
    states: Mapping[str, MotionState], body: Body, cameras: Sequence[Camera]
) -> Windows:
    """Predict every ball in every camera that has an image.

    Args:
        states: the motion at each image's own time, by camera name.
        body: the body.
        cameras: all cameras; those without a state are left out.
    """
    present = [camera for camera in cameras if camera.name in states]
    count = len(body.balls)
    rig = Rig.of(present).take(np.repeat(np.arange(len(present)), count))
    each = [states[camera.name] for camera in present]
    arms = np.concatenate([s.world_from_body.rotate(body.centers) for s in each])
    shifts = np.repeat([s.world_from_body.translation for s in each], count, axis=0)
    centers = arms + shifts
    pixels, by_point = rig.project(centers)
    by_pose = np.concatenate([by_point, -by_point @ skew(arms)], axis=2)
    delays = np.concatenate(
        [
            c.row_delay_s(rows)
            for c, rows in zip(present, pixels[:, 1].reshape(-1, count), strict=True)
        ]
    )
    velocities = np.repeat([s.velocity for s in each], count, axis=0)
    pixels = pixels + delays[:, None] * np.einsum("nij,nj->ni", by_pose, velocities)
    covariances = np.repeat([s.covariance[:6, :6] for s in each], count, axis=0)
    in_camera = np.einsum("nji,nj->ni", rig.rotation, centers - rig.centers)
    hidden = ~np.all(np.isfinite(pixels), axis=1)
    pixels[hidden], by_pose[hidden] = _OUT_OF_SIGHT_PX, 0.0
    distance = np.linalg.norm(in_camera, axis=1)
    radii = np.tile(body.radii, len(present))
    focal = rig.focal_px
    # The radius that the cone's half-angle has across the line of sight.
    apparent = focal * radii / np.sqrt(np.maximum(distance**2 - radii**2, 1.0))
    return Windows(
        tuple((camera.name, ball) for camera in present for ball in body.names),
        pixels,
        apparent,
        in_camera,
        propagate(by_pose, covariances),
        by_pose,
    )
