from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure_plugins._outline.appearance.model import DEFAULT_CORRECTION_WEIGHT, MATT
from measure_plugins._outline.appearance.point_lights import (
    lights_about,
    no_point_lights,
    shade_by_lights,
)
from measure_plugins._outline.appearance.radial_basis import fresnel, radial_tables
from measure_plugins._outline.appearance.render import Ambient
from measure_plugins._outline.appearance.shading import fit_shading, shaded, shading_functions
from measure_plugins._outline.fitting.edges import (
    PredictionInputs,
    corrected_edges,
    find_edge_pairs,
)
from measure_plugins._outline.sampling.rays import (
    OCCLUDED,
    STEPS,
    cast_rays,
    frame_about,
    middle_angles,
)
from tests.plugins.outline.estimates import calibration_of, cones, estimates, settled
from tests.plugins.rendering import picture, plain

CAMERA = "cam1"
HALF_ANGLE, RADIUS_PX = 0.045, 63.0
TABLES = radial_tables(RADIUS_PX, HALF_ANGLE, 0.9, 1.5)
TURNS = np.linspace(0, 2 * np.pi, 72, endpoint=False)
AROUND = np.column_stack([np.cos(TURNS), np.sin(TURNS)])
USED = int(np.searchsorted(STEPS, 1.0, side="right"))


KEPT_OUT = float(TABLES.fresnel_loss[0])


def _lamp(direction, power=1.0):
    unit = np.array(direction) / np.linalg.norm(direction)
    return np.array([[*unit, power]])


def _normals(j):
    """Normals (72, 3) at step j of the rays, in the frame about the axis; incidence in rad."""
    beta = HALF_ANGLE * (1 + STEPS[j] / RADIUS_PX)
    incidence = np.arcsin(np.sin(beta) / np.sin(HALF_ANGLE))
    tilt = incidence - beta
    return np.column_stack([np.sin(tilt) * AROUND, np.full(72, -np.cos(tilt))]), incidence


def test_a_point_light_shades_by_the_cosine_up_to_its_terminator():
    light = _lamp([0.0, -0.8, 0.6], 2.0)  # from behind the ball, as a lamp overhead often is
    matt, j = radial_tables(RADIUS_PX, HALF_ANGLE, 0.9, MATT), int(np.searchsorted(STEPS, -8.0))
    expected = 2 * np.maximum(_normals(j)[0] @ light[0, :3], 0)
    lit = shade_by_lights(matt.diffuse, matt.fresnel_loss[0], AROUND, light)[j]
    assert lit == pytest.approx(expected, abs=0.02)
    assert np.count_nonzero(expected) < 40


def test_light_entering_a_glossy_surface_has_a_fresnel_loss():
    light, j = _lamp([0.0, -0.8, 0.6], 2.0), int(np.searchsorted(STEPS, -8.0))
    normals, incidence = _normals(j)
    cosine = np.maximum(normals @ light[0, :3], 0)
    entering = (1 - fresnel(cosine, 1.5)) / (1 - fresnel(np.ones(1), 1.5))
    leaving = 1 - fresnel(np.array([np.cos(incidence)]), 1.5)[0]
    lit = shade_by_lights(TABLES.diffuse, KEPT_OUT, AROUND, light)[j]
    assert lit == pytest.approx(2 * cosine * entering * leaving, abs=0.03)
    unweakened = shade_by_lights(TABLES.diffuse, 0.0, AROUND, light)[j]
    assert np.max(unweakened - lit) > 0.1


def test_a_near_light_has_another_direction_for_each_ball():
    light = np.array([[0.0, -800.0, 300.0, 0.5]])  # above the camera, mm
    left, right = np.array([-0.2, 0.0, 1.0]), np.array([0.2, 0.0, 1.0])
    for axis in (left / np.linalg.norm(left), right / np.linalg.norm(right)):
        frame, ball = frame_about(axis), 400 * axis
        seen = lights_about(light, frame, 400.0)[0]
        way = light[0, :3] - ball
        assert frame.T @ seen[:3] == pytest.approx(way / np.linalg.norm(way))
        assert seen[3] == pytest.approx(0.5 * 1e6 / (way @ way))


