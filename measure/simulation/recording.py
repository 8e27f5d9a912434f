"""Writing a scene as a session folder (docs/files.md), with its exact truth."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Bytes, Floats
from measure.geometry import RigidTransform
from measure.model import Body, Camera
from measure.processes import Progress
from measure.simulation.renderer import Renderer
from measure.simulation.scene import Scene
from measure.simulation.sensor import encode

TRUTH_HZ = 480.0
_TRUTH_MARGIN_S = 0.05


def write_session(
    scene: Scene,
    times_s: ArrayLike | Mapping[str, ArrayLike],
    folder: str | Path,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Render a scene into a session folder.

    Args:
        scene: what to render. The files state `scene.stated_cameras` and `scene.stated_body` where
            those are given.
        times_s: (n,) nominal instants, to which every camera adds its phase; or the mid-exposure
            times of each camera by name.
        folder: made if missing; the numbered pictures of an earlier session in it are removed.
        workers: threads, one camera each; as many as there are cores by default.
        progress: called with pictures done and in all.

    Returns:
        The folder.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stamps = camera_times(scene, times_s)
    total, done = sum(len(t) for t in stamps.values()), iter(range(1, 1 << 60))

    def record(name: str) -> str:
        pictures = _pictures(scene, name, stamps[name])
        if progress is not None:
            pictures = _counted(pictures, lambda: progress(next(done), total))
        write_stamps(folder / f"{name}.csv", stamps[name])
        return _write_images(pictures, scene, name, folder)

    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        sources = dict(zip(stamps, pool.map(record, stamps), strict=True))
    _write_texts(scene, sources, stamps, folder)
    return folder


def camera_times(scene: Scene, times_s: ArrayLike | Mapping[str, ArrayLike]) -> dict[str, Floats]:
    """Mid-exposure times (n,) of every camera by name."""
    if isinstance(times_s, Mapping):
        return {name: np.asarray(t, dtype=np.float64) for name, t in times_s.items()}
    nominal = np.asarray(times_s, dtype=np.float64)
    return {c.name: nominal + scene.phases_s.get(c.name, 0.0) for c in scene.cameras}


def _pictures(scene: Scene, camera: str, times_s: Floats) -> Iterator[Bytes]:
    renderer = Renderer(scene, camera)
    for frame, time_s in enumerate(times_s):
        yield renderer.picture(float(time_s), frame)


def _counted(pictures: Iterator[Bytes], count: Callable[[], None]) -> Iterator[Bytes]:
    for picture in pictures:
        yield picture
        count()


def _write_images(pictures: Iterator[Bytes], scene: Scene, camera: str, folder: Path) -> str:
    sensor = scene.sensor_of(camera)
    (folder / camera).mkdir(exist_ok=True)
    for old in (folder / camera).glob(f"[0-9]*.{sensor.encoding}"):
        old.unlink()
    for frame, picture in enumerate(pictures):
        path = folder / camera / f"{frame:06d}.{sensor.encoding}"
        path.write_bytes(encode(picture, sensor))
    return f"{camera}/*.{sensor.encoding}"


def _write_texts(
    scene: Scene, sources: dict[str, str], stamps: dict[str, Floats], folder: Path
) -> None:
    texts = {
        "session.toml": session_toml(scene.name, scene.description, sources),
        "body.toml": body_toml(scene.stated_body or scene.body),
        "calibration.toml": calibration_toml(scene.stated_cameras or scene.cameras),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    every = np.concatenate(list(stamps.values()))
    first, last = every.min() - _TRUTH_MARGIN_S, every.max() + _TRUTH_MARGIN_S
    times = np.arange(np.floor(first * TRUTH_HZ), np.ceil(last * TRUTH_HZ) + 1) / TRUTH_HZ
    write_truth(folder / "truth.csv", times, scene.trajectory.at(times))


def body_toml(body: Body) -> str:
    """The body file; colours are written by name."""
    lines = [f"name = {json.dumps(body.name)}"]
    for ball in body.balls:
        lines += [
            "",
            "[[balls]]",
            f"name = {json.dumps(ball.name)}",
            f"color = {json.dumps(ball.color.name)}",
            f"center_mm = {_row(ball.center_mm)}",
            f"radius_mm = {ball.radius_mm!r}",
        ]
    return "\n".join(lines) + "\n"


def calibration_toml(cameras: tuple[Camera, ...]) -> str:
    """The calibration file: exact, so without covariances."""
    lines: list[str] = []
    for camera in cameras:
        lens, pose = camera.intrinsics, camera.world_from_camera
        matrix = ", ".join(_row(row) for row in lens.matrix)
        lines += [
            "[[cameras]]",
            f"name = {json.dumps(camera.name)}",
            f"size_wh = [{lens.size_wh[0]}, {lens.size_wh[1]}]",
            f"matrix = [{matrix}]",
            *([] if lens.model == "pinhole" else [f"model = {json.dumps(lens.model)}"]),
            f"distortion = {_row(lens.coefficients)}",
            f"quat_wxyz = {_row(pose.quat_wxyz)}",
            f"translation_mm = {_row(pose.translation)}",
        ]
        if camera.readout_s:
            lines.append(f"readout_s = {camera.readout_s!r}")
        lines.append("")
    return "\n".join(lines)


def session_toml(name: str, description: str, sources: dict[str, str]) -> str:
    """The session file; `sources` are the cameras' image patterns."""
    lines = [
        "[session]",
        f"name = {json.dumps(name)}",
        f"description = {json.dumps(description)}",
        'body = "body.toml"',
        'calibration = "calibration.toml"',
        'truth = "truth.csv"',
    ]
    for camera, source in sources.items():
        lines += ["", "[[cameras]]", f"name = {json.dumps(camera)}"]
        lines += [f"images = {json.dumps(source)}", f"timestamps = {json.dumps(camera + '.csv')}"]
    return "\n".join(lines) + "\n"


def write_stamps(path: Path, times_s: Floats) -> None:
    """Frame numbers and mid-exposure times."""
    rows = [f"{k},{t:.9f}" for k, t in enumerate(times_s)]
    path.write_text("\n".join(["frame,time_s", *rows]) + "\n", encoding="utf-8")


def write_truth(path: Path, times_s: Floats, world_from_body: RigidTransform) -> None:
    """A trajectory, world_from_body at times (n,)."""
    quats = world_from_body.quat_wxyz
    rows = [
        f"{t:.9f}," + ",".join(f"{x:.6f}" for x in p) + "," + ",".join(f"{x:.9f}" for x in q)
        for t, p, q in zip(times_s, world_from_body.translation, quats, strict=True)
    ]
    header = "time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def _row(values: Floats) -> str:
    return "[" + ", ".join(repr(float(x)) for x in np.asarray(values).ravel()) + "]"
