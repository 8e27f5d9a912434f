"""The text files of a session folder (their format is described in docs/conventions.md)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import Body, Camera


def body_toml(body: Body) -> str:
    """The body file; colours are written by name."""
    lines = [f"name = {json.dumps(body.name)}"]
    for ball in body.balls:
        lines += [
            "",
            "[[balls]]",
            f"name = {json.dumps(ball.name)}",
            f"color = {json.dumps(ball.color.name)}",
            f"center_mm = {_row(ball.center_mm)}",
            f"radius_mm = {ball.radius_mm!r}",
        ]
    return "\n".join(lines) + "\n"


def calibration_toml(cameras: tuple[Camera, ...]) -> str:
    """The calibration file: exact, so without covariances."""
    lines: list[str] = []
    for camera in cameras:
        lens, pose = camera.intrinsics, camera.world_from_camera
        matrix = ", ".join(_row(row) for row in lens.matrix)
        lines += [
            "[[cameras]]",
            f"name = {json.dumps(camera.name)}",
            f"size_wh = [{lens.size_wh[0]}, {lens.size_wh[1]}]",
            f"matrix = [{matrix}]",
            *([] if lens.model == "pinhole" else [f"model = {json.dumps(lens.model)}"]),
            f"distortion = {_row(lens.coefficients)}",
            f"quat_wxyz = {_row(pose.quat_wxyz)}",
            f"translation_mm = {_row(pose.translation)}",
        ]
        if camera.readout_s:
            lines.append(f"readout_s = {camera.readout_s!r}")
        lines.append("")
    return "\n".join(lines)


def session_toml(name: str, description: str, sources: dict[str, str]) -> str:
    """The session file; `sources` are the cameras' image patterns."""
    lines = [
        "[session]",
        f"name = {json.dumps(name)}",
        f"description = {json.dumps(description)}",
        'body = "body.toml"',
        'calibration = "calibration.toml"',
        'truth = "truth.csv"',
    ]
    for camera, source in sources.items():
        lines += ["", "[[cameras]]", f"name = {json.dumps(camera)}"]
        lines += [f"images = {json.dumps(source)}", f"timestamps = {json.dumps(camera + '.csv')}"]
    return "\n".join(lines) + "\n"


def write_stamps(path: Path, times_s: Floats) -> None:
    """Frame numbers and mid-exposure times."""
    rows = [f"{k},{t:.9f}" for k, t in enumerate(times_s)]
    path.write_text("\n".join(["frame,time_s", *rows]) + "\n", encoding="utf-8")


def write_truth(path: Path, times_s: Floats, world_from_body: RigidTransform) -> None:
    """A trajectory, world_from_body at times (n,)."""
    quats = world_from_body.quat_wxyz
    rows = [
        f"{t:.9f}," + ",".join(f"{x:.6f}" for x in p) + "," + ",".join(f"{x:.9f}" for x in q)
        for t, p, q in zip(times_s, world_from_body.translation, quats, strict=True)
    ]
    header = "time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def _row(values: Floats) -> str:
    return "[" + ", ".join(repr(float(x)) for x in np.asarray(values).ravel()) + "]"
