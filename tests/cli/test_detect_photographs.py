"""`measure detect` on photographs of unknown lenses, turned by their tags, of any size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image as Photograph

from measure.cli import main
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics
from measure.session import write_body
from tests.cli.test_detect import seen_picture
from tests.scenes import RAVEN

SIZE_WH = (1280, 960)
BGR = {"green": (60, 140, 40), "yellow": (30, 190, 210), "red": (35, 30, 180)}
OFF_AXIS = {"green": (160, 150, 110), "yellow": (1090, 200, 90), "red": (1000, 800, 130)}
_TURNS = {
    1: lambda p: p,
    2: np.fliplr,
    3: lambda p: np.rot90(p, 2),
    4: np.flipud,
    5: lambda p: p.swapaxes(0, 1),
    6: lambda p: np.rot90(p, 1),
    7: lambda p: np.rot90(p, 2).swapaxes(0, 1),
    8: lambda p: np.rot90(p, -1),
}
"""How a picture is stored that a viewer turns upright by the tag's value."""


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    file = tmp_path_factory.mktemp("body") / "body.toml"
    write_body(file, RAVEN)
    return file


def camera_of(focal_px):
    width, height = SIZE_WH
    lens = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    return Camera("camera", Intrinsics(SIZE_WH, lens), RigidTransform.identity())


def picture(focal_px, balls=OFF_AXIS):
    """Flat discs as a lens shows balls whose centres and mean radii those are."""
    pixels, camera = np.full((SIZE_WH[1], SIZE_WH[0], 3), 28, np.uint8), camera_of(focal_px)
    for color, (u, v, radius) in balls.items():
        axis, distance = camera.intrinsics.unproject(np.array([[u, v]], float))[0], 20.0
        for _ in range(9):
            outline = camera.outline(distance / 20 * focal_px / radius * 20 * axis, 20.0)
            distance *= np.linalg.norm(outline - outline.mean(axis=0), axis=1).mean() / radius
        points = np.rint(outline * 16).astype(np.int32)
        cv2.fillPoly(pixels, [points], BGR[color], cv2.LINE_AA, 4)
    noise = np.random.default_rng(0).normal(scale=2.0, size=pixels.shape)
    return np.clip(cv2.GaussianBlur(pixels, (0, 0), 0.8) + noise, 0, 255).astype(np.uint8)


def photograph(path, pixels, orientation=None, focal_35mm=None):
    tags = Photograph.Exif()
    if orientation:
        tags[0x0112] = orientation
    if focal_35mm:
        tags.get_ifd(0x8769)[0xA405] = focal_35mm
    Photograph.fromarray(np.ascontiguousarray(pixels[:, :, ::-1])).save(path, quality=95, exif=tags)
    return path


def best_of(one):
    return {d["ball"]: d for d in reversed(one["detections"])}


@pytest.mark.parametrize("focal_px", [700.0, 6000.0])
def test_the_focal_length_is_found_from_balls_off_the_axis(focal_px, body, tmp_path, capsys):
    file = photograph(tmp_path / "p.jpg", picture(focal_px))
    one = seen_picture(capsys, file, "--body", body)
    assert one["focal_from"] == "balls"
    if focal_px < 3000:
        assert one["focal_px"] == pytest.approx(focal_px, rel=0.1)
    else:  # outlines then hardly tell how much longer it is, nor depend on it
        assert one["focal_px"] > 3000
    best = best_of(one)
    for ball, (u, v, radius) in OFF_AXIS.items():
        assert np.hypot(*np.subtract(best[ball]["center_px"], (u, v))) < 1.0
        assert best[ball]["radius_px"] == pytest.approx(radius, abs=3.0)
        assert best[ball]["score"] > 0.85


def test_what_balls_do_not_tell_is_assumed_and_said(body, tmp_path, capsys):
    file = photograph(tmp_path / "p.jpg", picture(1600.0, {"red": (655, 470, 20)}))
    one = seen_picture(capsys, file, "--body", body)
    assert (one["focal_from"], one["focal_px"]) == ("assumed", pytest.approx(0.72 * 1280))
    assert main(["detect", str(file), "--body", str(body)]) == 0
    assert "focal length 922 px, an ordinary webcam's, assumed" in capsys.readouterr().out
    given = seen_picture(capsys, file, "--body", body, "--focal-px", "1600")
    assert (given["focal_from"], given["focal_px"]) == ("given", 1600.0)


def test_the_tags_of_a_photograph_tell_its_focal_length(body, tmp_path, capsys):
    pixels = picture(1600.0, {"red": (655, 470, 20)})
    one = seen_picture(
        capsys, photograph(tmp_path / "p.jpg", pixels, focal_35mm=43), "--body", body
    )
    assert one["focal_from"] == "exif"
    assert one["focal_px"] == pytest.approx(43 / np.hypot(36, 24) * 1600)
    cropped = photograph(tmp_path / "c.jpg", picture(6000.0), focal_35mm=26)
    assert seen_picture(capsys, cropped, "--body", body)["focal_from"] == "balls"


@pytest.mark.parametrize("tag", [1, 2, 6, 7])
def test_coordinates_are_those_of_a_viewer(tag, body, tmp_path, capsys):
    """Of what is found, expected, sampled and drawn, however the picture is stored."""
    file = photograph(tmp_path / "p.jpg", _TURNS[tag](picture(1600.0)), orientation=tag)
    one = seen_picture(capsys, file, "--body", body, "-o", tmp_path / "drawn")
    assert one["turned"] == (tag != 1)
    for ball, (u, v, _) in OFF_AXIS.items():
        found = best_of(one)[ball]
        assert np.hypot(*np.subtract(found["center_px"], (u, v))) < 0.8
        away = np.subtract((u, v), np.array(SIZE_WH) / 2)
        assert away @ np.array(found["covariance_px"]) @ away > 0
    drawn = cv2.imread(str(tmp_path / "drawn" / "p.png"))
    assert drawn.shape[1::-1] == SIZE_WH
    place = ("--expect", "red=1003,797,130")
    (told,) = seen_picture(capsys, file, "--body", body, *place)["detections"]
    assert np.hypot(*np.subtract(told["center_px"], (1000, 800))) < 0.8
    new = tmp_path / "new.toml"
    click = ("--sample", "green=160,150", "--write-body", new)
    assert main(["detect", str(file), "--body", str(body), *map(str, click)]) == 0
    said = capsys.readouterr().out
    assert ("turned as its tag asks" in said) == (tag != 1)
    assert "samples_bgr" in new.read_text(encoding="utf-8")


def test_broken_tags_are_no_tags(body, tmp_path, capsys):
    file = photograph(tmp_path / "p.jpg", picture(1600.0), orientation=6)
    data = file.read_bytes()
    at = data.index(b"Exif\x00\x00")
    file.write_bytes(data[: at + 6] + b"\xff" * 12 + data[at + 18 :])
    assert seen_picture(capsys, file, "--body", body)["turned"] is False
