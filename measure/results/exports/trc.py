"""TRC (Track Row Column), the marker format of OpenSim; millimetres, real times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.results.exports.markers import markers_of
from measure.results.run import Run

_HEADINGS = (
    *("DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"),
    *("OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"),
)


def write(run: Run, path: Path) -> None:
    """Write every frame set; a marker that was not located is left empty."""
    markers = markers_of(run)
    count, rate = len(markers.times_s), f"{markers.rate_hz:.6f}"
    coordinates = [f"{axis}{k}" for k in range(1, len(markers.names) + 1) for axis in "XYZ"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "\t".join(_HEADINGS),
        f"{rate}\t{rate}\t{count}\t{len(markers.names)}\tmm\t{rate}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(markers.names) + "\t\t",
        "\t\t" + "\t".join(coordinates),
        "",
    ]
    for k in range(count):
        cells = "\t".join(_cells(markers.points_mm[k]))
        lines.append(f"{k + 1}\t{markers.times_s[k]:.9f}\t{cells}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _cells(points: Floats) -> list[str]:
    return [f"{v:.6f}" if np.isfinite(v) else "" for v in points.reshape(-1)]
