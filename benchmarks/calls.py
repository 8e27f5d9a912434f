"""How many functions one tracked frame set enters: `python -m benchmarks.calls SESSION`."""

from __future__ import annotations

import sys
from collections import Counter
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any

import measure
from measure.api import load_profile
from measure.api.measuring import calibrated_pipeline, measure_frame_sets
from measure.host import Registry
from measure.session import open_session

_BEFORE = 18  # Frame sets, in which detectors and motion filter settle
_OURS = str(Path(measure.__file__).parent), "measure_plugins"


def main() -> None:
    """Print the functions entered, their files, and how deep they are."""
    entered, depths = Counter[str](), [0, 0]

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if not any(place in code.co_filename for place in _OURS):
            return
        if event == "call":
            depths[0] += 1
            depths[1] = max(depths)
            entered[code.co_filename] += not code.co_name.startswith("<")
        elif event == "return":
            depths[0] -= 1

    with open_session(Path(sys.argv[1])) as session:
        pipeline = calibrated_pipeline(session, load_profile(), Registry.discover())
        measured = measure_frame_sets([pipeline], session.frame_sets())
        for _ in islice(measured, _BEFORE):
            pass
        sys.setprofile(note)
        next(measured)
        sys.setprofile(None)
    files = len(+entered)
    print(f"{entered.total()} functions in {files} files, {depths[1]} deep")


if __name__ == "__main__":
    main()
