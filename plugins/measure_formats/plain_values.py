"""Files of OpenCV, YAML and JSON as plain values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from measure.errors import CalibrationError
from measure.limits import MOST_LETTERS

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # Ten times as fast, where it is built
_LONGEST = 1000  # Entries of a list that may describe cameras

READ = (
    "aniposelib's, caliscope's or Pose2Sim's TOML; OpenCV's YAML, XML or JSON (camera_matrix, or "
    "M1 D1 M2 D2 R T of a stereo pair); Kalibr's camchain, OpenVINS; Basalt; COLMAP's cameras.txt "
    "beside images.txt; nerfstudio's transforms.json; ROS's camera_info (lenses); MC-Calib; "
    "multical; EasyMocap's intri.yml and extri.yml; Vicon's .xcp; Qualisys' .qca.txt"
)
"""The end of messages on such files."""


def plain_values(path: Path, text: str) -> Any:
    """The values of a file, None if in none of these languages; CalibrationError if broken."""
    start = text.lstrip()
    if "!!opencv-matrix" in text and not start.startswith("%YAML"):
        start = f"%YAML:1.0\n---\n{start.removeprefix('---')}"
    if start.startswith(("%YAML", "<")) or ("opencv-matrix" in text and start.startswith("{")):
        return _opencv_values(path, start)
    try:
        return json.loads(text) if start.startswith(("{", "[")) else yaml.load(text, _LOADER)
    except (yaml.YAMLError, RecursionError, ValueError):
        return None


def _opencv_values(path: Path, text: str) -> Any:
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as problem:
        cause = str(problem.__cause__ or problem).strip().splitlines()[-1]
        cause = cause.rpartition("error: ")[2][:MOST_LETTERS]
        raise CalibrationError(f"{path}: not a file OpenCV can read ({cause}); {READ}") from None
    root = storage.root()
    return _plain(root) if root.isMap() else None


def _plain(node: Any) -> Any:
    if node.isMap():
        keys = node.keys()
        if not {"rows", "cols", "data"} <= set(keys):
            return {key: _plain(node.getNode(key)) for key in keys}
        try:
            return np.asarray(node.mat(), dtype=np.float64)
        except cv2.error:  # its numbers do not fit its shape
            return np.full((1, 1), np.nan)
    if node.isSeq():
        return [_plain(node.at(i)) for i in range(node.size())] if node.size() < _LONGEST else None
    if node.isInt() or node.isReal():
        return node.real()
    return node.string() if node.isString() else None
