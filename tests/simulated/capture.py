"""Capture folders: what one photographs to calibrate a rig, with the truth."""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import Camera, paper_body
from measure.session import Calibration, write_calibration
from measure.simulation import kernels
from measure.simulation.catalogue import WEBCAM, WORKSPACE_MM, cloth_room, lamps, look_at, paper_rig
from measure.simulation.renderer import Renderer, Stage
from measure.simulation.scene import Capsule, Lighting, Material, Scene, Shape, Sphere, Still
from measure.simulation.sensor import CameraSensor, encode
from tests.simulated.boards import Chessboard

DOT = Material((0.8, 0.8, 0.8), 0.04, 0.1)
POST = Material((0.012, 0.012, 0.012))
_SAMPLES = 34
_BORDER_PX = 4.0
_FACING_DEG = 38.0


def paper_markers() -> dict[str, Floats]:
    """The paper's 16 markers: 8 posts round the workspace, in two heights."""
    places = [(1, 1), (-1, 1), (-1, -1), (1, -1), (1, 0), (0, 1), (-1, 0), (0, -1)]
    return {
        f"m{2 * k + j:02d}": np.array([127.0 * x, 127.0 * y, z])
        for k, (x, y) in enumerate(places)
        for j, z in enumerate((216.0, 279.0))
    }


@dataclass(frozen=True, eq=False)
class CaptureScene:
    """A rig to be calibrated."""

    name: str = "capture"  # of the capture
    cameras: tuple[Camera, ...] = field(default_factory=paper_rig)  # true ones
    board: Chessboard = field(default_factory=Chessboard)  # in the intrinsic and extrinsic pictures
    boards_per_camera: int = 14  # intrinsic pictures
    markers: dict[str, Floats] = field(default_factory=paper_markers)  # stated places by name, mm
    marker_sd_mm: float = 0.0  # how far, per axis, the dots really are from there
    dot_radius_mm: float = 2.5  # of the marker dots
    mark_sd_px: float = 0.3  # noise of the marks, per axis: a careful hand
    sensor: CameraSensor = WEBCAM  # how the cameras turn light into files
    seed: int = 0  # of board poses, marker places, marks and picture noise

    def true_markers(self) -> dict[str, Floats]:
        """True places of the dots, mm."""
        rng = np.random.default_rng([self.seed, 1])
        return {n: p + rng.normal(0, self.marker_sd_mm, 3) for n, p in self.markers.items()}

    def intrinsic_poses(self, camera: Camera) -> list[RigidTransform]:
        """world_from_board of the intrinsic pictures: near, far, tilted, all over the picture."""
        rng = np.random.default_rng([self.seed, 2, self.cameras.index(camera)])
        poses: list[RigidTransform] = []
        while len(poses) < self.boards_per_camera:
            pose = camera.world_from_camera @ _held_before(camera, self.board, rng)
            if camera.intrinsics.contains(camera.project(pose.apply(self.board.outline))).all():
                poses.append(pose)
        return poses

    def extrinsic_pose(self, camera: Camera) -> RigidTransform:
        """world_from_board of the board that stands at a known place, facing the camera."""
        away = camera.center + 2 * (WORKSPACE_MM - camera.center)
        away[2] = WORKSPACE_MM[2] + 0.75 * (away[2] - WORKSPACE_MM[2])
        facing = look_at(WORKSPACE_MM, away)
        middle = self.board.points.mean(axis=0)
        place = WORKSPACE_MM + np.array([0.0, 0.0, 20.0])
        return RigidTransform(facing.rotation, place - facing.rotation @ middle)

    def marks(self, camera: Camera, seed: int = 0) -> dict[str, Floats]:
        """Pixels (2,) of the dots a camera sees, as marked by hand; other seeds, other hands."""
        rng = np.random.default_rng([self.seed, 3, seed, self.cameras.index(camera)])
        true = self.true_markers()
        pixels = camera.project(np.stack(list(true.values())))
        seen = camera.intrinsics.contains(pixels, _BORDER_PX) & self._unhidden(camera)
        noise = rng.normal(0, self.mark_sd_px, pixels.shape)
        return {n: pixels[k] + noise[k] for k, n in enumerate(true) if seen[k]}

    def marker_shapes(self) -> tuple[Shape, ...]:
        """The dots, in order, then their posts."""
        true = self.true_markers()
        dots = [Sphere(place, self.dot_radius_mm, DOT) for place in true.values()]
        posts = [Capsule(p * (1, 1, 0), p, 0.3 * self.dot_radius_mm, POST) for p in true.values()]
        return (*dots, *posts)

    def _unhidden(self, camera: Camera) -> np.ndarray:
        """Whether dots (n,) are not occluded by another dot or post."""
        shapes = tuple(s.moved(camera.camera_from_world) for s in self.marker_shapes())
        stage = Stage(shapes, Lighting(()), camera.intrinsics.focal_px)
        count = len(self.markers)
        centers = np.stack([shape.anchor for shape in shapes[:count]])
        ideal = np.ascontiguousarray(centers[:, :2] / centers[:, 2:])
        near = np.ones((count, len(shapes)), bool)
        first, depth = np.empty(count, np.int64), np.empty(count)
        kernels.trace(ideal, near, 1, np.zeros(count), stage.packed, first, depth)
        return (first == np.arange(count)) & (centers[:, 2] > 0)


