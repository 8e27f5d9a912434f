from measure.api.calibrating import (
    CalibrationResult,
    board_frame,
    board_length,
    calibrate,
    calibrate_to,
    draw_target,
    find_target,
    shipped_targets,
    write_measured_board,
)
from measure.api.calibrating_by_body import calibrate_by_body
from measure.api.check import SessionCheck, check
from measure.api.demo import Addition, Demo, demo, render_demo
from measure.api.detecting import (
    Samples,
    SeenPicture,
    clicked_color,
    detect,
    draw,
    drawings,
    learnt_colors,
    parse_click,
    parse_expectation,
    sampled_color,
    write_sampled_body,
)
from measure.api.folders import events, inside, mark_event
from measure.api.lenses import FocalFrom, Lens
from measure.api.many import Outcome, run_many
from measure.api.marking import MARK_KINDS, TAG_FAMILIES, Mark, Marking, MarkKind, begin_marks
from measure.api.measuring import measure_bodies, measure_session
from measure.api.mend import Mended, mend
from measure.api.outputs import new_folder, output
from measure.api.profiles import (
    build_detectors,
    build_pipeline,
    choose,
    load_profile,
    profile_names,
)
from measure.api.refining import BodySearch, FoundBody, RefineResult, find_body, refine
from measure.api.results import body_names, evaluate, export
from measure.api.run import RunOptions, run
from measure.api.spreading import Workers
from measure.api.stretches import run_in_stretches
from measure.api.synchronising import SyncedClock, sync
from measure.calibration import Board, BoardWave, BodyWave, Corners, Verdict, WaveState, read_board
from measure.calibration.boards import Charuco, Chessboard, MirroredBoardError
from measure.calibration.other_boards import OtherBoard, other_board
from measure.calibration.printing import Sheet, target_sheet
from measure.checking.causes import Cause
from measure.checking.finding import Finding, Level
from measure.checking.unknown_body import search_bodies
from measure.checking.watching import RigWatch
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.measuring import Measurement, Pipeline, Profile, relative_measurements
from measure.measuring.kept_rig import Keep
from measure.model import Body, Camera, Detection, Image, paper_body
from measure.model.doubts import counted
from measure.processes import ProgressClock
from measure.results.evaluation import evaluation_tables
from measure.session import (
    Calibration,
    is_session,
    read_body,
    read_calibration,
    read_intrinsics,
    read_trajectory,
    write_body,
    write_calibration,
)

__all__ = [
    "MARK_KINDS", "TAG_FAMILIES", "Addition", "Board", "BoardWave", "Body", "BodySearch",
    "BodyWave", "Calibration", "CalibrationResult", "Camera", "Cause", "Charuco", "Chessboard",
    "Corners", "Demo", "Detection", "Finding", "FocalFrom", "FoundBody", "Image", "Keep",
    "Lens", "Level", "Mark", "MarkKind", "Marking", "Measurement", "Mended",
    "MirroredBoardError", "OtherBoard", "Outcome", "Pipeline", "Profile", "ProgressClock",
    "RefineResult", "Registry", "RigWatch", "RigidTransform", "RunOptions", "Samples",
    "SeenPicture", "SessionCheck", "Sheet", "SyncedClock", "Verdict", "WaveState", "Workers",
    "begin_marks", "board_frame", "board_length", "body_names", "build_detectors",
    "build_pipeline", "calibrate", "calibrate_by_body", "calibrate_to",
    "check", "choose", "clicked_color", "counted", "demo", "detect", "draw", "draw_target",
    "drawings", "evaluate", "evaluation_tables", "events", "export", "find_body", "find_target",
    "inside", "is_session", "learnt_colors", "load_profile", "mark_event", "measure_bodies",
    "measure_session", "mend", "new_folder", "other_board", "output", "paper_body",
    "parse_click", "parse_expectation", "profile_names", "read_board",
    "read_body", "read_calibration", "read_intrinsics", "read_trajectory", "refine",
    "relative_measurements", "render_demo", "run", "run_in_stretches", "run_many",
    "sampled_color", "search_bodies", "shipped_targets", "sync", "target_sheet", "write_body",
    "write_calibration", "write_measured_board", "write_sampled_body",
]  # fmt: skip
