"""`measure evaluate`: a run against the truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.results.summary import WHICH_ACCURACY


def evaluate(
    run: Path,
    /,
    *,
    truth: Path | None = None,
    calibration: Path | None = None,
    marks: Path | None = None,
    find_offset: bool = False,
    truth_body: str | None = None,
    body: str | None = None,
    json: JsonFlag = False,
) -> None:
    """Compare a run with the truth.

    Prints the error of single balls and of the body as in the paper's Table I (RMS about zero, SD
    about the mean), how many frame sets have no pose, the rotation, each kind of error alone, and
    whether the reported covariances hold. A pose is compared at its own time; the truth is
    interpolated.

    Args:
        run: the run's folder.
        truth: poses over time (time_s,x_mm,...,qz; TUM; EuRoC; `rostopic echo -p`; bag#topic; an
            export of rigid bodies by Motive, Vicon, Qualisys or NDI); those of the session if
            omitted.
        calibration: where the cameras really are, if known: separates errors of detection from
            those of camera localisation.
        marks: ball centres marked by hand (camera,frame,ball,u_px,v_px) to compare detection with.
        find_offset: find by motion what to add to the truth's times, and fit its frames to the run
            if they are others; refused where the motion does not determine it.
        truth_body: which rigid body of a tracker's file or a bag, or of a table with a column
            `body`.
        body: which body, of a run of several; each if omitted.
    """
    names = api.body_names(run)
    every = {
        name: api.evaluate(
            run,
            truth,
            calibration,
            marks,
            find_offset=find_offset,
            truth_body=truth_body,
            body=name,
        )
        for name in (names if body is None else [body])
    }
    if json:
        values = {name: dataclasses.asdict(found) for name, found in every.items()}
        one = next(iter(values.values())) if len(values) == 1 else {"bodies": values}
        console.print_json({"run": str(run), **one})
        return
    for name, found in every.items():
        about = f"{name}: " if len(names) > 1 else ""
        for table in api.evaluation_tables(found):
            console.print_table(table.columns, table.rows, f"{about}{table.title}")
            console.print_text("")
        for note in found.notes:
            console.print_text(f"note: {about}{note}")
    console.print_text(WHICH_ACCURACY["measured"])
