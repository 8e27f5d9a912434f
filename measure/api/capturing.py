"""Pictures of a waved board, taken by themselves, as `calibrate` reads them."""

from __future__ import annotations

import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from measure.api.calibrating import find_target
from measure.api.recording import CaptureRequest, check_seconds, sources_of, until_stopped
from measure.calibration import BoardWave, Corners, WaveState, read_board
from measure.calibration.boards import Board, MirroredBoardError
from measure.calibration.waving import GOAL_MM
from measure.capture import CameraAddress, Cameras, Gathering, check_new
from measure.capture.controls import watched
from measure.errors import ConfigError
from measure.model import Image, paper_body
from measure.session import dump_toml, read_body

_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 98)


def capture_board(
    cameras: Sequence[CameraAddress],
    board: Path | str,
    out: Path,
    *,
    body: Path | None = None,
    goal_mm: float = GOAL_MM,
    request: CaptureRequest | None = None,
    seconds: float | None = None,
    on_state: Callable[[WaveState], None] | None = None,
    on_image: Callable[[Image], None] | None = None,
    stop: threading.Event | None = None,
) -> WaveState | None:
    """Take pictures of a board that is waved, those that add something, until they are enough.

    Args:
        board: its target file, or the name of one that comes with the program.
        out: the capture folder, new or empty.
        body: that will be measured; the paper's three balls if omitted.
        goal_mm: expected error of the body's position (standard deviation) that is good enough.
        request: what cameras of this machine are set to.
        seconds: longest time; until they are enough, or interrupted, if None.
        on_state: called after every frame set.
        on_image: called with every picture, from its camera's thread.
        stop: set to end it; interrupts set it, too.

    Returns:
        How far the pictures suffice; None if no picture came.

    Raises:
        MeasureError: what is wrong with cameras, board, body or folder.
    """
    check_seconds(seconds)
    if not (math.isfinite(goal_mm) and goal_mm > 0):
        raise ConfigError(f"--goal-mm {goal_mm:g}: expected a length in mm above 0")
    names = [one.name for one in cameras]
    check_new(out, names)
    target, state = find_target(Path(board)), None
    pattern, measured = read_board(target), paper_body() if body is None else read_body(body)
    with _frame_sets(cameras, request, seconds, on_image, stop) as (frame_sets, rig_stop):
        _begin(out, target, names)
        wave = BoardWave(pattern, {}, measured, goal_mm)
        with ThreadPoolExecutor(len(names)) as pool:
            for images in frame_sets:
                seen = pool.map(lambda image: _find(pattern, image), images)
                views = {i.camera: v for i, v in zip(images, seen, strict=True) if v is not None}
                wave.sizes_wh.update((i.camera, i.pixels.shape[1::-1]) for i in images)
                times_s = {image.camera: image.time_s for image in images if image.camera in views}
                if len(wave.sizes_wh) == len(names) and views and wave.add(views, times_s):
                    _write(out, len(wave.kept), [i for i in images if i.camera in views])
                state = wave.state()
                if on_state is not None:
                    on_state(state)
                if state.enough:
                    rig_stop()
    return state


@contextmanager
def _frame_sets(
    cameras: Sequence[CameraAddress],
    request: CaptureRequest | None,
    seconds: float | None,
    on_image: Callable[[Image], None] | None,
    stop: threading.Event | None,
) -> Iterator[tuple[Iterator[list[Image]], Callable[[], None]]]:
    """The pictures of instants as they come, and what ends them."""
    with (
        Cameras(sources_of(cameras, [], request)) as rig,
        watched(rig.controls, request is not None and request.lock),
        until_stopped(stop) as stopped,
    ):
        gathering = Gathering([one.name for one in cameras], on_read=rig.note_read)
        rig.begin([gathering.add] if on_image is None else [gathering.add, on_image])
        ends_s = math.inf if seconds is None else time.monotonic() + seconds

        def over() -> bool:
            if stopped.is_set() or time.monotonic() >= ends_s:
                rig.stop()
            return rig.over

        sets = gathering.frame_sets(over, rig.check)
        yield ([*one.images.values()] for one in sets), rig.stop


def _find(board: Board, image: Image) -> Corners | None:
    gray = np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY), np.uint8)
    try:
        return board.find(gray)
    except MirroredBoardError:
        return None


def _begin(out: Path, board: Path, names: Sequence[str]) -> None:
    """Write all but the pictures."""
    out.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(board, out / "board.toml")
    tables = [{"name": name, "intrinsics": f"{name}/*.jpg"} for name in names]
    about = {"name": out.resolve().name, "board": "board.toml", "common_views": True}
    (out / "capture.toml").write_text(dump_toml({"capture": about, "cameras": tables}), "utf-8")
    for name in names:
        (out / name).mkdir()


def _write(out: Path, number: int, images: Sequence[Image]) -> None:
    for image in images:
        jpeg = image.encoded or cv2.imencode(".jpg", image.pixels, _QUALITY)[1].tobytes()
        (out / image.camera / f"{number:06d}.jpg").write_bytes(jpeg)