def test_shading_is_fitted_robustly():
    lit = shade_by_lights(TABLES.diffuse, KEPT_OUT, AROUND, _lamp([0.3, -0.9, -0.2]))
    true = np.array([0.1, 0.02, -0.03, 0.05, 0.7])
    functions = shading_functions(AROUND, TABLES.diffuse, lit)
    amounts = shaded(true, functions)
    rng, status = np.random.default_rng(1), np.zeros(72, np.int8)
    amounts[rng.random(amounts.shape) < 0.15] += 0.5  # a highlight, say
    status[10:20] = OCCLUDED
    amounts[:, 10:20] = 5.0
    found = fit_shading(amounts, status, functions, USED)
    assert found == pytest.approx(true, abs=0.01)


@pytest.fixture(scope="module")
def scene():
    return plain("black", 11)


@pytest.fixture(scope="module")
def estimated_appearance(scene):
    return estimates(scene, CAMERA)[-1]


@pytest.fixture(scope="module")
def together(scene):
    """The camera's appearance fused with the others'."""
    calibrations = {camera.name: calibration_of(camera) for camera in scene.cameras}
    alone = {name: settled(calibration, scene, name) for name, calibration in calibrations.items()}
    known = [calibration.estimate for calibration in calibrations.values()]
    return calibrations[CAMERA].fuse(alone[CAMERA], known, bent=False)


def _upside_down(scene):
    """Shows the second picture turned upside down, lamps and all."""
    camera = scene.camera(CAMERA)

    def changed(k, pixels, balls):
        if k == 0:
            return pixels, balls
        middle = (np.array(pixels.shape[1::-1]) - 1) / 2
        turned = [(_turned(camera, axis, middle), *rest) for axis, *rest in balls]
        return np.ascontiguousarray(pixels[::-1, ::-1]), turned

    return changed


def _turned(camera, axis, middle):
    place = camera.intrinsics.project(axis[None])[0]
    ray = camera.intrinsics.unproject((2 * middle - place)[None])[0]
    return ray / np.linalg.norm(ray)


def test_estimated_lights_shade_a_ball_as_the_scenes_do(scene, estimated_appearance):
    normals, true = _true_light(scene)
    seen = normals[:, 2] < -0.1
    assert np.all(estimated_appearance.point_lights[:, 3] > 0)
    point_lights = _from_the_middle(scene, estimated_appearance.point_lights)
    assert _unlike(point_lights, normals[seen], true[seen]) < 0.03
    from_below = point_lights * [1, -1, 1, 1]
    assert _unlike(from_below, normals[seen], true[seen]) > 0.1


def test_other_cameras_improve_the_light_on_the_far_side(scene, estimated_appearance, together):
    normals, true = _true_light(scene)
    far = normals[:, 2] > 0.1
    alone, fused = (
        _unlike(_from_the_middle(scene, one.point_lights), normals[far], true[far])
        for one in (estimated_appearance, together)
    )
    assert fused < 0.02
    assert fused < 0.75 * alone


def _true_light(scene):
    """Normals (n, 3) of a ball in the middle, in the camera frame, and the light (n,) they get."""
    turn = scene.camera(CAMERA).camera_from_world
    middle = scene.trajectory.at(np.array([0.0]))[0].apply(np.zeros(3))
    normals = np.random.default_rng(0).normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    true = np.zeros(len(normals))
    for light in scene.lighting.lights:
        way = light.position_mm - middle
        away = np.linalg.norm(way)
        power = light.irradiance_rgb[0] * (1000 / away) ** 2
        cosine = np.maximum(normals @ turn.rotate(way / away), 0)
        true += power * cosine * (1 - fresnel(cosine, 1.42))  # glossy: some light stays outside
    up = turn.rotate(np.array([0.0, 0.0, 1.0]))
    below = scene.lighting.below
    true += scene.lighting.ambient_rgb[0] * (below + (1 - below) * (1 + normals @ up) / 2)
    return normals, true


