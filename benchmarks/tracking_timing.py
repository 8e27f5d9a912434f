"""Time of tracking with the precise profile: `python -m benchmarks.tracking_timing SESSION...`.

All figures are multiples of one `cv2.cvtColor(BGR2HSV)` of one picture, timed in the same process.
For the stages of tracking that is CPU time per frame set on one core, pictures decoded before,
the median over frame sets of the best of some repeats; *the rest* is predicting, judging and what
lies between the stages. *first* is the whole first frame set, in which the body is searched; the
last two columns are its acquisition, from decoded pictures to named and located balls: *search*,
all candidates of all pictures with a rough outline of each, and *associate*, which of them are the
body. What *first* costs beyond them every tracked frame set costs as well: the outlines measured
precisely, poses solved; and the step gain of each ball. `measure run` self-calibrates before, in
the burn-in on the first eight or so; here it happens on the way.

`--whole` measures the session's pictures forth and back many times over with everything that
`measure run` does, images not logged: frame sets per second of the clock, from the first frame set
to the last, and CPU time per frame set.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.command import run_command
from benchmarks.trial import reference_s
from measure.api import build_pipeline, load_profile, run
from measure.arrays import Floats
from measure.host import Registry
from measure.model import Camera, FrameSet, Image
from measure.session import Session, open_session

STAGES = ("detect", "triangulate", "solve")


def main() -> None:
    """Print one line per session."""
    parser = argparse.ArgumentParser(prog="benchmarks.tracking_timing", description=__doc__)
    parser.add_argument("sessions", nargs="+", type=Path, help="session folders")
    parser.add_argument("--profile", default="precise", help="the profile's name or file")
    parser.add_argument("--repeats", type=int, default=5, help="times each session is measured")
    parser.add_argument("--whole", action="store_true", help="time `measure run` as well")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    names = ("reference ms", *STAGES, "the rest", "all", "first", "search", "associate")
    print(f"{'session':12}" + "".join(f"{name:>13}" for name in names))
    for folder in given.sessions:
        with open_session(folder) as session, one_core():
            reference, table, first = stages(session, given.profile, given.repeats)
        ratios = "".join(f"{value / reference:11.2f} x" for value in (*table, *first))
        print(f"{session.name:12}{1e3 * reference:13.3f}{ratios}")
        if given.whole:
            print(f"{'':12}{_whole(folder, given.profile, reference)}")


@contextmanager
def one_core() -> Iterator[None]:
    """Hold the process to one core: threads side by side take each other's cache and memory."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def _watch(stage: object, method: str, spent: list[float]) -> None:
    """Note the CPU time of every call of a stage's method."""
    work = getattr(stage, method)

    def timed(*args: Any, **kwargs: Any) -> Any:
        start = time.thread_time()
        try:
            return work(*args, **kwargs)
        finally:
            spent.append(time.thread_time() - start)

    setattr(stage, method, timed)


def stages(session: Session, profile: str, repeats: int) -> tuple[float, Floats, Floats]:
    """CPU time in s of the reference operation, of tracking and of the first frame set.

    Returns:
        Reference; the stages, the rest, all (5,); the first frame set, its search, its
        association (3,).
    """
    sets = [_decoded(frame_set) for frame_set in session.frame_sets()]
    registry = Registry.discover()
    tables, begins, references = [], [], []
    for _ in range(repeats):
        references.append(reference_s(next(iter(sets[0].images.values())).pixels))
        table, acquisition = _once(session, profile, registry, sets)
        tables.append(table)
        begins.append([table[0, -1], *acquisition])
    best = np.min(tables, axis=0)
    return min(references), np.median(best[1:], axis=0), np.min(begins, axis=0)


