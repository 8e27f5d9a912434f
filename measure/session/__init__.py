"""Recordings: session folders, images and videos, clocks, calibrations and body files."""

from measure.reading import FileModel
from measure.session.body_file import read_bodies, read_body, write_bodies, write_body
from measure.session.calibration_file import JOINT_COVARIANCE, Calibration
from measure.session.calibrations import read_calibration, read_intrinsics, write_calibration
from measure.session.consistency import check_bodies, check_unit
from measure.session.copying import CameraSource, SessionParts
from measure.session.damage import damaged_frames, holds_jpeg
from measure.session.files import (
    Length,
    Name,
    Position,
    SafeName,
    check_name,
    dump_toml,
    load_toml,
    matching_files,
)
from measure.session.formats import Format, able, format_for, formats
from measure.session.opening import (
    check_overlap,
    clock_values,
    is_session,
    open_session,
    open_streams,
    session_file,
    session_lacks,
    session_truth,
)
from measure.session.orientation import Orientation
from measure.session.pictures import (
    PictureTags,
    decode_picture,
    is_complete_jpeg,
    picture_bytes,
    picture_tags,
    read_picture,
)
from measure.session.robot_base import StatedTransform, read_robot_base
from measure.session.session import Session, pair_nearest, seldom_paired
from measure.session.stated_rig import MM_PER, StatedCamera, StatedRig, Unit, stated_model
from measure.session.streams import ArrayStream, Stream
from measure.session.tracked_body import TrackedBody
from measure.session.trajectory import Trajectory, read_trajectory
from measure.session.video_file import open_video_stream

__all__ = [
    "JOINT_COVARIANCE", "MM_PER", "ArrayStream", "Calibration", "CameraSource", "FileModel",
    "Format", "Length", "Name", "Orientation", "PictureTags",
    "Position", "SafeName", "Session", "SessionParts", "StatedCamera", "StatedRig",
    "StatedTransform", "Stream",
    "TrackedBody", "Trajectory", "Unit", "able", "check_bodies", "check_name", "check_overlap",
    "check_unit", "clock_values", "damaged_frames", "decode_picture", "dump_toml", "format_for",
    "formats", "holds_jpeg", "is_complete_jpeg", "is_session", "load_toml", "matching_files",
    "open_session",
    "open_streams", "open_video_stream", "pair_nearest", "picture_bytes", "picture_tags",
    "read_bodies", "read_body", "read_calibration", "read_intrinsics", "read_picture",
    "read_robot_base", "read_trajectory", "seldom_paired", "session_file", "session_lacks",
    "session_truth", "stated_model", "write_bodies", "write_body", "write_calibration",
]  # fmt: skip
