"""Calibrating a rig from a capture folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import measure
from measure.api.outputs import check_apart, output
from measure.arrays import Bytes
from measure.calibration import (
    JOINT,
    Charuco,
    Chessboard,
    RigCalibration,
    Sheet,
    Verdict,
    calibrate_capture,
    judge,
    judgement_lines,
    open_capture,
    provenance,
    read_board,
    target_sheet,
    write_sheet,
)
from measure.calibration.common_views import board_frame as board_frame_of
from measure.calibration.printing import body_sheet
from measure.calibration.targets import kind_of, read_board_file
from measure.checking.coverage import HIDDEN_SHARE, hidden_share, longer_arms
from measure.errors import ConfigError
from measure.geometry import UncertainTransform
from measure.host import Registry
from measure.model import Body, Camera, paper_body
from measure.processes import Progress, quiet
from measure.results.pose_table import poses_of
from measure.results.run import Run, read_run
from measure.session import (
    Calibration,
    check_unit,
    dump_toml,
    is_session,
    read_body,
    write_body,
    write_calibration,
)

_POSES_LOOKED_AT = 60
_PRINTED_SHARE = 0.15  # A4 for Letter is 6 %; more is another board


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibration, how it came about and how good it is."""

    calibration: Calibration
    rig: RigCalibration
    verdict: Verdict

    def lines(self) -> list[str]:
        """What was measured, what was noticed, what it is good for."""
        return judgement_lines(self.rig, self.verdict)


def calibrate(
    capture: Path | str,
    method: str = JOINT,
    body: Path | str | None = None,
    progress: Progress = quiet,
) -> CalibrationResult:
    """Calibrate the cameras of a capture folder and judge the result.

    Args:
        method: "joint", or the name of a camera fit that an installed package offers.
        body: body file to judge with; the paper's three-ball body if omitted.

    Raises:
        CalibrationError: what cannot give a trustworthy calibration, with its cause.
    """
    opened = open_capture(capture)
    measured_with = paper_body() if body is None else read_body(body)
    rig = calibrate_capture(opened, method, progress)
    cure = "are the capture's lengths in mm (square_mm)? If so give --body, the body to be measured"
    check_unit(Calibration(rig.cameras), measured_with, str(capture), cure)
    verdict = judge(rig, measured_with, opened.settings.floor_z_mm)
    values = provenance(rig, verdict, opened.settings.name)
    return CalibrationResult(Calibration(rig.cameras, values), rig, verdict)


def calibrate_to(
    capture: Path,
    out: Path,
    registry: Registry,
    overwrite: bool = False,
    method: str = JOINT,
    body: Path | None = None,
    lenses: Path | None = None,
    file_format: str = "triball",
    report: Path | None = None,
    progress: Progress = quiet,
) -> tuple[CalibrationResult, Path]:
    """Calibrate cameras from pictures of boards and markers, or of the waved body.

    The command's exit code is 3 if the judgement finds anything wrong; the calibration is then
    written as well.

    Args:
        capture: capture folder (docs/calibration.md), or its capture.toml; or a session in which
            the body is waved, which needs no calibration: the world is the first camera's frame.
        out: the calibration to write.
        method: "joint" solves all cameras at once; "paper" each from its markers (equation 3).
        body: the waved body; or the one to judge a capture's calibration with, the paper's
            three-ball body if omitted.
        lenses: for a session, a calibration that gives the lenses only.
        file_format: triball, anipose, caliscope or opencv; only "triball" holds covariances and
            the judgement.
        report: HTML report to write; beside the output, ending in .html, if omitted.

    Returns:
        The result, and the report.
    """
    from measure.viewing.report.calibration_report import calibration_report

    waved = is_session(capture)
    if waved and method != JOINT:
        raise ConfigError(f"--method {method}: a waved body calibrates all cameras at once")
    if lenses is not None and not waved:
        raise ConfigError("--lenses: a capture.toml names the lenses of its cameras itself")
    page = out.with_suffix(".html") if report is None else report
    check_apart(out, page)
    # That both can be written is known before anything is made.
    with output(out, overwrite) as file, output(page, overwrite) as written:
        if waved:
            from measure.api.calibrating_by_body import calibrate_by_body

            result = calibrate_by_body(capture, body, registry, lenses, progress=progress)
            name = str(result.calibration.provenance["capture"])
        else:
            result = calibrate(capture, method, body, progress)
            name = capture.name or str(capture)
        write_calibration(file, result.calibration, file_format)
        text = calibration_report(name, result.rig, result.verdict)
        written.write_text(text, encoding="utf-8")
    return result, page


