"""What a notebook calls; the command line calls nothing else.

What learns and what draws loads when an action is called, not with this package. Everywhere
`registry` holds the plugins, `overwrite` lets an output be replaced that is there, and `progress`
is called with what is done of the pictures, frame sets or cameras, and how many there are.
"""

from measure.api.accepting import Accepted, accept
from measure.api.calibrating import (
    CalibrationResult,
    board_length,
    calibrate,
    calibrate_to,
    draw_target,
    shipped_targets,
    write_measured_board,
)
from measure.api.cameras import cameras
from measure.api.capturing import capture_board
from measure.api.check import SessionCheck, check
from measure.api.correcting import (
    correct_simulated_robot,
    estimate_file,
    estimate_online,
    model_file,
    rezero,
    robot_recording,
    shipped_model,
)
from measure.api.demo import Demo, demo, render_demo
from measure.api.detecting import (
    Samples,
    SeenPicture,
    detect,
    draw,
    drawings,
    parse_click,
    parse_expectation,
    sampled_color,
    write_sampled_body,
)
from measure.api.folders import (
    COLORS,
    contents_of,
    described,
    events,
    inside,
    learnt_colors,
    mark_event,
    next_free,
)
from measure.api.lenses import FocalFrom, Lens
from measure.api.live import LiveEnd, LiveOptions, LiveState, live
from measure.api.many import Outcome, run_many
from measure.api.marking import MARK_KINDS, TAG_FAMILIES, Mark, Marking, MarkKind, begin_marks
from measure.api.marks import TYPED
from measure.api.measuring import measure_bodies, measure_session
from measure.api.metrology import RestsSoFar, TipResult, pivot, rests, world, world_by_board
from measure.api.outputs import new_folder, output
from measure.api.pairing import (
    RenderOptions,
    SimulationOptions,
    make_dataset,
    register,
    simulate_dataset,
    simulate_recording,
)
from measure.api.playing import PlayEnd, PlayOptions, play
from measure.api.playing_cameras import CAMERA_PORT, camera_line, play_cameras
from measure.api.previewing import (
    BallWatch,
    CameraNow,
    PictureFacts,
    Preview,
    WatchedCamera,
    web_viewer,
)
from measure.api.profiles import build_pipeline, choose, load_profile, profile_names
from measure.api.recording import (
    CaptureOptions,
    CaptureRequest,
    RecordedSession,
    camera_names,
    parse_controls,
    parse_size,
    record,
    usb_notes,
)
from measure.api.refining import FoundBody, RefineResult, find_body, refine
from measure.api.rendered_cameras import DEMO_BOARDS, demo_cameras
from measure.api.results import body_names, compare, evaluate, export, report
from measure.api.run import RunOptions, parse_images, run
from measure.api.synchronising import SyncedClock, sync
from measure.api.training import SweepOptions, TrainOptions, ablate, parse_settings, sweep, train
from measure.calibration import Verdict, WaveState
from measure.capture import (
    CameraAddress,
    CameraCount,
    Control,
    DeviceControls,
    FoundCamera,
    Mode,
    parse_cameras,
)
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.measuring import Measurement
from measure.model import Camera
from measure.results.evaluation import evaluation_tables
from measure.session import Calibration, read_body, read_calibration, write_body, write_calibration

__all__ = [
    "CAMERA_PORT", "COLORS", "DEMO_BOARDS", "MARK_KINDS", "TAG_FAMILIES", "TYPED", "Accepted",
    "BallWatch", "Calibration", "CalibrationResult", "Camera", "CameraAddress", "CameraCount",
    "CameraNow", "CaptureOptions", "CaptureRequest", "Control", "Demo", "DeviceControls",
    "FocalFrom", "FoundBody", "FoundCamera", "Lens", "LiveEnd", "LiveOptions", "LiveState", "Mark",
    "MarkKind", "Marking", "Measurement", "Mode", "Outcome", "PictureFacts", "PlayEnd",
    "PlayOptions", "Preview", "RecordedSession", "RefineResult", "Registry", "RenderOptions",
    "RestsSoFar", "RigidTransform", "RunOptions", "Samples", "SeenPicture", "SessionCheck",
    "SimulationOptions", "SweepOptions", "SyncedClock", "TipResult", "TrainOptions", "Verdict",
    "WatchedCamera", "WaveState", "ablate", "accept", "begin_marks", "board_length", "body_names",
    "build_pipeline", "calibrate", "calibrate_to", "camera_line", "camera_names", "cameras",
    "capture_board", "check", "choose", "compare", "contents_of", "correct_simulated_robot", "demo",
    "demo_cameras", "described", "detect", "draw", "draw_target", "drawings", "estimate_file",
    "estimate_online", "evaluate", "evaluation_tables", "events", "export", "find_body", "inside",
    "learnt_colors", "live", "load_profile", "make_dataset", "mark_event", "measure_bodies",
    "measure_session", "model_file", "new_folder", "next_free", "output", "parse_cameras",
    "parse_click", "parse_controls", "parse_expectation", "parse_images", "parse_settings",
    "parse_size", "pivot", "play", "play_cameras", "profile_names", "read_body", "read_calibration",
    "record", "refine", "register", "render_demo", "report", "rests", "rezero", "robot_recording",
    "run", "run_many", "sampled_color", "shipped_model", "shipped_targets", "simulate_dataset",
    "simulate_recording", "sweep", "sync", "train", "usb_notes", "web_viewer", "world",
    "world_by_board", "write_body", "write_calibration", "write_measured_board",
    "write_sampled_body",
]  # fmt: skip
