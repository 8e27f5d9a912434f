"""`measure recalibrate`: a robot's zeros of today, from poses that the program chooses."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.errors import ConfigError
from measure_learning import api as learning_api


def recalibrate(
    model: Path,
    poses: Path,
    /,
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    measured: Path | None = None,
    count: int = learning_api.POSES,
    arm_file: tuple[Path, ...] = (),
    json: JsonFlag = False,
) -> None:
    """Choose poses that a robot visits in the morning, then find today's joint zeros.

    Without `--measured` it writes the poses that tell most of links, zeros and base. With a data
    set that was measured there, it writes the model with today's offsets, the robot with today's
    links and zeros (.urdf), and a certificate: the error stated in each region of the tip, and how
    each recording of the training kept the promise.

    Args:
        model: an ONNX file made by `measure train`, or `shipped`.
        poses: what the arm may visit, where it works: a log, a data set or a table of states.
        out: the poses (.csv), or with --measured the model of today (.onnx); the others stand
            beside it, with its name.
        measured: a data set of the visited poses, by `measure dataset`.
        count: how many poses to choose.
        arm_file: with --measured, a kinematic file of a dVRK (psm.json, or of its tool): the zeros
            are added to its offsets, in OUT with its name.
    """
    path = learning_api.model_file(model)
    if measured is None:
        if arm_file:
            raise ConfigError("--arm-file gets zeros that are measured: give --measured")
        with api.output(out, overwrite, [path, poses]) as file:
            chosen = learning_api.choose_poses(path, poses, file, count)
        if json:
            console.print_json({"output": out, **vars(chosen)})
            return
        console.print_text(
            f"{len(chosen.rows)} of {chosen.of} poses: what a day adds, {chosen.sd_before_mm:.2f} "
            f"mm (SD, 3-D) over all of them, becomes {chosen.sd_after_mm:.2f} mm; wrote {out}"
        )
        return
    beside = ".certificate.json", ".certificate.md", ".urdf", *(f".{one.name}" for one in arm_file)
    with api.output(out, overwrite, [path, poses, measured, *arm_file], beside) as file:
        facts = learning_api.recalibrate(path, poses, measured, file, arm_file)
    if json:
        console.print_json({"output": out, **facts})
        return
    rows = [(z["joint"], z["zero"], z["sd"], z["unit"]) for z in facts["zeros"]]
    console.print_table(("", "zero", "sd", "unit"), rows)
    console.print_text(
        f"{facts['poses']} poses: {facts['before_mm']:.3f} mm RMS become "
        f"{facts['held_out_mm']:.3f} mm by the offsets of the others, "
        f"{facts['inside_95']:.0%} in the stated 95 % region; {facts['drift']}"
    )
    console.print_text(f"wrote {out}, with its certificate beside it")