def _from_the_middle(scene, point_lights):
    """Lamps (k, 4) as a ball in the middle sees them, in the camera frame."""
    middle = scene.trajectory.at(np.array([0.0]))[0].apply(np.zeros(3))
    at = scene.camera(CAMERA).camera_from_world.apply(middle)
    distance = float(np.linalg.norm(at))
    frame = frame_about(at / distance)
    seen = lights_about(point_lights, frame, distance)
    seen[:, :3] = seen[:, :3] @ frame
    return seen


def _unlike(point_lights, normals, true):
    """What is left of true light (n,), as a share, by that of lamps and light from all round."""
    cosine = np.maximum(normals @ point_lights[:, :3].T, 0)
    found = (cosine * (1 - KEPT_OUT * (1 - cosine) ** 5)) @ point_lights[:, 3]
    design = np.column_stack([found, np.ones(len(normals)), normals])
    left = true - design @ np.linalg.lstsq(design, true, rcond=None)[0]
    return np.sqrt(np.mean(left**2) / np.mean(true**2))


def test_point_lights_reduce_edge_error_on_the_dark_side(scene, estimated_appearance, together):
    dark_with, bright_with = _mean_errors(scene, together)
    dark_without, bright_without = _mean_errors(
        scene, replace(together, point_lights=no_point_lights())
    )
    assert dark_without > 0.1, "a polynomial runs on past the terminator"
    assert abs(dark_with) < 0.5 * dark_without
    assert abs(bright_with) < abs(bright_without) + 0.05
    assert abs(dark_with) < 0.5 * abs(_mean_errors(scene, estimated_appearance)[0]), (
        "one camera alone"
    )


def _mean_errors(scene, appearance):
    """Mean px outside the true outlines: where no lamp shines on the limb, and elsewhere."""
    camera, pose = scene.camera(CAMERA), scene.trajectory.at(np.array([0.0]))[0]
    pixels = picture(scene, CAMERA, 0.0)
    dark, bright, table = [], [], appearance.table
    for ball, (axis, half_angle, distance) in zip(
        scene.body.balls, cones(scene, scene.camera(CAMERA), 0.0), strict=True
    ):
        frame = frame_about(axis)
        rays, scale = cast_rays(frame, half_angle, 72, camera.intrinsics.row)
        size = half_angle * float(np.mean(scale))
        tables = radial_tables(size, half_angle, appearance.blur_px, appearance.index)
        point_lights = lights_about(appearance.point_lights, frame, distance)
        light = shade_by_lights(
            tables.diffuse, tables.fresnel_loss[0], middle_angles(rays.around), point_lights
        )
        ambient = Ambient(light, np.zeros((8, 0)))
        found = find_edge_pairs(
            PredictionInputs(pixels, table, appearance.encoding, rays, tables, ambient)
        )
        edges = corrected_edges(found, DEFAULT_CORRECTION_WEIGHT)
        center = pose.apply(ball.center_mm)
        limb = rays.around @ frame[:2] @ camera.camera_from_world.rotation
        lit = np.full(72, -1.0)
        for light in scene.lighting.lights:
            way = light.position_mm - center
            lit = np.maximum(lit, limb @ way / np.linalg.norm(way))
        good = (np.abs(edges.shifts) < 1.6) & (edges.contrast > 0.06)
        dark.append(edges.shifts[good & (lit < -0.1)])
        bright.append(edges.shifts[good & (lit > 0.1)])
    return float(np.mean(np.concatenate(dark))), float(np.mean(np.concatenate(bright)))


def test_inconsistent_pictures_give_no_point_lights(scene):
    assert len(estimates(scene, CAMERA, _upside_down(scene))[-1].point_lights) == 0


def test_light_from_all_round_gives_no_point_lights(scene):
    """More of it comes from above: that needs no lamps either."""
    dull = replace(scene, lighting=replace(scene.lighting, lights=(), ambient_rgb=(0.6, 0.6, 0.6)))
    assert len(estimates(dull, CAMERA)[-1].point_lights) == 0
    assert len(estimates(scene, CAMERA)[-1].point_lights) > 1
