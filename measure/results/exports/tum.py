"""TUM: `time x y z qx qy qz qw`, metres and seconds, as `evo` reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.results.run import Run


def write(run: Run, path: Path) -> None:
    """Write a line for every pose; the format has no way to say that one is missing."""
    poses = run.world_from_body
    quat = poses.quat_wxyz
    rows = np.column_stack(
        [run.times_s[run.has_pose], poses.translation / 1000, quat[:, 1:], quat[:, :1]]
    )
    lines = ["# time_s x_m y_m z_m qx qy qz qw (world_from_body)"]
    lines += [f"{row[0]:.9f} " + " ".join(f"{v:.12f}" for v in row[1:]) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
