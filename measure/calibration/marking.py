"""A camera's marks: by hand, found in the picture, or both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.capture import CameraCapture, Capture
from measure.calibration.markers import FoundMarkers, find_markers
from measure.calibration.observations import MarkerObservation
from measure.calibration.starts import start_from_marks
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.model import Camera, Intrinsics


def marks_of(
    camera: CameraCapture,
    lens: Intrinsics,
    start: Camera | None,
    markers: MarkerField,
    capture: Capture,
) -> tuple[Camera, MarkerObservation | None, FoundMarkers | None]:
    """The rough camera, its marks by hand and by search (the hand wins), and the search's finds.

    Raises:
        CalibrationError: neither board nor marks locate the camera, or too few markers
            are found and none is marked.
        SessionError: a picture that cannot be read.
    """
    by_hand = marker_observation(camera.marks, markers)
    if start is None:
        if by_hand is None:
            raise CalibrationError(
                f"camera {camera.name}: nothing tells where it stands: give board_image with the "
                f"board's pose, or mark at least six markers in marks.csv ({capture.path})"
            )
        start = start_from_marks(camera.name, lens, markers, by_hand)
    if camera.marker_image is None or not markers.names:
        return start, by_hand, None
    visible = lens.contains(start.project(markers.points), 5.0)
    names = [name for name, seen in zip(markers.names, visible, strict=True) if seen]
    if all(name in camera.marks for name in names):
        return start, by_hand, None
    return _searched(camera, start, by_hand, markers, capture)


def _searched(
    camera: CameraCapture,
    start: Camera,
    by_hand: MarkerObservation | None,
    markers: MarkerField,
    capture: Capture,
) -> tuple[Camera, MarkerObservation | None, FoundMarkers | None]:
    assert camera.marker_image is not None
    picture = camera.still(camera.marker_image, start.intrinsics)
    try:
        finds = find_markers(picture, start, markers, capture.settings.marker_kind)
    except CalibrationError:
        if by_hand is None:
            raise
        return start, by_hand, None
    observed = marker_observation({**finds.marks, **camera.marks}, markers)
    if observed is not None and 2 * len(camera.marks) < len(observed.ids):
        observed = replace(observed, searched=True)
    return start, observed, finds


def marker_observation(marks: dict[str, Floats], markers: MarkerField) -> MarkerObservation | None:
    """Marks by name as an observation; None if there are none."""
    if not marks:
        return None
    names = [name for name in markers.names if name in marks]
    ids = np.array([markers.index(name) for name in names], dtype=np.int64)
    return MarkerObservation(ids, np.stack([marks[name] for name in names]))
