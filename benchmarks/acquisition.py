"""How often the body is found from nothing: `python -m benchmarks.acquisition SESSION...`.

Every frame set is taken alone, as if it were the first of a recording: whole pictures are searched,
the body is distinguished from other things and measured. One line per session: frame sets; those
with a pose (*acquired*), with a *flagged* one, with an unflagged one more than 2 mm from the truth
(*wrong*); RMS error of the poses; how many *candidates* all pictures gave together and how
many of them were *recognised* as balls of the body, on the average; CPU time of searching the
pictures and of associating the candidates, the median over frame sets of the best of some repeats,
in multiples of one `cv2.cvtColor(BGR2HSV)` of one picture.

`--frames` prints every frame set that has no pose or a flag, how far off it is, and why.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import pose_error, rms, truth_of
from benchmarks.trial import WRONG_MM, reference_s
from measure.api import build_pipeline, load_profile
from measure.host import Registry
from measure.measuring import Measurement, Status
from measure.measuring.association import Association, associate
from measure.model import Detection, FrameSet
from measure.session import Session, Trajectory, open_session


@dataclass(frozen=True)
class Acquisition:
    """One frame set, searched from nothing.

    Attributes:
        index: of the frame set.
        status: of its measurement.
        reason: why there is no pose, or why it is flagged, in words.
        error_mm: of the pose; NaN without one.
        error_deg: the same.
        candidates: in all pictures.
        recognised: those of them that are balls of the body.
        search_ref: CPU time of finding the candidates, in reference operations.
        associate_ref: CPU time of recognising the body among them, likewise.
    """

    index: int
    status: Status
    reason: str
    error_mm: float
    error_deg: float
    candidates: int
    recognised: int
    search_ref: float
    associate_ref: float


def main() -> None:
    """Print one line per session."""
    parser = argparse.ArgumentParser(prog="benchmarks.acquisition", description=__doc__)
    parser.add_argument("sessions", nargs="+", type=Path, help="session folders with truth")
    parser.add_argument("--profile", default="precise", help="the profile's name or file")
    parser.add_argument("--repeats", type=int, default=3, help="times each picture is searched")
    parser.add_argument(
        "--frames", action="store_true", help="print what was not acquired, and why"
    )
    given = parser.parse_args()
    cv2.setNumThreads(1)
    names = ("acquired", "flagged", "wrong", "mm", "deg", "candidates", "recognised", "search")
    print(f"{'session':16}{'sets':>6}" + "".join(f"{n:>11}" for n in (*names, "associate")))
    for folder in given.sessions:
        truth = truth_of(folder)
        with open_session(folder) as session:
            rows = list(acquisitions(session, truth, given.profile, given.repeats))
            views = len(session.body.balls) * len(session.cameras)
        print(f"{folder.name:16}{_line(rows, views)}", flush=True)
        for row in rows if given.frames else ():
            if row.reason:
                off = f", {row.error_mm:.3f} mm and {row.error_deg:.2f} deg off"
                posed = off if row.error_mm >= 0 else ""
                print(f"    {row.index} {row.status.value}{posed}: {row.reason}")


def acquisitions(
    session: Session, truth: Trajectory, profile: str, repeats: int
) -> Iterator[Acquisition]:
    """Search every frame set of a session with a new pipeline."""
    registry = Registry.discover()
    for number, frame_set in enumerate(session.frame_sets()):
        pipeline = build_pipeline(load_profile(profile), registry, session.body, session.cameras)
        if number == 0:
            pipeline.warm_up()
        reference = min(reference_s(image.pixels) for image in frame_set.images.values())
        searched, associated = [], []
        for _ in range(repeats):
            start = time.thread_time()
            seen = {
                name: pipeline.stages.detectors[name].detect(image, ())
                for name, image in frame_set.images.items()
            }
            searched.append(time.thread_time() - start)
            start = time.thread_time()
            found = associate(session.body, session.cameras, seen)
            associated.append(time.thread_time() - start)
        measured = next(iter(pipeline.measure([frame_set])))
        times = min(searched) / reference, min(associated) / reference
        yield _acquisition(frame_set, measured, truth, seen, found, times)


def _acquisition(
    frame_set: FrameSet,
    measured: Measurement,
    truth: Trajectory,
    seen: dict[str, list[Detection]],
    found: Association,
    times_ref: tuple[float, float],
) -> Acquisition:
    error = pose_error(measured, truth)
    reason = measured.reason if measured.pose is None else "; ".join(measured.pose.flags)
    places = {(d.camera, *d.center_px) for some in seen.values() for d in some}
    return Acquisition(
        index=frame_set.index,
        status=measured.status,
        reason=reason,
        error_mm=float(np.linalg.norm(error[:3])),
        error_deg=float(np.degrees(np.linalg.norm(error[3:]))),
        candidates=len(places),
        recognised=len(found.detections),
        search_ref=times_ref[0],
        associate_ref=times_ref[1],
    )


def _line(rows: Sequence[Acquisition], views: int) -> str:
    posed = [row for row in rows if not np.isnan(row.error_mm)]
    flagged = sum(row.status is Status.FLAGGED for row in rows)
    wrong = sum(row.status is Status.OK and row.error_mm > WRONG_MM for row in rows)
    mm, deg = (
        rms(np.array([[getattr(row, n)] for row in posed])) for n in ("error_mm", "error_deg")
    )
    candidates, recognised, search, associated = (
        [getattr(row, name) for row in rows]
        for name in ("candidates", "recognised", "search_ref", "associate_ref")
    )
    return (
        f"{len(rows):6}{len(posed):11}{flagged:11}{wrong:11}{mm:11.4f}{deg:11.4f}"
        f"{np.mean(candidates):11.1f}{np.mean(recognised):7.1f}/{views:<3}"
        f"{np.median(search):9.2f} x{np.median(associated):9.2f} x"
    )


if __name__ == "__main__":
    run_command(main)
