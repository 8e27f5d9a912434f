"""What a camera learns from rendered pictures of a scene's balls."""

from __future__ import annotations

import numpy as np

from measure.geometry import tangent_cone
from measure.simulation import Renderer
from measure_plugins._outline.appearance.model import first_appearance
from measure_plugins._outline.self_calibration.schedule import AppearanceLearner

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


def learner_of(camera):
    """Of one camera that has seen nothing yet."""
    return AppearanceLearner(
        camera.intrinsics.row, camera.world_from_camera.rotation, rays=72, margin_px=7.0
    )


def taught(learner, pixels, seen, others, now):
    """What a picture that is shown teaches at once; None if nothing."""
    lesson = learner.shown(pixels, seen, others, now)
    return None if lesson is None else lesson()


def lessons(scene, camera_name, changed=lambda _, pixels, balls: (pixels, balls)):
    """What each of two pictures teaches one camera; `changed` may alter what is shown of each."""
    renderer, camera = Renderer(scene, camera_name), scene.camera(camera_name)
    learner, out = learner_of(camera), []
    for k, time_s in enumerate(TIMES_S):
        pixels, balls = changed(k, renderer.picture(time_s, k), cones(scene, camera, time_s))
        assert learner.wants(len(balls), time_s)
        out.append(taught(learner, pixels, balls, [], first_appearance("srgb")))
    return out


def settled(learner, scene, camera_name):
    """What a camera knows after the eight pictures, two and two alike, that it wants to see."""
    renderer, camera = Renderer(scene, camera_name), scene.camera(camera_name)
    shown = [
        (renderer.picture(time_s, k), cones(scene, camera, time_s))
        for k, time_s in enumerate(TIMES_S)
    ]
    now = first_appearance("srgb")
    for number in range(8):
        pixels, balls = shown[number % 2]
        if learner.wants(len(balls), number / 30):
            now = taught(learner, pixels, balls, [], now) or now
    assert learner.settled
    return now
