"""`measure register`: where a robot's base, the body on its tool and its clock are."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from measure import api
from measure.api.outputs import check_apart
from measure.arrays import Floats
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import FIELDS
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
    stops: tuple[Path, ...] = (),
    source: Annotated[learning_api.RobotLogs, FIELDS] = learning_api.RobotLogs(),
    options: Annotated[RegisterOptions, FIELDS] = RegisterOptions(),
    also: tuple[Path, ...] = (),
    json: JsonFlag = False,
) -> None:
    """Find where a robot stands in the cameras' world, and the body on its tool.

    Hand-eye and robot-world calibration (AX = ZB), from recordings of the moving robot, or from 8
    or more poses at which it stood still. Found are world_from_base, flange_from_body and the
    offset between the clocks, each with its uncertainty, and what the motion or the robot cannot
    separate. Poses or joints that fit once a slip is undone are refused with the slip.

    Args:
        runs: run folders, or tables of poses; the cameras and the body stayed where they were.
        stops: instead of runs and a log, a table with pose and joints of a stop in each row.
        out: the frame to write, for `measure dataset --frame`.
        also: write files of other programs, too, by the ends of their names: `.urdf` and UR's
            `calibration.yaml` (measured links and zeros, with --kinematics), easy_handeye2's
            `.calib`, `.launch.py` with static transforms as MoveIt's.
    """
    check_apart(out, *also)
    for path in also:
        learning_api.check_other_file(path, links=options.kinematics)
    with ExitStack() as opened:
        file, *others = [opened.enter_context(api.output(path, overwrite)) for path in (out, *also)]
        found = learning_api.register(runs, source, options, stops)
        write_frame(file, found)
        for path in others:
            path.write_text(learning_api.other_file(path, found, source.robot), encoding="utf-8")
    if json:
        ros = {"static_transforms": found.static_transforms()}
        console.print_json({"output": out, **found.values(), **ros})
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
    left_out = f" ({facts['left_out']} more disagree and are left out)" if facts["left_out"] else ""
    halves = f", {held_out:.3f} mm on halves held out" if np.isfinite(held_out) else ""
    console.print_text(
        f"{facts['poses']} poses{left_out}; {left:.3f} mm RMS are left{halves}; the poses state "
        f"{facts['stated_noise_mm']:.3f} mm"
    )
    for sentence in (*facts.get("stops_left_out", ()), *facts["not_separable"]):
        console.print_text(sentence)
    if (helps := facts.get("next_pose")) is not None:
        console.print_text(_next_pose(helps))
    for command in found.static_transforms():
        console.print_text(command)
    console.print_text(f"wrote {out}: pair with `measure dataset --frame {out}`")


def _next_pose(helps: Mapping[str, Any]) -> str:
    joints = ", ".join(f"{value:g}" for value in helps["joints"])
    units = "deg" if set(helps["units"]) == {"deg"} else f"({', '.join(helps['units'])})"
    base, tool = (round(100 * (1 - helps[f"{what}_sd_ratio"])) for what in ("base", "tool"))
    return (
        f"one more stop would help most with the joints at ({joints}) {units}: SD of the base "
        f"-{base} %, of the tool -{tool} %"
    )


def _words(values: Floats) -> str:
    return ", ".join(f"{value:.4f}" for value in values)
