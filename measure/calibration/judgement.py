"""Is a calibration good? Answers in millimetres at the body, and plausibility checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import Rays, RigidTransform, nearest_point, skew
from measure.model import Ball, BallColor, Body, Camera

SUB_MM_SD_MM = 0.3
"""A body position known worse than this (one standard deviation) does not support sub-mm."""
MAX_MARK_PX = 1.5
MAX_MARK_MM = 0.35
_GRID = 3


def paper_body() -> Body:
    """The paper's three-ball body, the measure of every calibration that names no other."""
    places = {"green": (38.0, 0.0, 0.0), "yellow": (0.0, 38.0, 0.0), "red": (-38.0, 0.0, 0.0)}
    balls = tuple(Ball(n, BallColor.named(n), np.array(c), 20.0) for n, c in places.items())
    return Body("raven three-ball body", balls)


@dataclass(frozen=True)
class Finding:
    """Something a user should know about a calibration.

    Attributes:
        level: "alarm" (do not trust it), "warning" (weak) or "note".
        camera: its name, or "" if it concerns all.
        text: what, and what to do.
    """

    level: str
    camera: str
    text: str

    def __str__(self) -> str:
        where = f"camera {self.camera}: " if self.camera else ""
        return f"{self.level}: {where}{self.text}"


@dataclass(frozen=True, eq=False)
class Workspace:
    """Where bodies will be measured: the box `center` +- `half` (3,) mm."""

    center: Floats
    half: Floats

    def grid(self) -> Floats:
        """Points (27, 3) across the box."""
        steps = np.linspace(-1, 1, _GRID)
        offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return self.center + offsets * self.half


def workspace_of(cameras: tuple[Camera, ...], points: Floats) -> Workspace:
    """The inner half of the marker field (or of whatever points (n, 3) were looked at).

    Without points: 100 mm around where the cameras' axes meet.

    Raises:
        DegenerateGeometryError: no points, and all cameras look the same way.
    """
    if len(points) >= 4 and np.all(np.ptp(points[:, :2], axis=0) > 0):
        low, high = points.min(axis=0), points.max(axis=0)
        return Workspace((low + high) / 2, np.maximum((high - low) / 4, 10.0))
    axes = Rays(
        np.stack([c.center for c in cameras]),
        np.stack([c.world_from_camera.rotation[:, 2] for c in cameras]),
    )
    return Workspace(nearest_point(axes), np.full(3, 50.0))


def body_cost(
    estimated: tuple[Camera, ...],
    true: tuple[Camera, ...],
    body: Body,
    poses: list[RigidTransform],
) -> tuple[Floats, Floats]:
    """What wrong cameras cost: true ball centres through true cameras, located with estimated ones.

    Args:
        estimated: cameras to judge.
        true: the same cameras as they are, in the same order.
        body: the body.
        poses: its true poses.

    Returns:
        Position errors (n, 3) in mm and rotation errors (n, 3), rotation vectors in rad.
    """
    shifts, turns = [], []
    for pose in poses:
        pixels = [camera.project(pose.apply(body.centers)) for camera in true]
        found = _locate(estimated, body, pixels, pose)
        delta = found.difference(pose)
        shifts.append(delta[:3])
        turns.append(delta[3:])
    return np.stack(shifts), np.stack(turns)


def _locate(
    cameras: tuple[Camera, ...], body: Body, pixels: list[Floats], start: RigidTransform
) -> RigidTransform:
    """Least-squares body pose from ball centres in all cameras, by Gauss-Newton."""
    pose = start
    for _ in range(10):
        points = pose.apply(body.centers)
        by_motion = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(points - pose.translation)],
            axis=2,
        )
        rows, residuals = [], []
        for camera, seen in zip(cameras, pixels, strict=True):
            predicted, by_world, _, _ = camera.project_with_jacobians(points)
            rows.append((by_world @ by_motion).reshape(-1, 6))
            residuals.append((seen - predicted).ravel())
        step = np.linalg.lstsq(np.concatenate(rows), np.concatenate(residuals), rcond=None)[0]
        pose = pose.perturb(step)
        if np.abs(step).max() < 1e-10:
            break
    return pose


def plausibility(
    cameras: tuple[Camera, ...], workspace: Workspace, floor_z_mm: float | None
) -> list[Finding]:
    """Cameras under the floor, looking away, or standing in one another."""
    findings = []
    for camera in cameras:
        if floor_z_mm is not None and camera.center[2] < floor_z_mm:
            findings.append(
                Finding(
                    "alarm",
                    camera.name,
                    f"it stands {floor_z_mm - camera.center[2]:.0f} mm under the floor "
                    f"(z = {floor_z_mm:.0f} mm): a mirrored board or a wrong world frame",
                )
            )
        image = camera.project(workspace.center[None])
        if not bool(camera.intrinsics.contains(image)[0]):
            findings.append(
                Finding("alarm", camera.name, "it does not see the middle of the workspace")
            )
    for i, a in enumerate(cameras):
        for b in cameras[i + 1 :]:
            apart = float(np.linalg.norm(a.center - b.center))
            if apart < 5.0:
                findings.append(
                    Finding(
                        "alarm",
                        b.name,
                        f"it stands {apart:.1f} mm from camera {a.name}: one "
                        "camera's pictures used twice?",
                    )
                )
    return findings


def residual_findings(
    name: str, residuals: Floats, mm_per_px: float, names: list[str]
) -> list[Finding]:
    """Marks that miss too far for sub-mm work."""
    lengths = np.linalg.norm(residuals, axis=1)
    rms = float(np.sqrt(np.mean(lengths**2)))
    findings = []
    if rms > MAX_MARK_PX or rms * mm_per_px > MAX_MARK_MM:
        worst = names[int(np.argmax(lengths))]
        findings.append(
            Finding(
                "alarm",
                name,
                f"its marks miss by {rms:.1f} px RMS ({rms * mm_per_px:.2f} mm; worst {worst} "
                f"{lengths.max():.1f} px): too large for sub-mm; mark again, check the marker "
                "places and the lens",
            )
        )
    elif len(lengths) and lengths.max() > 5 * max(float(np.median(lengths)), 0.2):
        worst = names[int(np.argmax(lengths))]
        findings.append(
            Finding("warning", name, f"mark {worst} misses by {lengths.max():.1f} px: look again")
        )
    return findings


def accuracy_findings(position_sd_mm: Floats) -> list[Finding]:
    """Whether the expected error of the body supports sub-mm work."""
    worst = float(np.max(position_sd_mm))
    if not np.isfinite(worst):
        raise DegenerateGeometryError("the cameras do not determine the body's pose")
    if worst > SUB_MM_SD_MM:
        return [
            Finding(
                "alarm",
                "",
                f"this calibration does not support sub-mm: expected body position error "
                f"{worst:.2f} mm (one standard deviation) in the worst part of the workspace",
            )
        ]
    return []
