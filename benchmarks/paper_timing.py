"""Time of the paper's stages per frame set: `python -m benchmarks.paper_timing SESSION...`.

CPU time on one thread, pictures decoded beforehand, as a multiple of one
`cv2.cvtColor(BGR2HSV)` of one picture in the same process. *Acquisition* searches whole frames with
`hough`; *windows* is `hough` where frame-update expects the circles; *the rest* is judging,
triangulating and solving.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ParamSpec, TypeVar

import cv2
import numpy as np

from benchmarks.command import run_command
from benchmarks.trial import reference_s
from measure.api import load_profile
from measure.host import Detector, PoseSolver, Registry, Triangulator
from measure.measuring import Stages
from measure.model import Detection, Expectation, FrameSet, Image
from measure.session import Session, open_session
from measure_paper.tracking import FrameUpdate, FrameUpdateSettings

P = ParamSpec("P")
T = TypeVar("T")


def main() -> None:
    """Print one line per session."""
    parser = argparse.ArgumentParser(prog="benchmarks.paper_timing", description=__doc__)
    parser.add_argument("sessions", nargs="+", type=Path, help="session folders")
    parser.add_argument("--circles", type=int, default=1, help="k of the whole-frame search")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'session':12} {'reference ms':>13} {'acquisition':>12} {'windows':>8} {'the rest':>9}")
    for folder in given.sessions:
        session = open_session(folder)
        reference, *stages = _time(session, given.circles)
        ratios = [stage / reference for stage in stages]
        print(
            f"{session.name:12} {1e3 * reference:13.3f} "
            f"{ratios[0]:10.0f} x {ratios[1]:6.1f} x {ratios[2]:7.1f} x"
        )


def _time(session: Session, circles: int) -> tuple[float, ...]:
    """Reference operation, acquisition, windows and the rest, in s; medians over frame sets."""
    profile, registry = load_profile("paper"), Registry.discover()
    detectors = {
        camera.name: registry.build(
            Detector, "hough", {"circles": circles}, body=session.body, camera=camera
        )
        for camera in session.cameras
    }
    triangulator = registry.build(Triangulator, profile.triangulator, {})
    solver = registry.build(PoseSolver, profile.solver, {}, body=session.body)
    tracker = FrameUpdate(FrameUpdateSettings(), session.body, session.cameras)
    references, searches, windows, rests = [], [], [], []
    for frame_set in session.frame_sets():
        images = frame_set.images
        references.append(reference_s(next(iter(images.values())).pixels))
        nowhere: dict[str, Sequence[Expectation]] = dict.fromkeys(images, ())
        _ = [image.pixels for image in images.values()]
        found, seconds = _timed(_detect, detectors, images, nowhere)
        searches.append(seconds)
        expected = tracker.expect(frame_set)
        if expected is None:
            continue
        if all(len(balls) == len(session.body.balls) for balls in expected.values()):
            found, seconds = _timed(_detect, detectors, images, expected)
            windows.append(seconds)
        stages = Stages(
            detectors,
            tracker,
            triangulator,
            solver,
            per_image_timestamps=False,
            smoothing=False,
            remeasure_after_search=False,
        )
        rests.append(_timed(_conclude, frame_set, found, stages, session)[1])
    return tuple(
        float(np.median(spent)) if spent else float("nan")
        for spent in (references, searches, windows, rests)
    )


def _detect(
    detectors: Mapping[str, Detector],
    images: Mapping[str, Image],
    expected: Mapping[str, Sequence[Expectation]],
) -> dict[str, list[Detection]]:
    return {name: detectors[name].detect(image, expected[name]) for name, image in images.items()}


def _conclude(
    frame_set: FrameSet, found: Mapping[str, list[Detection]], stages: Stages, session: Session
) -> None:
    cameras = {camera.name: camera for camera in session.cameras}
    views = stages.tracker.judge(frame_set, found)
    seen = [view.detection for view in views if view.effective and view.detection]
    by_ball = ([d for d in seen if d.ball == name] for name in session.body.names)
    located = (stages.triangulator.triangulate(mine, cameras) for mine in by_ball if len(mine) > 1)
    positions = [position for position in located if position is not None]
    pose = stages.solver.solve(positions, seen, cameras, frame_set.time_s) if seen else None
    stages.tracker.conclude(frame_set, views, positions, pose, {})


def _timed(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> tuple[T, float]:
    start = time.process_time()
    result = work(*args, **kwargs)
    return result, time.process_time() - start


if __name__ == "__main__":
    run_command(main)
