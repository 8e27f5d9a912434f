"""Pictures of a waved board, taken by themselves, as `calibrate` reads them."""

from __future__ import annotations

import glob
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from measure import api
from measure.api.outputs import check_folder, new_folder
from measure.arrays import Bytes, Floats
from measure.errors import ConfigError
from measure.host import Detector
from measure.model import Detection, Image, paper_body
from measure.processes import processes
from measure.session import dump_toml, read_body
from measure_studio.api.recording import (
    SESSION,
    CaptureOptions,
    OpenRig,
    new_recorder,
    open_rig,
    sources_of,
)
from measure_studio.capture import CameraAddress, Gathering, Recorder, check_names

_MARK = "capture.toml"
_MIRRORED: Literal["mirrored"] = "mirrored"
_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 98)

OnBalls = Callable[[Sequence[Image], Mapping[str, Sequence[Detection]]], None]
OnCorners = Callable[[Sequence[Image], Mapping[str, Floats]], None]


def capture_board(
    cameras: Sequence[CameraAddress],
    board: Path | str,
    out: Path,
    options: CaptureOptions | None = None,
    *,
    body: Path | None = None,
    goal_mm: float = 0.2,
    on_state: Callable[[api.WaveState], None] = lambda _: None,
    on_corners: OnCorners = lambda _images, _corners: None,
) -> api.WaveState | None:
    """Take pictures of a board that is waved, those that add something, until they are enough.

    Args:
        board: its target file, or the name of one that comes with the program.
        out: the capture folder.
        options: how cameras are read; it ends when pictures are enough, too.
        body: that will be measured; the paper's three balls if omitted.
        goal_mm: expected error of the body's position (standard deviation) that is good enough.
        on_state: called after every frame set.
        on_corners: called before with the pictures, and the corners (n, 2) px that each camera
            shows, by its name.

    Returns:
        How far the pictures suffice; None if no picture came.

    Raises:
        MeasureError: what is wrong with cameras, board, body or folder.
    """
    options, names = options or CaptureOptions(), [one.name for one in cameras]
    options.check()
    check_folder(out, options.overwrite, _MARK)
    _check_goal(goal_mm)
    check_names(names)
    target = api.find_target(Path(board))
    pattern, measured = api.read_board(target), paper_body() if body is None else read_body(body)
    with open_rig(sources_of(cameras, [], options.request), [], options) as opened:
        with new_folder(out, options.overwrite, _MARK):
            _begin(out, target, names)
        wave = api.BoardWave(pattern, {}, measured, goal_mm)
        return _wave(opened, wave, out, on_state, on_corners)


def _check_goal(goal_mm: float) -> None:
    if not (math.isfinite(goal_mm) and goal_mm > 0):
        raise ConfigError(f"--goal-mm {goal_mm:g}: expected a length in mm above 0")


def _wave(
    opened: OpenRig,
    wave: api.BoardWave,
    out: Path,
    on_state: Callable[[api.WaveState], None],
    on_corners: OnCorners,
) -> api.WaveState | None:
    """Gather pictures, and write those that the wave keeps."""
    state, rig, names = None, opened.cameras, [*opened.cameras.addresses]
    gathering = Gathering(names, on_read=rig.note_read)
    over = opened.begin(gathering.add)
    with ThreadPoolExecutor(len(names)) as pool:
        for one in gathering.frame_sets(over, rig.check):
            images = [*one.images.values()]
            seen = dict(zip(one.images, pool.map(partial(_look, wave.board), images), strict=True))
            views = {name: view for name, view in seen.items() if isinstance(view, api.Corners)}
            on_corners(images, {name: view.pixels for name, view in views.items()})
            wave.sizes_wh.update((i.camera, i.pixels.shape[1::-1]) for i in images)
            times_s = {image.camera: image.time_s for image in images}
            mirrored = [name for name, view in seen.items() if view == _MIRRORED]
            if len(wave.sizes_wh) == len(names) and wave.add(views, times_s, mirrored):
                _write(out, len(wave.kept), [i for i in images if i.camera in wave.kept[-1]])
            if wave.wants_a_closer_look:
                wave.look_closer([_gray(image) for image in images])
            on_state(state := wave.state())
            if state.enough:
                rig.stop()
    return state


