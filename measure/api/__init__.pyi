from measure.api.calibrating import (
    CalibrationResult,
    board_frame,
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
from measure.api.demo import Addition, Demo, demo, render_demo
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
from measure.api.outputs import new_folder, output
from measure.api.playing import Pace, PlayEnd, PlayOptions, play
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
from measure.api.refining import BodySearch, FoundBody, RefineResult, find_body, refine
from measure.api.rendered_cameras import DEMO_BOARDS, demo_cameras
from measure.api.results import body_names, compare, evaluate, export, report
from measure.api.run import RunOptions, parse_images, run
from measure.api.synchronising import SyncedClock, sync
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
from measure.model import Camera, Image
from measure.results.evaluation import evaluation_tables
from measure.session import Calibration, read_body, read_calibration, write_body, write_calibration

__all__ = [
    "CAMERA_PORT", "COLORS", "DEMO_BOARDS", "MARK_KINDS", "TAG_FAMILIES", "TYPED", "Addition",
    "BallWatch", "BodySearch", "Calibration", "CalibrationResult", "Camera", "CameraAddress",
    "CameraCount", "CameraNow", "CaptureOptions", "CaptureRequest", "Control", "Demo",
    "DeviceControls", "FocalFrom", "FoundBody", "FoundCamera", "Image", "Lens", "LiveEnd",
    "LiveOptions", "LiveState", "Mark", "MarkKind", "Marking", "Measurement", "Mode", "Outcome",
    "Pace", "PictureFacts", "PlayEnd", "PlayOptions", "Preview", "RecordedSession", "RefineResult",
    "Registry", "RigidTransform", "RunOptions", "Samples", "SeenPicture", "SessionCheck",
    "SyncedClock", "Verdict", "WatchedCamera", "WaveState", "begin_marks", "board_frame",
    "board_length", "body_names", "build_pipeline", "calibrate", "calibrate_to", "camera_line",
    "camera_names", "cameras", "capture_board", "check", "choose", "compare", "contents_of", "demo",
    "demo_cameras", "described", "detect", "draw", "draw_target", "drawings", "evaluate",
    "evaluation_tables", "events", "export", "find_body", "inside", "learnt_colors", "live",
    "load_profile", "mark_event", "measure_bodies", "measure_session", "new_folder", "next_free",
    "output", "parse_cameras", "parse_click", "parse_controls", "parse_expectation", "parse_images",
    "parse_size", "play", "play_cameras", "profile_names", "read_body", "read_calibration",
    "record", "refine", "render_demo", "report", "run", "run_many", "sampled_color",
    "shipped_targets", "sync", "usb_notes", "web_viewer", "write_body", "write_calibration",
    "write_measured_board", "write_sampled_body",
]  # fmt: skip
