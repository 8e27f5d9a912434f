"""Balls against a cube of fiducial tags, before the same cameras, along the same path.

    python -m benchmarks.tags FOLDER [--frames 30] [--blur-px 20]

A cube with 60 mm faces carries a tag on each. It is rendered in linear light through each camera's
true lens and the scene's sensor, detected by OpenCV, and its pose fitted to all corners in all
cameras. The balls are those of `measure demo`. Printed: RMS errors over all frame sets, a missing
pose named as such. Rows: as it is; blurred by motion; with faces glued a little off their places.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from benchmarks.command import run_command
from measure import api
from measure.arrays import Bytes, Floats
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model import Camera
from measure.simulation import write_session
from measure.simulation.catalogue import webcam_scene
from measure.simulation.scene import Scene
from measure.simulation.sensor import develop

FACE_MM, TAG_MM = 60.0, 46.0
OFF_MM = 0.1  # How far, each way, a face is glued from its place
RATE_HZ = 30.0
_CELLS_PX = 20  # Texture pixels a cell of a tag
_SUBPIXELS = 3  # Rays a pixel, each way
_PAPER, _INK, _CLOTH = 0.75, 0.03, 0.02  # Reflectances
_AMBIENT, _LAMP = 0.45, 0.55  # Shares of a face's light; the lamp is above
_MOST_STEPS = 16  # Instants averaged over an exposure
_LEAST_FACING = 0.15  # Cosine; a face turned farther away is not drawn
FAMILIES = {"AprilTag 36h11": cv2.aruco.DICT_APRILTAG_36h11, "ArUco 5x5": cv2.aruco.DICT_5X5_50}


@dataclass(frozen=True)
class Face:
    """One face of the cube."""

    body_from_face: RigidTransform  # the face's plane is z = 0, its normal +z
    texture: Bytes  # (n, n) of the whole face

    def corners(self) -> Floats:
        """Corners of the tag (4, 3) mm in the body's frame, in the order of the detector."""
        half = TAG_MM / 2
        square = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * half
        return self.body_from_face.apply(square)


@dataclass(frozen=True)
class Result:
    """Errors of one way to measure."""

    name: str
    position_mm: float  # RMS
    rotation_deg: float  # RMS
    missing: int  # frame sets without a pose

    def row(self) -> str:
        """A line of the table."""
        errors = f"{self.position_mm:.3f} | {self.rotation_deg:.3f}"
        return f"| {self.name} | {errors} | {self.missing} |"


def cube(family: str) -> list[Face]:
    """The six faces with the tags 0 to 5 of a family."""
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    cells = dictionary.markerSize + 2
    side = cells * _CELLS_PX
    margin = round(side * (FACE_MM / TAG_MM - 1) / 2)
    turns = [(np.pi / 2 * k, axis) for k, axis in ((0, 0), (1, 0), (2, 0), (3, 0), (1, 1), (3, 1))]
    faces = []
    for tag, (angle, axis) in enumerate(turns):
        drawn = cv2.aruco.generateImageMarker(dictionary, tag, side)
        texture = cv2.copyMakeBorder(
            drawn, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255
        )
        turn = RigidTransform.from_rotvec(angle * np.eye(3)[axis], [0.0, 0.0, 0.0])
        place = turn @ RigidTransform.from_rotvec([0.0, 0.0, 0.0], [0.0, 0.0, FACE_MM / 2])
        faces.append(Face(place, np.asarray(texture, np.uint8)))
    return faces


def radiance(camera: Camera, faces: Sequence[Face], world_from_body: RigidTransform) -> Floats:
    """Linear grey radiance (h, w) of the cube before dark cloth."""
    width, height = camera.intrinsics.size_wh
    picture = np.full((height, width), _CLOTH)
    camera_from_body = camera.camera_from_world @ world_from_body
    for face in faces:
        camera_from_face = camera_from_body @ face.body_from_face
        normal, center = camera_from_face.rotation[:, 2], camera_from_face.translation
        if -(normal @ center) < _LEAST_FACING * np.linalg.norm(center):
            continue
        up = (world_from_body @ face.body_from_face).rotation[2, 2]
        light = _AMBIENT + _LAMP * max(float(up), 0.0)
        _draw(picture, camera, camera_from_face, face.texture, light)
    return picture


