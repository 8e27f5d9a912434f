"""`measure capture`: pictures of a waved board."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

from measure.api import WaveState
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile
from measure.cli.options import FIELDS
from measure_studio import api as studio_api
from measure_studio.cli.record import LINE_EVERY_S


def capture(
    *cameras: str,
    board: str,
    out: OutFile,
    body: Path | None = None,
    goal_mm: float = 0.2,
    options: Annotated[studio_api.CaptureOptions, FIELDS] = studio_api.CaptureOptions(),
    json: JsonFlag = False,
) -> int:
    """Take pictures of a waved board, and stop when there are enough.

    Those are kept that add something. They are enough when the calibration they give will let the
    body's position be known well enough. Lines say what to do next. The exit code is 3 if it ends
    before that.

    Args:
        cameras: NAME=ADDRESS each, as for `measure record`.
        board: the board's target file, or the name of one that comes with the program.
        out: the capture folder for `measure calibrate`.
        body: body that will be measured; the paper's three-ball body if omitted.
        goal_mm: expected error of the body's position at which to stop.
    """
    given, last = studio_api.parse_cameras(cameras), [time.monotonic()]

    def tell(state: WaveState) -> None:
        if time.monotonic() - last[0] >= LINE_EVERY_S:
            last[0] = time.monotonic()
            console.note(f"{state.sentence()}; {', '.join(state.advice[:3])}")

    state = studio_api.capture_board(
        given, board, out, options, body=body, goal_mm=goal_mm, on_state=tell
    )
    if json:
        console.print_json({"capture": out, "state": state})
    elif state is not None:
        seen = {name: one for name, one in state.cameras.items() if one.views}
        console.print_table(
            ("camera", "views", "tilted", "farthest over nearest"),
            [(name, one.views, one.tilts, one.distances) for name, one in seen.items()],
        )
        for line in (*state.advice, state.sentence()):
            console.print_text(line)
        written = f"next: measure calibrate {out} -o calibration.toml"
        console.print_text(f"written to {out}; {written}" if seen else "no picture was kept")
    return 0 if state is not None and state.enough else console.UNBELIEVABLE
