"""What a notebook calls to see, record and measure running cameras."""

from measure_studio.api.ball_colors import BallColors
from measure_studio.api.cameras import cameras
from measure_studio.api.capturing import capture_board, capture_body
from measure_studio.api.live import LEARNING, LiveEnd, LiveOptions, LiveState, live
from measure_studio.api.marks import TYPED
from measure_studio.api.playing import Pace, PlayEnd, PlayOptions, play
from measure_studio.api.playing_cameras import CAMERA_PORT, camera_line, play_cameras
from measure_studio.api.previewing import (
    BallWatch,
    CameraNow,
    PictureFacts,
    Preview,
    WatchedCamera,
    best_balls,
    web_viewer,
)
from measure_studio.api.recording import (
    CaptureOptions,
    CaptureRequest,
    RecordedSession,
    camera_names,
    record,
    usb_notes,
)
from measure_studio.api.recordings import (
    Recording,
    delete_recording,
    name_body,
    recordings_in,
    trail_of,
)
from measure_studio.api.rendered_cameras import DEMO_BOARDS, WAVED_BODY, demo_cameras
from measure_studio.api.rig_folder import (
    COLORS,
    contents_of,
    described,
    next_free,
    own_board,
    write_board,
)
from measure_studio.capture import (
    CameraAddress,
    CameraCount,
    Control,
    DeviceControls,
    FoundCamera,
    Mode,
    parse_cameras,
)

__all__ = [
    "CAMERA_PORT", "COLORS", "DEMO_BOARDS", "LEARNING", "TYPED", "WAVED_BODY", "BallColors",
    "BallWatch", "CameraAddress", "CameraCount", "CameraNow", "CaptureOptions",
    "CaptureRequest", "Control", "DeviceControls", "FoundCamera", "LiveEnd", "LiveOptions",
    "LiveState", "Mode", "Pace", "PictureFacts", "PlayEnd", "PlayOptions", "Preview",
    "RecordedSession", "Recording", "WatchedCamera", "best_balls", "camera_line",
    "camera_names", "cameras", "capture_board", "capture_body", "contents_of",
    "delete_recording", "demo_cameras", "described", "live", "name_body", "next_free",
    "own_board", "parse_cameras", "play", "play_cameras",
    "record", "recordings_in", "trail_of", "usb_notes", "web_viewer", "write_board",
]  # fmt: skip
