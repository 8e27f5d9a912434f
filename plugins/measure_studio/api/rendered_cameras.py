"""Rendered cameras to try the set-up page with: a board or a body is waved, then a body moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from measure import api
from measure.arrays import Bytes
from measure.errors import ConfigError, MeasureError
from measure.geometry import RigidTransform
from measure.processes import Progress, quiet
from measure.session import dump_toml, open_streams, read_calibration
from measure_studio.api.playing_cameras import PictureReel, Screening
from measure_studio.api.rig_folder import next_free
from measure_studio.capture import serve_cameras

if TYPE_CHECKING:
    from measure.simulation.scene import Scene

DEMO_BOARDS = ("charuco_8x5_27", "chessboard_9x6_25")
WAVED_BODY = "body"
"""In place of a board: the body itself is waved."""
_RATE_HZ = 10.0
_HELD_S, _HELD_LOOKS = 1.2, 4.0
"""How long a board is held still, at least: as a person waits for a computer that looks seldom."""
_BODY_TICKS = 80  # Pictures of the body's motion, there; it comes back the same way
_WAVED_TICKS, _WAVED_MM, _WAVED_MM_S, _WAVED_RAD_S = 160, (150.0, 150.0, 100.0), 200.0, 1.5
"""The same of the body while it is waved: how far it goes, and how fast it goes and turns."""
_RAYS = 16  # Through a pixel that an edge crosses: a board needs no more
_PX_PER_MM = 8.0  # Of the printed board


@contextmanager
def demo_cameras(
    folder: Path, board: str = DEMO_BOARDS[0], progress: Progress = quiet
) -> Iterator[tuple[Path, dict[str, str]]]:
    """Serve four rendered cameras that show what the newest rig folder needs next.

    The board is waved until the folder has a calibration, lies still until that has a world,
    and then a body moves. Without a board the body is waved, and lies still. Pictures are rendered
    once and kept in `folder`.

    Args:
        folder: of the demonstration; the rig's folder is a new one in it.
        board: name of one of `DEMO_BOARDS`, or `WAVED_BODY`.

    Yields:
        The rig's folder, and the cameras' addresses by name.

    Raises:
        ConfigError: there is no such board.
    """
    if board not in (*DEMO_BOARDS, WAVED_BODY):
        raise ConfigError(f"--board {board}: expected one of {', '.join(DEMO_BOARDS)}")
    acts = _rendered(folder / "rendered", board, progress)
    desk = folder / next_free(folder, "rig")
    desk.mkdir(parents=True)
    with ExitStack() as stack:
        held = _held_ticks(acts["waved"], board) if board != WAVED_BODY else 0
        reels = {
            act: _reel(act, stack.enter_context(open_streams(acts[act])), held) for act in acts
        }
        stage = _HeldStage(reels, desk)
        stack.callback(stage.over.set)
        names = next(iter(reels.values())).streams
        feeds = {name: partial(stage.parts, name) for name in names}
        yield desk, stack.enter_context(serve_cameras(feeds))


def _held_ticks(waved: Path, board: str) -> int:
    """Pictures for which a board is held still, by how long it takes to look at one of each."""
    pattern, begun_s = api.read_board(api.shipped_targets()[board]), time.monotonic()
    for picture in waved.glob("*/000000.jpg"):
        pattern.look(np.asarray(cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE), np.uint8))
    return round(_RATE_HZ * max(_HELD_S, _HELD_LOOKS * (time.monotonic() - begun_s)))


class _HeldStage:
    """What the cameras see now, by what the rig's folder holds."""

    def __init__(self, reels: Mapping[str, PictureReel], desk: Path) -> None:
        self._reels, self._desk = reels, desk
        self.over = threading.Event()
        self._act = "waved"
        self._shown = Screening(reels[self._act])
        threading.Thread(target=self._watch, daemon=True).start()

    def parts(self, camera: str) -> Iterator[bytes]:
        """A camera's pictures from now on."""
        while not self.over.is_set():
            yield from self._shown.parts(camera)

    def _watch(self) -> None:
        while not self.over.wait(0.5):
            act = _act_of(self._desk)
            if act != self._act:
                before, self._act = self._shown, act
                self._shown = Screening(self._reels[act])
                before.over.set()
        self._shown.over.set()


def _act_of(desk: Path) -> str:
    """What is needed next."""
    try:
        calibration = read_calibration(desk / "calibration.toml")
    except (MeasureError, OSError):
        return "waved"
    is_placed = "world" in calibration.provenance or any(desk.glob("body-*.toml"))
    return "body" if is_placed else "lying"