def write_capture(scene: CaptureScene, folder: str | Path, *, pictures: bool = True) -> Path:
    """Write a capture folder (format: docs on calibration), and `truth_calibration.toml` beside it.

    Args:
        scene: what to write.
        folder: made if missing.
        pictures: whether to render; without, only the text files are written.

    Returns:
        The folder.
    """
    folder = Path(folder)
    for name in ("extrinsic", *(f"intrinsic/{camera.name}" for camera in scene.cameras)):
        (folder / name).mkdir(parents=True, exist_ok=True)
    _write_texts(scene, folder)
    if pictures:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(lambda camera: _shoot(scene, camera, folder), scene.cameras))
    return folder


def _pictures(scene: CaptureScene, camera: Camera) -> dict[str, tuple[Shape, ...]]:
    """Every picture of one camera: its file and what stands in view."""
    intrinsic = {
        f"intrinsic/{camera.name}/{k:03d}": (scene.board.shape(pose),)
        for k, pose in enumerate(scene.intrinsic_poses(camera))
    }
    return intrinsic | {
        f"extrinsic/{camera.name}_board": (scene.board.shape(scene.extrinsic_pose(camera)),),
        f"extrinsic/{camera.name}_markers": scene.marker_shapes(),
    }


def _with_fixed(renderer: Renderer, fixed: tuple[Shape, ...]) -> Renderer:
    """A renderer of the same scene with other fixed shapes; it shares the backdrop."""
    other = Renderer(replace(renderer.scene, fixed=fixed), renderer.camera.name, renderer.samples)
    other.__dict__.update(_canvas=renderer._canvas, _backdrop=renderer._backdrop)
    return other


def _shoot(scene: CaptureScene, camera: Camera, folder: Path) -> None:
    stage = Scene(
        scene.name,
        paper_body(),
        scene.cameras,
        Still(RigidTransform.identity()),
        Lighting(lamps(scene.seed + 5, 3, 0.4), (0.2,) * 3),
        backdrop=cloth_room(0.015, scene.seed),
        sensor=scene.sensor,
        seed=scene.seed,
        shown=(),
    )
    empty = Renderer(stage, camera.name, _SAMPLES)
    for number, (path, shapes) in enumerate(_pictures(scene, camera).items()):
        picture = _with_fixed(empty, shapes).picture(0.0, number)
        data = encode(picture, scene.sensor)
        (folder / f"{path}.{scene.sensor.encoding}").write_bytes(data)


def _held_before(camera: Camera, board: Chessboard, rng: np.random.Generator) -> RigidTransform:
    """camera_from_board of a board held somewhere before a camera, a little tilted."""
    width, height = camera.intrinsics.size_wh
    pixel = rng.uniform((0.2 * width, 0.2 * height), (0.8 * width, 0.8 * height))
    bearing = camera.intrinsics.unproject(pixel[None])[0]
    size = float(np.ptp(board.outline, axis=0).max())
    depth = size * camera.intrinsics.focal_px / width * rng.uniform(1.2, 2.4)
    tilt = np.deg2rad(_FACING_DEG) * rng.uniform(-1, 1, 3) * (1, 1, 0.4)
    turn = RigidTransform.from_rotvec(tilt)
    place = bearing * depth / bearing[2] - turn.rotate(board.points.mean(axis=0))
    return replace(turn, translation=place)


def _write_texts(scene: CaptureScene, folder: Path) -> None:
    (columns, rows), kind = scene.board.inner_corners, scene.sensor.encoding
    board = f'kind = "chessboard"\ninner_corners = [{columns}, {rows}]\n'
    (folder / "board.toml").write_text(board + f"square_mm = {scene.board.square_mm!r}\n", "utf-8")
    markers = [f"{n},{x!r},{y!r},{z!r}" for n, (x, y, z) in _plain(scene.markers).items()]
    _write_lines(folder / "markers.csv", "name,x_mm,y_mm,z_mm", markers)
    marks = [
        f"{camera.name},{name},{u:.2f},{v:.2f}"
        for camera in scene.cameras
        for name, (u, v) in scene.marks(camera).items()
    ]
    _write_lines(folder / "marks.csv", "camera,name,u_px,v_px", marks)
    lines = ["[capture]", f"name = {json.dumps(scene.name)}", 'board = "board.toml"']
    lines += ['markers = "markers.csv"', 'marks = "marks.csv"']
    for camera in scene.cameras:
        pose = scene.extrinsic_pose(camera)
        lines += [
            "",
            "[[cameras]]",
            f'name = "{camera.name}"',
            f'model = "{camera.intrinsics.model}"',
            f'intrinsics = "intrinsic/{camera.name}/*.{kind}"',
            f'board_image = "extrinsic/{camera.name}_board.{kind}"',
            f'marker_image = "extrinsic/{camera.name}_markers.{kind}"',
            f"board_quat_wxyz = {pose.quat_wxyz.tolist()}",
            f"board_translation_mm = {pose.translation.tolist()}",
        ]
    (folder / "capture.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_calibration(folder / "truth_calibration.toml", Calibration(scene.cameras))


def _write_lines(path: Path, header: str, rows: list[str]) -> None:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def _plain(places: dict[str, Floats]) -> dict[str, list[float]]:
    return {name: [float(x) for x in place] for name, place in places.items()}