def draw_target(
    target: Path | str,
    out: Path | str | None = None,
    overwrite: bool = False,
    run: Path | None = None,
) -> tuple[Sheet, Path]:
    """Draw a printable board, marker field or body.

    Args:
        target: TOML of the target, or the name of one that comes with the program:
            charuco_8x5_27, chessboard_9x6_25, raven_markers_16, raven_three_ball.
        out: .pdf or .svg to write; the target's name with .pdf in this folder if omitted.
        run: a run of a body like TARGET: its arms are made so long that its balls hide each other
            in less than 15 % of the views there, and its body file is written beside the sheet.

    Returns:
        The sheet, and the file written.
    """
    written = Path(out or f"{Path(target).stem}.pdf")
    with output(written, overwrite, beside=[".toml"] if run else []) as file:
        place = find_target(Path(target))
        if run is None:
            sheet = target_sheet(place)
        elif kind_of(place) != "body":
            raise ConfigError(f"{place} is no body: --run makes a body's arms longer")
        else:
            body, note = _with_seldom_hidden_balls(read_body(place), read_run(run))
            sheet = replace(body_sheet(body), note=note)
            write_body(file.with_suffix(".toml"), body, comment=note)
        write_sheet(sheet, file)
    return sheet, written


def _with_seldom_hidden_balls(body: Body, run: Run) -> tuple[Body, str]:
    """The body with arms long enough for where a run has seen it, and what that changes."""
    poses = poses_of(run)
    if not len(poses):
        raise ConfigError(f"{run.path}: no pose in it says where the cameras see the body")
    some = np.unique(np.linspace(0, len(poses) - 1, _POSES_LOOKED_AT).astype(int))
    views = [poses.world_from_body[int(k)] for k in some], body, run.cameras
    hidden = hidden_share(*views)
    now = f"balls are partly behind another one of the body in {hidden:.0%} of views"
    if hidden <= HIDDEN_SHARE:
        return body, f"{now}: its arms are long enough"
    if longer := longer_arms(*views):
        return longer.body, f"{now}: {longer}"
    raise ConfigError(f"{now}, and with arms three times as long hardly fewer: move cameras")


def shipped_targets() -> dict[str, Path]:
    """The printable targets that come with the program, by name, with their files."""
    package = Path(measure.__file__).parent
    installed, checkout = (at / "calibration_targets" for at in (package, package.parent))
    folder = installed if installed.is_dir() else checkout
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def board_length(target: Path | str) -> tuple[int, float]:
    """Squares along the longer side of a board, and the size of one in mm; 0 for one of tags.

    CalibrationError for a target that is no board.
    """
    board = read_board(find_target(Path(target)))
    if not isinstance(board, Charuco | Chessboard):
        return 0, 0.0
    return max(board.inner_corners) + 1, board.square_mm


def write_measured_board(target: Path | str, square_mm: float, out: Path) -> None:
    """Write a board of squares as large as they were measured on paper; its markers grow with them.

    ConfigError for squares that no printer makes of the ones that were drawn.
    """
    file = find_target(Path(target))
    given = read_board_file(file).model_dump()
    drawn_mm = given["square_mm"]
    if not abs(square_mm / drawn_mm - 1) <= _PRINTED_SHARE:
        raise ConfigError(
            f"{square_mm:.2f} mm a square: {file.stem} has squares of {drawn_mm:g} mm, and no "
            f"printer is off by {_PRINTED_SHARE:.0%}: measure again, or choose the board that it is"
        )
    if "marker_mm" in given:
        given["marker_mm"] *= square_mm / drawn_mm
    out.write_text(dump_toml(given | {"square_mm": square_mm}), encoding="utf-8")


def board_frame(
    board: Path, cameras: Sequence[Camera], pictures: Mapping[str, Bytes]
) -> UncertainTransform:
    """The frame world_from_board of a board that lies still, from a picture by each camera.

    Its z axis points towards the cameras. `board` is a target file, or the name of one that comes
    with the program; `pictures` are BGR by camera name. CalibrationError: the board is in no
    picture, looks the same after a turn, or the pictures contradict each other.
    """
    return board_frame_of(read_board(find_target(board)), cameras, pictures)


def find_target(path: Path) -> Path:
    """The file at this path, else the shipped target of this name, with or without its suffix."""
    if path.exists() or path.parent != Path():
        return path
    shipped = shipped_targets()
    name = path.name.removesuffix(".toml")
    if name not in shipped:
        raise ConfigError(
            f"{path}: neither a file nor the name of a target that comes with the program: "
            f"{', '.join(shipped)}"
        )
    return shipped[name]
