"""Recordings: session folders, images and videos, clocks, calibrations and body files."""

from measure.session.body_file import read_body, write_body
from measure.session.calibration_file import Calibration
from measure.session.calibration_file import write_own_calibration as write_calibration
from measure.session.calibrations import read_calibration
from measure.session.files import FileModel, load_toml
from measure.session.pairing import Pairing, pair_nearest
from measure.session.pictures import decode_picture, read_picture
from measure.session.session import Session, open_session
from measure.session.streams import Stream
from measure.session.toml_text import dump_toml

__all__ = [
    "Calibration",
    "FileModel",
    "Pairing",
    "Session",
    "Stream",
    "decode_picture",
    "dump_toml",
    "load_toml",
    "open_session",
    "pair_nearest",
    "read_body",
    "read_calibration",
    "read_picture",
    "write_body",
    "write_calibration",
]