def _draw(
    picture: Floats, camera: Camera, camera_from_face: RigidTransform, texture: Bytes, light: float
) -> None:
    """Blend one face into a picture, by rays through each pixel of its surroundings."""
    half = FACE_MM / 2
    edge = np.linspace(-half, half, 20)
    rim = [np.column_stack(pair) for s in (-half, half) for pair in _sides(edge, s)]
    pixels = camera.intrinsics.project(camera_from_face.apply(np.vstack(rim)))
    height, width = picture.shape
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 3, [width, height])
    if np.any(high <= low):
        return
    size = (high - low) * _SUBPIXELS
    u, v = (low[k] + (np.arange(size[k]) + 0.5) / _SUBPIXELS - 0.5 for k in (0, 1))
    rays = camera.intrinsics.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    normal = camera_from_face.rotation[:, 2]
    depth = (normal @ camera_from_face.translation) / (rays @ normal)
    local = camera_from_face.inverse().apply(rays * depth[:, None])[:, :2]
    side = texture.shape[0]
    place = (local * [1.0, -1.0] + half) / FACE_MM * side - 0.5
    across, down = (
        place[:, k].reshape(size[1], size[0]).astype(np.float32, copy=False) for k in (0, 1)
    )
    bright = cv2.remap(texture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (np.abs(local) < half).all(axis=1).reshape(size[1], size[0])
    shown = light * (_INK + (_PAPER - _INK) * np.asarray(bright, np.float64) / 255)
    covered, value = (_mean(array) for array in (inside.astype(float), np.where(inside, shown, 0)))
    part = picture[low[1] : high[1], low[0] : high[0]]
    part[:] = part * (1 - covered) + value


def _sides(edge: Floats, at: float) -> Iterable[tuple[Floats, Floats, Floats]]:
    other = np.full_like(edge, at)
    yield edge, other, np.zeros_like(edge)
    yield other, edge, np.zeros_like(edge)


def _mean(fine: Floats) -> Floats:
    """Means over the rays of each pixel."""
    rows, columns = (n // _SUBPIXELS for n in fine.shape)
    return fine.reshape(rows, _SUBPIXELS, columns, _SUBPIXELS).mean(axis=(1, 3))


def measured(
    scene: Scene, family: str, times_s: Floats, exposure_s: float, off_mm: float, seed: int = 3
) -> Result:
    """Render the cube along the body's path, find its tags, fit its pose, compare with the truth.

    Args:
        scene: whose cameras, sensor and path it takes.
        family: key of `FAMILIES`.
        times_s: (n,) of the exposures' middles.
        exposure_s: for motion blur; 0 for none.
        off_mm: standard deviation along each axis of where faces are glued; the fit does not know.
        seed: of what is random.
    """
    rng = np.random.default_rng(seed)
    faces = cube(family)
    real = [
        replace(
            face,
            body_from_face=RigidTransform.from_rotvec([0.0, 0.0, 0.0], rng.normal(0, off_mm, 3))
            @ face.body_from_face,
        )
        for face in faces
    ]
    detector = _detector(family)
    truth = scene.trajectory.at(times_s)
    errors = []
    for k, time_s in enumerate(times_s):
        seen = []
        for camera in scene.cameras:
            light = _exposed(scene, camera, real, time_s, exposure_s)
            picture = develop(
                np.repeat(light[:, :, None], 3, axis=2).astype(np.float32),
                scene.sensor_of(camera.name),
                rng,
            )
            corners, tags, _ = detector.detectMarkers(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
            found = [] if tags is None else [int(tag) for tag in np.asarray(tags).reshape(-1)]
            seen += [
                (camera, faces[tag].corners(), np.asarray(four, np.float64).reshape(4, 2))
                for tag, four in zip(found, corners, strict=True)
                if tag < len(faces)
            ]
        pose = fitted(seen)
        if pose is not None:
            errors.append(pose.difference(truth[k]))
    return _result(f"cube, {family}", errors, len(times_s))


def _detector(family: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    # OpenCV's other refinement counts pixels from their corners: half a pixel off.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def _exposed(
    scene: Scene, camera: Camera, faces: Sequence[Face], time_s: float, exposure_s: float
) -> Floats:
    """Radiance averaged over the exposure."""
    steps = _MOST_STEPS if exposure_s else 1
    instants = time_s + exposure_s * ((np.arange(steps) + 0.5) / steps - 0.5)
    drawn = [radiance(camera, faces, scene.trajectory.at(instant)) for instant in instants]
    return np.mean(drawn, axis=0)


def fitted(seen: Sequence[tuple[Camera, Floats, Floats]]) -> RigidTransform | None:
    """Pose of the cube from corners in the body's frame (4, 3) and in pictures (4, 2)."""
    if not seen:
        return None
    camera, corners, pixels = max(seen, key=lambda one: cv2.contourArea(one[2].astype(np.float32)))
    flat = camera.intrinsics.unproject(pixels)
    flat = flat[:, :2] / flat[:, 2:]
    ok, turn, shift = cv2.solvePnP(corners, flat, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not ok:
        return None
    start = camera.world_from_camera @ RigidTransform.from_rotvec(turn.ravel(), shift.ravel())

    def residuals(delta: Floats) -> Floats:
        pose = start.perturb(delta)
        off = [one.project(pose.apply(points)) - at for one, points, at in seen]
        return np.nan_to_num(np.concatenate(off), nan=1e3).ravel()

    scale = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
    best = least_squares(residuals, np.zeros(6), loss="soft_l1", f_scale=0.5, x_scale=scale)
    return start.perturb(best.x)


def _result(name: str, errors: Sequence[Floats], count: int) -> Result:
    off = np.array(errors).reshape(-1, 6)
    position = float(np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1)))) if len(off) else np.nan
    turn = float(np.sqrt(np.mean(np.sum(off[:, 3:] ** 2, axis=1)))) if len(off) else np.nan
    return Result(name, position, float(np.degrees(turn)), count - len(off))


def balls(scene: Scene, times_s: Floats, exposure_s: float, folder: Path) -> Result:
    """Measure the scene's balls by the default profile."""
    blurred = replace(scene, sensor=replace(scene.sensor, exposure_s=exposure_s))
    session = write_session(blurred, times_s, folder / "session")
    registry = Registry.discover()
    api.run(session, folder / "run", api.load_profile("precise"), registry)
    found = api.evaluate(folder / "run")
    assert found.body is not None
    assert found.rotation is not None
    missing = found.frame_sets - found.compared
    return Result("three balls", found.body.rms_3d_mm, found.rotation.rms_3d_deg, missing)


def exposure_for(scene: Scene, times_s: Floats, blur_px: float) -> float:
    """Exposure time in s over which the body moves by `blur_px` in the mean, seen sideways."""
    step_s = 1e-3
    before, after = (scene.trajectory.at(times_s + sign * step_s) for sign in (-1, 1))
    away = after.translation - before.translation
    speed = float(np.mean(np.linalg.norm(away, axis=1))) / (2 * step_s)
    camera = scene.cameras[0]
    depth = float(np.linalg.norm(camera.center - before.translation.mean(axis=0)))
    return blur_px * depth / (speed * camera.intrinsics.focal_px)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--blur-px", type=float, default=20.0)
    given = parser.parse_args()
    scene = webcam_scene()
    times_s = np.arange(given.frames) / RATE_HZ
    exposure_s = exposure_for(scene, times_s, given.blur_px)
    print("| measured | position mm | rotation deg | no pose |\n| --- | ---: | ---: | ---: |")
    print(balls(scene, times_s, 0.0, given.folder / "sharp").row())
    for family in FAMILIES:
        print(measured(scene, family, times_s, 0.0, 0.0).row())
    print(_named(balls(scene, times_s, exposure_s, given.folder / "blurred"), given.blur_px).row())
    for family in FAMILIES:
        print(_named(measured(scene, family, times_s, exposure_s, 0.0), given.blur_px).row())
    for family in FAMILIES:
        off = measured(scene, family, times_s, 0.0, OFF_MM)
        print(replace(off, name=f"{off.name}, faces {OFF_MM:g} mm off").row())


def _named(result: Result, blur_px: float) -> Result:
    return replace(result, name=f"{result.name}, blurred by {blur_px:g} px")


if __name__ == "__main__":
    run_command(main)