def capture_body(
    cameras: Sequence[CameraAddress],
    out: Path,
    registry: api.Registry,
    options: CaptureOptions | None = None,
    *,
    body: Path | None = None,
    lenses: Path | None = None,
    goal_mm: float = 0.2,
    on_state: Callable[[api.WaveState], None] = lambda _: None,
    on_balls: OnBalls = lambda _images, _balls: None,
) -> api.WaveState | None:
    """Record a body that is waved, until its pictures are enough to calibrate the cameras by it.

    Args:
        out: the session; it names the body, and no calibration.
        options: how cameras are read; it ends when pictures are enough, too.
        body: the paper's three balls if omitted.
        lenses: calibration of the cameras' lenses; they are unknown if it is omitted.
        goal_mm: expected error of the body's position (standard deviation) that is good enough.
        on_state: called after every frame set that was looked at.
        on_balls: called before with the pictures, and what may be balls in each camera's.

    Returns:
        How far the pictures suffice; None if no picture came.

    Raises:
        MeasureError: what is wrong with cameras, lenses, body or folder.
    """
    options, names = options or CaptureOptions(), [one.name for one in cameras]
    options.check()
    check_folder(out, options.overwrite, SESSION)
    _check_goal(goal_mm)
    check_names(names)
    measured = paper_body() if body is None else read_body(body)
    known = None if lenses is None else api.read_intrinsics(lenses)
    if known is not None and (missing := [name for name in names if name not in known]):
        raise ConfigError(f"{lenses} has no lens of {', '.join(missing)}")
    wave = api.BodyWave(measured, {}, known, goal_mm)
    with open_rig(sources_of(cameras, [], options.request), [], options) as opened:
        recorder = new_recorder(out, opened, [measured], api.Calibration(()), "")
        with recorder:
            state = _wave_body(opened, wave, recorder, registry, on_state, on_balls)
            opened.cameras.wait()  # what is counted is to be in the folder
    return state


def _wave_body(
    opened: OpenRig,
    wave: api.BodyWave,
    recorder: Recorder,
    registry: api.Registry,
    on_state: Callable[[api.WaveState], None],
    on_balls: OnBalls,
) -> api.WaveState | None:
    """Record, and look at frame sets as fast as this computer can."""
    state, located, detectors = None, None, dict[str, Detector]()
    rig, names = opened.cameras, [*opened.cameras.addresses]
    gathering, profile = Gathering(names, on_read=rig.note_read), api.load_profile()

    def search(image: Image) -> Sequence[Detection]:
        return detectors[image.camera].detect(image, ())

    over = opened.begin(recorder.add, gathering.add)
    # A thread of this process that locates cameras waits for those that read and show pictures.
    with ThreadPoolExecutor(len(names)) as pool, processes(1) as locating:
        for one in gathering.frame_sets(over, rig.check):
            images = [*one.images.values()]
            wave.sizes_wh.update((i.camera, i.pixels.shape[1::-1]) for i in images)
            for name in wave.sizes_wh.keys() - detectors.keys():
                there = [api.Camera(name, wave.lens(name), api.RigidTransform.identity())]
                detectors |= api.build_detectors(profile, registry, wave.body, there)
            seen = dict(zip(one.images, pool.map(search, images), strict=True))
            on_balls(images, seen)
            wave.add(seen, one.time_s)
            if located is not None and located.done():
                wave.known, located = located.result(), None
            if located is None and wave.wants_locating:
                located = locating.submit(wave.copy().located)
            on_state(state := wave.state())
            if state.enough:
                rig.stop()
    return state


def _look(board: api.Board, image: Image) -> api.Corners | Literal["mirrored"] | None:
    try:
        return board.look(_gray(image))
    except api.MirroredBoardError:
        return _MIRRORED


def _gray(image: Image) -> Bytes:
    return np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY), np.uint8)


def _begin(out: Path, board: Path, names: Sequence[str]) -> None:
    """Write all but the pictures."""
    out.mkdir(parents=True, exist_ok=True)
    copy = f"board{board.suffix.lower()}"  # Kalibr's YAML stays one
    shutil.copyfile(board, out / copy)
    tables = [{"name": name, "intrinsics": f"{glob.escape(name)}/*.jpg"} for name in names]
    about = {"name": out.resolve().name, "board": copy, "common_views": True}
    (out / _MARK).write_text(dump_toml({"capture": about, "cameras": tables}), "utf-8")
    for name in names:
        (out / name).mkdir()


def _write(out: Path, number: int, images: Sequence[Image]) -> None:
    for image in images:
        jpeg = image.encoded or cv2.imencode(".jpg", image.pixels, _QUALITY)[1].tobytes()
        (out / image.camera / f"{number:06d}.jpg").write_bytes(jpeg)
