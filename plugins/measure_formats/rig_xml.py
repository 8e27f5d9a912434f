"""Rigs of motion capture systems in XML: Vicon's `.xcp` and Qualisys' `.qca.txt`."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.reading import LARGEST
from measure.session import StatedCamera, StatedRig
from measure_formats.plain_values import READ

_SUBPIXELS = 64.0  # Qualisys' units in a pixel
_FLIPPED = np.diag([1.0, -1.0, -1.0])  # From axes with y up and z to the back to ours
_SAME_PX, _MARGIN, _LEAST_FOCAL = 0.1, 1.1, 0.1


def read_xml(path: Path, text: str) -> StatedRig | None:
    """The calibrated cameras of a file, lengths in mm; None if there are none, CalibrationError."""
    try:
        if "<!DOCTYPE" in text:  # entities may be of any size
            raise ET.ParseError("it has a DOCTYPE")
        root = ET.fromstring(text.lstrip())
    except ET.ParseError as problem:
        raise CalibrationError(f"{path}: not XML that is read ({problem}); {READ}") from None
    vicon, qualisys = root.findall(".//Camera"), root.findall(".//camera")
    if vicon:
        calibrated = [camera for camera in vicon if camera.find(".//KeyFrame") is not None]
        return StatedRig("vicon", tuple(_vicon(path, camera) for camera in calibrated))
    if qualisys:
        # Pose2Sim, which writes no version, states the distortion in 1/64 too.
        unit = _SUBPIXELS if root.get("qtm-version") == "none" else 1.0
        return StatedRig("qualisys", tuple(_qualisys(path, camera, unit) for camera in qualisys))
    return None


def _vicon(path: Path, camera: ET.Element) -> StatedCamera:
    """A center in the world, and camera_from_world as a quaternion whose real part is last."""
    name = camera.get("DEVICEID") or camera.get("NAME") or ""
    place = f"{path}: camera '{name}'"
    frames = camera.findall(".//KeyFrame")
    if len(frames) > 1:
        raise CalibrationError(f"{place}: it moves ({len(frames)} key frames): not supported")
    frame = frames[0]
    focal, *_ = _floats(frame, "FOCAL_LENGTH", place, 1)
    u, v = _floats(frame, "PRINCIPAL_POINT", place, 2)
    aspect = float(_floats(camera, "PIXEL_ASPECT_RATIO", place, 1, "1")[0])
    x, y, z, w = _floats(frame, "ORIENTATION", place, 4)
    turn = RigidTransform.from_quat_wxyz(np.array([w, x, y, z]), np.zeros(3)).rotation
    radial = _floats(frame, "VICON_RADIAL2", place, 5, f"{u} {v} 0 0 0")
    if "VICON_RADIAL2" not in frame.attrib and "VICON_RADIAL" in frame.attrib:
        radial = np.array([u, v, *_floats(frame, "VICON_RADIAL", place, 2), 0.0])
    if radial[2:].any() and np.abs(radial[:2] - [u, v]).max() > _SAME_PX:
        raise CalibrationError(f"{place}: its distortion is not about its principal point")
    size = _floats(camera, "SENSOR_SIZE", place, 2) if "SENSOR_SIZE" in camera.attrib else None
    skew = float(_floats(camera, "SKEW", place, 1, "0")[0])
    return StatedCamera(
        name,
        np.array([[focal, skew, u], [0, focal / aspect, v], [0, 0, 1]]),
        _bending(radial[2:] * focal ** np.array([2, 4, 6]), np.hypot(u, v) / focal),
        size_wh=None if size is None else (int(size[0]), int(size[1])),
        pose=(turn, -turn @ _floats(frame, "POSITION", place, 3)),
    )


def _bending(straightening: Floats, reach: float) -> Floats:
    """OpenCV's eight coefficients for radial terms that lead the other way, within `reach`.

    Vicon's terms make a pinhole's picture of a bent one, x (1 + a r^2 + b r^4 + c r^6); OpenCV's
    rational function is fitted to the inverse, which it meets to 1e-4 px.
    """
    if not straightening.any():
        return np.zeros(0)
    bent = np.linspace(0, _MARGIN * reach, 200)[1:]
    powers = np.array([2, 4, 6])
    straight = bent * (1 + bent[:, None] ** powers @ straightening)
    ratio, terms = bent / straight, straight[:, None] ** powers
    rows = np.hstack([terms, -ratio[:, None] * terms])
    k = np.linalg.lstsq(rows, ratio - 1, rcond=None)[0]
    return np.array([k[0], k[1], 0, 0, *k[2:]])


def _qualisys(path: Path, camera: ET.Element, unit: float) -> StatedCamera:
    """A center, and rows of camera_from_world in axes with y up and z to the back; 1/64 px."""
    name = camera.get("serial") or ""
    place = f"{path}: camera '{name}'"
    lens, pose = camera.find("intrinsic"), camera.find("transform")
    view = camera.find("fov_video")
    if lens is None or pose is None or view is None:
        raise CalibrationError(f"{place}: lacks <intrinsic>, <transform> or <fov_video>")
    left, top, right, bottom = _each(view, ("left", "top", "right", "bottom"), place)
    keys = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    fx, fy, u, v = _each(lens, keys, place) / _SUBPIXELS
    (skew,) = _each(lens, ("skew",), place, "0") / _SUBPIXELS
    if fx < _LEAST_FOCAL * (right - left):
        raise CalibrationError(f"{place}: its focal length is not in QTM's unit of 1/64 px")
    radial = _each(lens, tuple(f"radialDistortion{i}" for i in (1, 2, 3)), place, "0")
    sideways = _each(lens, tuple(f"tangentalDistortion{i}" for i in (1, 2)), place, "0")
    turn = _each(pose, tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), place)
    rotation = _FLIPPED @ turn.reshape(3, 3)
    return StatedCamera(
        name,
        np.array([[fx, skew, u - left], [0, fy, v - top], [0, 0, 1]]),
        np.array([*radial[:2], *sideways, radial[2]]) / unit,
        size_wh=(int(right - left) + 1, int(bottom - top) + 1),
        pose=(rotation, -rotation @ _each(pose, ("x", "y", "z"), place)),
    )


def _each(
    element: ET.Element, keys: tuple[str, ...], place: str, usual: str | None = None
) -> Floats:
    return np.concatenate([_floats(element, key, place, 1, usual) for key in keys])


def _floats(
    element: ET.Element, key: str, place: str, count: int, usual: str | None = None
) -> Floats:
    """The last `count` numbers of an attribute, before which there may be a name."""
    text = element.get(key, usual)
    if text is None:
        raise CalibrationError(f"{place}: <{element.tag}> lacks {key}")
    try:
        numbers = np.array(text.split()[-count:], dtype=np.float64)
    except ValueError:
        numbers = np.array([np.nan])
    if len(numbers) != count or not (np.abs(numbers) <= LARGEST).all():
        raise CalibrationError(
            f"{place}: {key} = {text[:60]!r} is no {count} finite numbers within {LARGEST:g}"
        )
    return numbers
