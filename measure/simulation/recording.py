"""Writing a scene as a session folder, with its exact truth."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Bytes, Floats
from measure.processes import Progress
from measure.simulation.files import (
    body_toml,
    calibration_toml,
    session_toml,
    write_stamps,
    write_truth,
)
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
