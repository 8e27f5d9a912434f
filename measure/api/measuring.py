"""Measuring an opened session, one frame set after the other."""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice

import numpy as np

from measure.api.profiles import build_pipeline
from measure.api.warming_up import warm_pipeline
from measure.host import Detector, Registry
from measure.measuring import Measurement, Pipeline, Profile, measure_together
from measure.measuring.burn_in import calibrated, enter_realtime
from measure.measuring.kept_rig import HOLDING, CameraChange, Keep
from measure.model import Body, Camera, Detection, FrameSet
from measure.session import Session

RUN_UP_S = 3.0
"""What trackers know at any time they have from little more than the last seconds."""
_FEW_AHEAD = 2  # Frame sets decoded ahead in the burn-in: it ends after some, and begins again
_RECALLED = 4
"""Power of two up to which the burn-in reaches; and enough frame sets for a ball to be found."""


def measure_session(
    session: Session, profile: Profile, registry: Registry
) -> Iterator[tuple[FrameSet, Measurement]]:
    """Each frame set of a session with its (first) body's measurement, once that is final."""
    pipeline = calibrated_pipeline(session, profile, registry)
    for frame_set, (measured,) in measure_frame_sets([pipeline], session.frame_sets()):
        yield frame_set, measured


def measure_bodies(
    session: Session,
    profile: Profile,
    registry: Registry,
    start: int = 0,
    keep: Keep | None = "off",
    earlier: Sequence[CameraChange] = (),
) -> Iterator[tuple[FrameSet, tuple[Measurement, ...]]]:
    """`measure_session` for all of `session.bodies`, in order, each with its own pipeline.

    From frame set `start` on: detectors calibrate themselves on the first ones all the same, and
    there is a run-up, which yields nothing. Cameras that are moved meanwhile are kept, see
    `keep_cameras`.
    """
    pipelines = [calibrated_pipeline(session, profile, registry, body) for body in session.bodies]
    keep_cameras(pipelines, keep, earlier, start)
    measured = measure_frame_sets(pipelines, _with_run_up(session, start))
    yield from (one for one in measured if one[0].index >= start)


def why_not_kept(bodies: int, cameras: int) -> str:
    """Why cameras that are moved cannot be noticed and brought back; empty if they can."""
    if bodies > 1:
        return "cameras are not followed where several bodies are measured"
    if cameras <= HOLDING:
        return "cameras are not followed: of two that disagree nobody can tell which was moved"
    return ""


def keep_cameras(
    pipelines: Sequence[Pipeline],
    keep: Keep | None,
    earlier: Sequence[CameraChange] = (),
    start: int = 0,
) -> None:
    """Let pipelines notice cameras that are moved.

    Args:
        keep: "warn" only notices them. Otherwise those that were knocked are brought back; "follow"
            also follows those that drift.
        earlier: what was noticed before frame set `start`.
    """
    one = pipelines[0]
    # A detector that remembers pictures would take those of the search as more of them.
    remembers = any(detector.stateful for detector in one.stages.detectors.values())
    if keep != "off" and not remembers and not why_not_kept(len(pipelines), len(one.cameras)):
        from measure.calibration.keeping import CameraKeeper

        follows, drifts = keep != "warn", keep == "follow"
        one.keeper = CameraKeeper(one.body, one.cameras, follows, earlier, start, drifts)


def _with_run_up(session: Session, start: int) -> Iterator[FrameSet]:
    """The frame sets from `start` on, and those before it that it takes to measure them alike.

    That is the last seconds, for trackers; and a few frame sets each at 16, 32, 64, ... from the
    recording's begin on, for detectors whose estimates wait longer and longer for each other.
    """
    times_s = session.pair().times_s
    last = int(np.searchsorted(times_s, times_s[start] - RUN_UP_S)) if start else 0
    for power in range(_RECALLED, last.bit_length()):
        # Left as soon as it is read: no longer is ahead than is measured.
        few = range(2**power - 1, min(2**power - 1 + _RECALLED, last))
        yield from islice(session.frame_sets(start=few.start, prefetch=len(few)), len(few))
    yield from session.frame_sets(start=last)


def measure_frame_sets(
    pipelines: Sequence[Pipeline], frame_sets: Iterable[FrameSet]
) -> Iterator[tuple[FrameSet, tuple[Measurement, ...]]]:
    """Each frame set with its measurements, as soon as these are final; in order of time."""
    waiting: deque[FrameSet] = deque()

    def remember() -> Iterator[FrameSet]:
        for frame_set in frame_sets:
            waiting.append(frame_set)
            yield frame_set

    gc.freeze()  # what is loaded by now stays: each look through it would hold up a live pose
    try:
        for measured in measure_together(pipelines, remember()):
            yield waiting.popleft(), measured
    finally:
        gc.unfreeze()


def calibrated_pipeline(
    session: Session, profile: Profile, registry: Registry, body: Body | None = None, start: int = 0
) -> Pipeline:
    """A warm pipeline whose detectors have calibrated themselves on the frame sets from `start`.

    It measures the session's body, or another one. Raises as `build_pipeline`; SessionError: no two
    cameras have images close enough in time.
    """
    pipeline = warm_pipeline(profile, registry, body or session.body, session.cameras)
    build = partial(build_pipeline, profile, registry)
    return calibrated(pipeline, build, partial(session.frame_sets, _FEW_AHEAD, start))


def live_pipelines(
    warm: Sequence[Pipeline],
    build: Callable[[Body, Sequence[Camera]], Pipeline],
    frame_sets: Callable[[], Iterator[FrameSet]],
) -> list[Pipeline]:
    """Pipelines whose detectors have calibrated themselves on what comes now, and keep up with it.

    Args:
        warm: one for each body.
        build: builds such a one anew.
        frame_sets: gives those that come from the call on.
    """
    pipelines = [calibrated(one, build, frame_sets) for one in warm]
    for one in pipelines:
        enter_realtime(one.stages.detectors)
    return pipelines


def search_frame_sets(
    session: Session, searches: Sequence[Mapping[str, Detector]], chosen: Iterable[int]
) -> Iterator[tuple[FrameSet, list[dict[str, list[Detection]]]]]:
    """Some frame sets, and by camera what each search found in the whole pictures."""
    with ThreadPoolExecutor(len(session.cameras)) as pool:
        for index in chosen:
            frame_set = next(iter(session.frame_sets(start=index, prefetch=1)))
            images = frame_set.images
            found = []
            for by_camera in searches:
                some = pool.map(lambda n, d=by_camera, i=images: d[n].detect(i[n], ()), images)
                found.append(dict(zip(images, some, strict=True)))
            yield frame_set, found