def _reel(act: str, streams: Mapping[str, object], held_ticks: int) -> PictureReel:
    """When which picture is shown; a scene at rest has two pictures, which take turns."""
    some = dict(streams)
    size = min(len(one) for one in some.values())  # type: ignore[arg-type]
    if act == "body" or not held_ticks:
        places = [*range(size), *range(size - 2, 0, -1)]
    else:
        places = [2 * (k // 2) + t % 2 for k in range(0, size, 2) for t in range(held_ticks)]
    turns = np.arange(len(places)) / _RATE_HZ, np.array(places)
    return PictureReel(some, dict.fromkeys(some, turns), len(places) / _RATE_HZ)  # type: ignore[arg-type]


def _rendered(folder: Path, board: str, progress: Progress) -> dict[str, Path]:
    """The sessions of all acts, rendered if they are not there."""
    from measure.simulation.catalogue import WORKSPACE_MM, motion, webcam_scene
    from measure.simulation.scene import MotionLimits
    from measure_studio.api.held_boards import held_poses

    scene = webcam_scene()
    if board == WAVED_BODY:
        far = MotionLimits(_WAVED_MM, speed_mm_s=_WAVED_MM_S, turn_rad_s=_WAVED_RAD_S)
        at_rest = MotionLimits((0.0, 0.0, 0.0), 0.0)
        moved = {
            "waved": (replace(scene, trajectory=motion(scene.seed, far)), _WAVED_TICKS),
            "lying": (replace(scene, trajectory=motion(scene.seed, at_rest)), 2),
            "body": (scene, _BODY_TICKS),
        }
        return _rendered_bodies(folder, moved, progress)
    points = api.read_board(api.shipped_targets()[board]).points
    waved = held_poses(scene.cameras, points, WORKSPACE_MM)
    flat = RigidTransform.from_rotvec([np.pi, 0, 0])
    lying = replace(flat, translation=WORKSPACE_MM - (0, 0, 40) - flat.rotate(points.mean(axis=0)))
    acts = {act: folder / f"{act}-{board}" for act in ("waved", "lying")}
    number, total = count(1), len(scene.cameras) * (2 * len(waved) + 2)

    def step(*_: object) -> None:
        progress(next(number), total)

    for act, poses in (("waved", waved), ("lying", [lying])):
        if not (acts[act] / "session.toml").is_file():
            _write_board(acts[act], board, poses, step)
    return acts | _rendered_bodies(folder, {"body": (scene, _BODY_TICKS)}, progress)


def _rendered_bodies(
    folder: Path, moved: Mapping[str, tuple[Scene, int]], progress: Progress
) -> dict[str, Path]:
    """The sessions of scenes in which a body moves for so many pictures."""
    from measure.simulation import write_session

    acts = {act: folder / (act if act == "body" else f"{act}-body") for act in moved}
    for act, (scene, ticks) in moved.items():
        if not (acts[act] / "session.toml").is_file():
            write_session(scene, np.arange(ticks) / _RATE_HZ, acts[act], progress=progress)
    return acts


def _write_board(folder: Path, board: str, poses: Sequence[RigidTransform], step: Progress) -> None:
    """A session of a board at rest in some poses, two pictures of each, which differ by noise."""
    from measure.simulation import Renderer
    from measure.simulation.catalogue import webcam_scene
    from measure.simulation.scene import Actor, Lighting
    from measure.simulation.sensor import develop, encode
    from measure_studio.api.held_boards import Held, printed_board

    target = api.shipped_targets()[board]
    printed, first = api.target_sheet(target), api.read_board(target).points[:, :2].min(axis=0)
    left, top = (first - printed.origin_mm).tolist()
    held = Actor((printed_board(_bitmap(printed), _PX_PER_MM, (left, top)),), Held(poses))
    light_all_round = Lighting((), (1.0, 1.0, 1.0), below=1.0)
    scene = replace(webcam_scene(), shown=(), attached=(), actors=(held,), lighting=light_all_round)

    def shoot(number: int) -> None:
        camera = scene.cameras[number]
        (folder / camera.name).mkdir(parents=True, exist_ok=True)
        renderer = Renderer(scene, camera.name, _RAYS)
        for frame in range(2 * len(poses)):
            if frame % 2 == 0:
                light = renderer.radiance(frame / 2)
            noise = np.random.Generator(np.random.SFC64([number, frame]))
            data = encode(develop(light, scene.sensor, noise), scene.sensor)
            (folder / camera.name / f"{frame:06d}.jpg").write_bytes(data)
            step(0, None)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(shoot, range(len(scene.cameras))))
    _write_texts(folder, [camera.name for camera in scene.cameras], 2 * len(poses))


def _write_texts(folder: Path, names: Sequence[str], frames: int) -> None:
    rows = "".join(f"{frame},{frame / _RATE_HZ}\n" for frame in range(frames))
    for name in names:
        (folder / f"{name}.csv").write_text("frame,time_s\n" + rows, "utf-8")
    tables = [{"name": n, "images": f"{n}/*.jpg", "timestamps": f"{n}.csv"} for n in names]
    text = dump_toml({"session": {"name": folder.name}, "cameras": tables})
    (folder / "session.toml").write_text(text, "utf-8")


def _bitmap(sheet: api.Sheet) -> Bytes:
    """The boxes of a sheet as a picture."""
    width, height = (round(side * _PX_PER_MM) for side in sheet.size_mm)
    out = np.full((height, width), 255, np.uint8)
    for shape in sheet.shapes:
        if shape.tag == "rect":
            x, y, wide, high = (
                shape.place[key] * _PX_PER_MM for key in ("x", "y", "width", "height")
            )
            level = 0 if shape.style["fill"] == "black" else 255
            out[round(y) : round(y + high), round(x) : round(x + wide)] = level
    return out
