"""Bringing what was seen at different times to one instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from measure.model import Body, Camera, Detection, Motion


def detection_at(
    detection: Detection, time_s: float, motion: Motion, body: Body, cameras: Mapping[str, Camera]
) -> Detection:
    """The detection as it would have been at `time_s`, by the body's predicted motion.

    Only the centre is moved; outline points stay as they were seen. To first order the error of the
    prediction's *position* cancels, only that of its velocity counts.
    """
    camera = cameras[detection.camera]
    center = body.balls[body.index(detection.ball)].center_mm
    then, now = motion.at(detection.time_s).apply(center), motion.at(time_s).apply(center)
    before, after = camera.project([then, now])
    return replace(detection, center_px=detection.center_px + (after - before), time_s=time_s)
