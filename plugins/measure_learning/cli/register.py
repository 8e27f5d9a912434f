"""`measure register`: where a robot's base, the body on its tool and its clock are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from measure import api
from measure.arrays import Floats
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import FIELDS, RobotOptions
from measure.geometry import RigidTransform
from measure_learning import api as learning_api
from measure_learning.core.frames import RobotFrame, write_frame
from measure_learning.core.registration import RegisterOptions


def register(
    runs: tuple[Path, ...] = (),
    /,
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    source: RobotOptions = RobotOptions(),
    options: Annotated[RegisterOptions, FIELDS] = RegisterOptions(),
    json: JsonFlag = False,
) -> None:
    """Find where a robot stands in the cameras' world, and the body on its tool.

    From recordings of the moving robot: world_from_base, flange_from_body and the offset between
    the clocks, each with its uncertainty, and what the motion or the robot cannot separate. A
    motion that shows too little is refused with what it lacks.

    Args:
        runs: run folders, or tables of poses; the cameras and the body stayed where they were.
        out: the frame to write, for `measure dataset --frame`.
    """
    with api.output(out, overwrite) as file:
        logs, robot, topic = source.robot_log, source.robot, source.topic
        found = learning_api.register(runs, logs, robot, options, topic=topic)
        write_frame(file, found)
    if json:
        console.print_json({"output": out, **found.values()})
    else:
        _print(found, out)


def _print(found: RobotFrame, out: Path) -> None:
    sd = np.sqrt(np.diag(found.covariance))
    for k, name in enumerate(("world_from_base", "flange_from_body")):
        pose: RigidTransform = getattr(found, name)
        place, turn = sd[6 * k : 6 * k + 3], np.degrees(sd[6 * k + 3 : 6 * k + 6])
        console.print_text(
            f"{name}: ({_words(pose.translation)}) mm, quat_wxyz ({_words(pose.quat_wxyz)}), "
            f"SD {np.linalg.norm(place):.2f} mm and {np.linalg.norm(turn):.3f} deg (3-D)"
        )
    for (name, offset), error in zip(found.clock_offsets_s.items(), sd[12:], strict=False):
        console.print_text(f"clock of {name}: robot - camera {offset:.5f} s, SD {error:.1g} s")
    facts = found.judgement
    left, held_out = facts["rms_mm"], facts["held_out_rms_mm"]
    console.print_text(
        f"{facts['poses']} poses; {left:.3f} mm RMS are left, {held_out:.3f} mm on halves held "
        f"out; the poses state {facts['stated_noise_mm']:.3f} mm"
    )
    for sentence in facts["not_separable"]:
        console.print_text(sentence)
    console.print_text(f"wrote {out}: pair with `measure dataset --frame {out}`")


def _words(values: Floats) -> str:
    return ", ".join(f"{value:.4f}" for value in values)
