"""Ways to spoil a session, and those that spoil its body or its calibration."""

from __future__ import annotations

from collections.abc import Callable

from tests.session.conftest import Recording

Break = Callable[[Recording], object]
Case = tuple[Break, *tuple[str, ...]]
"""How it is spoilt, and what is said of it."""


def remove(name: str) -> Break:
    return lambda r: (r.path / name).unlink()


def replace(file: str, old: str, new: str) -> Break:
    return lambda r: r.replace(file, old, new)


BODY_OR_CALIBRATION: dict[str, Case] = {
    "wrong type": (
        replace("body.toml", "radius_mm = 20.0", 'radius_mm = "big"'),
        "body.toml:7: 'balls[0].radius_mm'",
        "got 'big'",
    ),
    "diameters for radii": (
        replace("body.toml", "radius_mm = 20.0", "radius_mm = 40.0"),
        "body.toml",
        "'green' and 'yellow' are 53.7 mm apart and overlap",
        "60.0 mm; are these dia",
    ),
    "two balls in one place": (
        replace("body.toml", "[0.0, 38.0, 0.0]", "[38.0, 0.0, 0.0]"),
        "body.toml",
        "'green' and 'yellow' are 0.0 mm apart",
    ),
    "a body in metres": (
        lambda r: [
            r.replace("body.toml", "radius_mm = 20.0", "radius_mm = 0.02") for _ in range(3)
        ],
        "body.toml",
        "the largest radius is 0.02 mm: this looks like metres: write mm",
    ),
    "a ball a thousand kilometres away": (
        replace("body.toml", "[0.0, 38.0, 0.0]", "[0.0, 1e9, 0.0]"),
        "body.toml:",
        "center_mm[1]': input should be less than or equal to 1000000, got",
    ),
    "unknown colour": (
        replace("body.toml", 'color = "red"', 'color = "rod"'),
        "body.toml:17: 'balls[2].color",
        "'rod' is not a colour known by name",
    ),
    "missing body": (
        lambda r: (r.path / "body.toml").rename(r.path / "bodyy.toml"),
        "body.toml: no such file; did you mean bodyy.toml?",
    ),
    "collinear balls": (
        replace("body.toml", "[0.0, 38.0, 0.0]", "[0.0, 0.1, 0.0]"),
        "body.toml: body 'triangle': the balls lie on one line",
    ),
    "two balls of one name": (
        replace("body.toml", 'name = "red"', 'name = "green"'),
        "two balls are called 'green'",
    ),
    "missing calibration": (
        remove("calibration.toml"),
        "calibration.toml: no such file; ",
        " holds body.toml, cam0,",
    ),
    "camera without calibration": (
        replace("calibration.toml", 'name = "cam1"', 'name = "other"'),
        "camera 'cam1' of",
        "has no calibration in",
        "there is one of cam0, other, cam2",
    ),
    "camera calibrated twice": (
        replace("calibration.toml", 'name = "cam1"', 'name = "cam0"'),
        "camera 'cam0' is there 2 times",
    ),
    "calibration of another size": (
        replace("calibration.toml", "size_wh = [64, 48]", "size_wh = [640, 480]"),
        "camera 'cam0': the images",
        "are 64x48 px",
        "calibrates 640x480 px",
    ),
    "calibration in metres": (
        lambda r: [
            r.replace("calibration.toml", f"[{200.0 * i}, 0.0, 500.0]", f"[{0.2 * i}, 0.0, 0.5]")
            for i in range(3)
        ],
        "calibration.toml: the cameras stand within 0.4 mm",
        "metres",
    ),
    "cameras a thousand kilometres apart": (
        replace("calibration.toml", "[200.0, 0.0, 500.0]", "[1e9, 0.0, 500.0]"),
        "calibration.toml: the cameras stand up to 1e+09 mm apart",
    ),
    "calibration is not a rotation": (
        replace("calibration.toml", "[0.0, 1.0, 0.0, 0.0]", "[0.0, 1.0, 0.5, 0.0]"),
        "calibration.toml:6: 'cameras[0].quat_wxyz': not a rotation",
        "length is 1.118",
    ),
    "calibration is not finite": (
        replace("calibration.toml", "[0.0, 0.0, 500.0]", "[0.0, nan, 500.0]"),
        "calibration.toml:7: 'cameras[0].translation_mm",
        "finite",
    ),
    "impossible camera matrix": (
        replace("calibration.toml", "[[70.0,", "[[-70.0,"),
        "calibration.toml:4: 'cameras[0].matrix': not a camera matrix",
    ),
    "focal length of no lens": (
        replace("calibration.toml", "[[70.0,", "[[1e8,"),
        "calibration.toml: camera 'cam0': no lens sees pictures of 64x48 px",
    ),
    "skew of no lens": (
        replace("calibration.toml", "[[70.0, 0.0,", "[[70.0, 1e8,"),
        "calibration.toml: camera 'cam0': no lens sees",
    ),
    "distortion of no lens that has an inverse": (
        replace("calibration.toml", "distortion = [", "distortion = [1e5, 0.0, 0.0, 0.0"),
        "calibration.toml: camera 'cam0': no lens sees",
    ),
    "distortion of no lens": (
        replace("calibration.toml", "distortion = [", "distortion = [-1e3, 1e5, 0.0, 0.0"),
        "calibration.toml: camera 'cam0': no lens sees",
    ),
}
