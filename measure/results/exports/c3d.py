"""C3D, the binary marker format of motion laboratories, written by ezc3d."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np

from measure.results.exports.markers import markers_of
from measure.results.run import Run

CHANNELS = ("time_s", "frame")


def write(run: Run, path: Path) -> None:
    """Write every frame set; a marker that was not located is invalid there.

    C3D knows a rate, but no times: those since the first frame set stand in the analog channel
    `time_s`, the frame set's number in `frame`.
    """
    import ezc3d

    markers = markers_of(run)
    count = len(markers.times_s)
    file = ezc3d.c3d()
    points = file["parameters"]["POINT"]
    points["RATE"]["value"] = [markers.rate_hz]
    points["LABELS"]["value"] = list(markers.names)
    points["UNITS"]["value"] = ["mm"]
    homogeneous = np.ones((4, len(markers.names), count))
    homogeneous[:3] = markers.points_mm.transpose(2, 1, 0)
    file["data"]["points"] = homogeneous
    analog = file["parameters"]["ANALOG"]
    analog["RATE"]["value"] = [markers.rate_hz]
    analog["LABELS"]["value"] = list(CHANNELS)
    analog["UNITS"]["value"] = ["s", ""]
    channels = np.stack([markers.times_s - markers.times_s[0], np.arange(count)])
    file["data"]["analogs"] = channels[None]
    # ezc3d says nothing of a file that it could not write, and knows UTF-8 names only: it writes
    # where it can, and what it wrote is copied.
    with tempfile.TemporaryDirectory() as scratch:
        whole = Path(scratch) / "run.c3d"
        file.write(str(whole))
        least = 4 * (homogeneous.size + channels.size)
        if not whole.exists() or whole.stat().st_size < least:
            raise OSError(f"{scratch} did not take its {least} bytes: is the disk full?")
        shutil.copyfile(whole, path)
