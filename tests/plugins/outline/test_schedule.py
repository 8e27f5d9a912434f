"""Which pictures of a recording are estimated from."""

from __future__ import annotations

from measure_plugins._outline.appearance.model import first_appearance
from tests.plugins.outline.estimates import calibration_of, cones
from tests.plugins.rendering import picture, scenes


def estimates_of(calibration, scene, camera_name, pictures):
    """Those of the numbered pictures with which an estimate is due; all show the same."""
    camera = scene.camera(camera_name)
    pixels, balls = picture(scene, camera_name, 0.0), cones(scene, camera, 0.0)
    out = []
    for number in pictures:
        if calibration.wants_image(len(balls), number / 30):
            now = first_appearance("srgb")
            if calibration.add_image(pixels, balls[:1], balls[1:], now) is not None:
                out.append(number)
    return out


def test_pictures_that_come_again_are_not_estimated_from():
    scene = scenes()["still"]
    calibration = calibration_of(scene.camera("cam1"))
    assert estimates_of(calibration, scene, "cam1", range(1, 8)) == [2]
    assert not calibration.settled
    assert estimates_of(calibration, scene, "cam1", range(8, 9)) == [8]
    assert calibration.settled
    assert estimates_of(calibration, scene, "cam1", range(1, 40)) == [32]
    assert estimates_of(calibration, scene, "cam1", range(40)) == []


def test_the_second_estimate_follows_a_short_burn_in():
    scene = scenes()["still"]
    calibration = calibration_of(scene.camera("cam1"))
    assert estimates_of(calibration, scene, "cam1", range(1, 6)) == [2]
    assert estimates_of(calibration, scene, "cam1", range(1, 10)) == [8]


def test_pictures_that_were_missed_count_as_well_once_there_are_estimates():
    """As where a run is resumed: what follows a gap is then as if all had been seen."""
    scene = scenes()["still"]
    calibration = calibration_of(scene.camera("cam1"))
    assert estimates_of(calibration, scene, "cam1", [1, 20]) == [20], "none of before"
    calibration = calibration_of(scene.camera("cam1"))
    assert estimates_of(calibration, scene, "cam1", [*range(1, 9), *range(30, 40)]) == [2, 8, 32]