def _once(
    session: Session, profile: str, registry: Registry, sets: Sequence[FrameSet]
) -> tuple[Floats, tuple[float, float]]:
    """(n, 5) s of every frame set: the stages, the rest, all; and the first search, association."""
    pipeline = build_pipeline(load_profile(profile), registry, session.body, session.cameras)
    spent: dict[str, list[float]] = {stage: [] for stage in (*STAGES, "judge")}
    for detector in pipeline.stages.detectors.values():
        _watch(detector, "detect", spent["detect"])
    _watch(pipeline.stages.triangulator, "triangulate_all", spent["triangulate"])
    _watch(pipeline.stages.solver, "solve", spent["solve"])
    _watch(pipeline.stages.tracker, "judge", spent["judge"])
    pipeline.warm_up()
    rows: list[list[float]] = []
    start, acquisition = 0.0, (0.0, 0.0)

    def note() -> None:
        nonlocal acquisition
        whole = time.process_time() - start
        if not rows:  # every camera is searched, then the tracker judges; both are done again later
            acquisition = sum(spent["detect"][: len(sets[0].images)]), spent["judge"][0]
        parts = [sum(spent[stage]) for stage in STAGES]
        rows.append([*parts, whole - sum(parts), whole])
        for times in spent.values():
            times.clear()

    def handed_out() -> Iterator[FrameSet]:
        """Poses come some frame sets late: the time runs from one frame set's start to the next."""
        nonlocal start
        for number, frame_set in enumerate(sets):
            if number:
                note()
            start = time.process_time()
            yield frame_set
        note()

    for _ in pipeline.measure(handed_out()):
        pass
    return np.array(rows), acquisition


def _decoded(frame_set: FrameSet) -> FrameSet:
    return replace(
        frame_set,
        images={name: _held(image, image.pixels) for name, image in frame_set.images.items()},
    )


def _held(image: Image, pixels: Any) -> Image:
    return Image(image.camera, image.frame, image.time_s, lambda: pixels)


def _whole(folder: Path, profile: str, reference: float, frames: int = 400) -> str:
    """`measure run` on a long session: the pace, and CPU time per frame set."""
    wall, cpu, whole = whole_run(folder, profile, frames)
    return (
        f"measure run: {1 / wall:.1f} frame sets per s; CPU {1e3 * cpu:.1f} ms a frame set "
        f"({cpu / reference:.1f} x); {frames} frame sets in {whole:.1f} s with start and end"
    )


def whole_run(folder: Path, profile: str, frames: int) -> tuple[float, float, float]:
    """Time and CPU time per frame set of `measure run`; and its time with start and end, in s."""
    stamps: list[tuple[float, float]] = []

    def report(done: int, total: int | None) -> None:  # noqa: ARG001
        stamps.append((time.perf_counter(), time.process_time()))

    with tempfile.TemporaryDirectory() as scratch:
        session = Path(scratch) / "session"
        long_session(folder, session, frames)
        begin = time.perf_counter()
        run(
            session, Path(scratch) / "run", load_profile(profile), Registry.discover(), None, report
        )
        whole = time.perf_counter() - begin
    wall, cpu = np.subtract(stamps[-1], stamps[0]) / (len(stamps) - 1)
    return float(wall), float(cpu), whole


def long_session(folder: Path, out: Path, frames: int) -> None:
    """A session of `frames` frames: links to the pictures of another, forth and back."""
    with open_session(folder) as session:
        out.mkdir(parents=True)
        text = (folder / "session.toml").read_text("utf-8")
        (out / "session.toml").write_text(text.replace('truth = "truth.csv"\n', ""), "utf-8")
        for name in ("body.toml", "calibration.toml"):
            (out / name).symlink_to((folder / name).resolve())
        for camera in session.cameras:
            _long_stream(session, camera, out, frames)


def _long_stream(session: Session, camera: Camera, out: Path, frames: int) -> None:
    stream = session.streams[camera.name]
    count = len(stream)
    there_and_back = [*range(count), *range(count - 2, 0, -1)]
    times, rows, time_s = stream.times_s, ["frame,time_s"], float(stream.times_s[0])
    (out / camera.name).mkdir()
    before = 0
    for frame in range(frames):
        at = there_and_back[frame % len(there_and_back)]
        time_s += abs(float(times[at] - times[before]))
        before = at
        rows.append(f"{frame},{time_s:.9f}")
        file = stream.files[at]
        (out / camera.name / f"{frame:06d}{file.suffix}").symlink_to(file.resolve())
    (out / f"{camera.name}.csv").write_text("\n".join(rows) + "\n", "utf-8")


if __name__ == "__main__":
    run_command(main)
