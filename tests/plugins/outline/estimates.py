"""Estimates of a camera's appearance from rendered pictures of a scene's balls."""

from __future__ import annotations

import numpy as np

from measure.geometry import tangent_cone
from measure_plugins._outline.appearance.model import first_appearance
from measure_plugins._outline.self_calibration.schedule import SelfCalibration
from tests.plugins.rendering import picture

TIMES_S = (0.0, 0.4)


def cones(scene, camera, time_s):
    """Axis, half angle and distance of every ball, where the scene puts it."""
    pose = scene.trajectory.at(np.array([time_s]))[0]
    out = []
    for ball in scene.body.balls:
        center = camera.camera_from_world.apply(pose.apply(ball.center_mm))
        cone = tangent_cone(center, ball.radius_mm)
        out.append((cone.axis, cone.half_angle, float(np.linalg.norm(center))))
    return out


def calibration_of(camera):
    """The self-calibration of a camera before its first picture."""
    return SelfCalibration(
        camera.intrinsics.row, camera.world_from_camera.rotation, rays=72, margin_px=7.0
    )


def estimated(calibration, pixels, seen, others, now):
    """The estimate that is due with a picture; None if none is."""
    estimate = calibration.add_image(pixels, seen, others, now)
    return None if estimate is None else estimate()


def estimates(scene, camera_name, changed=lambda _, pixels, balls: (pixels, balls)):
    """One camera's estimates with each of two pictures, which `changed` may alter."""
    camera = scene.camera(camera_name)
    calibration, out = calibration_of(camera), []
    for k, time_s in enumerate(TIMES_S):
        pixels, balls = changed(
            k, picture(scene, camera_name, time_s, k), cones(scene, camera, time_s)
        )
        assert calibration.wants_image(len(balls), time_s)
        out.append(estimated(calibration, pixels, balls, [], first_appearance("srgb")))
    return out


def settled(calibration, scene, camera_name):
    """A camera's appearance after eight pictures, every other one the same."""
    camera = scene.camera(camera_name)
    shown = [
        (picture(scene, camera_name, time_s, k), cones(scene, camera, time_s))
        for k, time_s in enumerate(TIMES_S)
    ]
    now = first_appearance("srgb")
    for number in range(8):
        pixels, balls = shown[number % 2]
        if calibration.wants_image(len(balls), number / 30):
            now = estimated(calibration, pixels, balls, [], now) or now
    assert calibration.settled
    return now
