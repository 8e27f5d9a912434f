"""`measure detect` on single pictures: found, told where, drawn, refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.cli import main
from measure.session import open_session, read_body, read_trajectory
from tests.cli.test_bad_input import complaint


@pytest.fixture
def picture(still: Path) -> Path:
    return still / "cam0" / "000000.jpg"


def seen_picture(capsys, *words: object) -> dict:
    assert main(["detect", *map(str, words), "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)["pictures"]
    return one


def seen(capsys, *words: object) -> list[dict]:
    return seen_picture(capsys, *words)["detections"]


def truth_px(still: Path) -> dict[str, tuple[np.ndarray, float]]:
    """The spheres' centres, and the mean radii of their outlines, in the first picture of cam0."""
    with open_session(still) as session:
        times_s = session.streams["cam0"].times_s[:1]
        pose = read_trajectory(still / "truth.csv").at(times_s)[0]
        camera, out = session.cameras[0], {}
        for ball, center in zip(session.body.balls, pose.apply(session.body.centers), strict=True):
            outline = camera.outline(center, ball.radius_mm)
            radius = np.linalg.norm(outline - outline.mean(axis=0), axis=1).mean()
            out[ball.name] = camera.project(center[None])[0], float(radius)
        return out


def test_the_balls_of_a_picture_are_found_and_drawn(still, picture, tmp_path, capsys):
    lens = ("--calibration", still / "calibration.toml", "--camera", "cam0")
    words = (picture, "--body", still / "body.toml", *lens, "-o", tmp_path / "drawn")
    found = seen(capsys, *words)
    scores = [one["score"] for one in found]
    assert scores == sorted(scores, reverse=True)
    best = {one["ball"]: one for one in reversed(found)}
    for ball, (center, _) in truth_px(still).items():
        if ball in best:
            assert np.linalg.norm(np.array(best[ball]["center_px"]) - center) < 2.0
    assert len(best) >= 2
    before, after = cv2.imread(str(picture)), cv2.imread(str(tmp_path / "drawn" / "000000.png"))
    changed = np.argwhere(np.any(before != after, axis=2))
    u, v = best[found[0]["ball"]]["center_px"]
    assert np.min(np.hypot(changed[:, 1] - u, changed[:, 0] - v)) < 3


def test_without_a_calibration_and_with_an_expectation(still, picture, capsys):
    (u, v), radius = truth_px(still)["yellow"]
    words = (picture, "--body", still / "body.toml", "--focal-px", "1420")
    (one,) = seen(capsys, *words, "--expect", f"yellow={u + 2:.1f},{v - 2:.1f},{radius:.1f}")
    assert one["ball"] == "yellow"
    assert np.linalg.norm(np.array(one["center_px"]) - (u, v)) < 1.0
    assert np.all(np.linalg.eigvalsh(one["covariance_px"]) > 0)
    assert seen(capsys, *words, "--expect", "yellow=60,60,63") == []


@pytest.mark.parametrize("where", ["--sample", "--expect"])
def test_a_body_is_written_with_the_colours_of_a_picture(still, picture, tmp_path, capsys, where):
    """Of a click, or inside an outline; what the file holds else stays, and nothing is lost."""
    (u, v), radius = truth_px(still)["yellow"]
    new, size = tmp_path / "sampled.toml", f",{radius:.1f}" if where == "--expect" else ""
    words = ("--focal-px", "1420", where, f"yellow={u:.1f},{v:.1f}{size}", "--write-body", new)
    seen(capsys, picture, "--body", still / "body.toml", *words)
    before, after = read_body(still / "body.toml"), read_body(new)
    assert "samples_bgr" in new.read_text(encoding="utf-8")
    assert np.array_equal(after.centers, before.centers)
    for old, ball in zip(before.balls, after.balls, strict=True):
        assert (ball.color == old.color) == (ball.name != "yellow")
    found = seen(capsys, picture, "--body", new, "--focal-px", "1420")
    near = [d for d in found if np.linalg.norm(np.array(d["center_px"]) - (u, v)) < 2]
    assert any(d["ball"] == "yellow" for d in near)
    text = new.read_bytes()
    line = complaint(capsys, "detect", picture, "--body", still / "body.toml", *words)
    assert "is there already: --overwrite replaces it" in line
    assert new.read_bytes() == text


def test_no_colour_is_learnt_where_no_ball_is(still, picture, tmp_path, capsys):
    """Black cloth, a stripe, a square: not of a ball; white is no colour of a yellow one."""
    black = np.full((240, 320, 3), (16, 20, 21), np.uint8)
    stripe, disc, white = black.copy(), black.copy(), black.copy()
    stripe[100:140], white[:] = (30, 30, 200), (20, 20, 20)
    cv2.circle(disc, (160, 120), 30, (30, 30, 200), -1)
    cv2.circle(white, (160, 120), 30, (230, 230, 230), -1)
    said = {
        "black": (black, "no ball-like patch, no colour here"),
        "stripe": (stripe, "no ball-like patch here"),
        "white": (white, "no colour here"),
        "disc": (disc, ""),
    }
    for name, (pixels, refusal) in said.items():
        given, new = tmp_path / f"{name}.png", tmp_path / f"{name}.toml"
        cv2.imwrite(str(given), pixels)
        words = (given, "--body", still / "body.toml", "--sample", "yellow=160,120")
        if refusal:
            assert refusal in complaint(capsys, "detect", *words, "--write-body", new)
        else:
            seen(capsys, *words, "--write-body", new)
        assert new.exists() != bool(refusal)
    body = (still / "body.toml").read_text("utf-8").replace('"yellow"', '"white"')
    (tmp_path / "whites.toml").write_text(body, "utf-8")
    words = (tmp_path / "white.png", "--body", tmp_path / "whites.toml")
    seen(capsys, *words, "--sample", "white=160,120", "--write-body", tmp_path / "new.toml")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--sample", "red=1,2"), "--write-body takes one picture and --sample or --expect"),
        (("--write-body", "new"), "--write-body takes one picture and --sample or --expect"),
        (("--sample", "red=1", "--write-body", "new"), "--sample red=1: expected BALL=U,V"),
        (("--sample", "red=1,9e3", "--write-body", "new"), "lies outside the picture of"),
        (("--sample", "blue=1,2", "--write-body", "new"), "--sample blue: the body has no such"),
        (("--expect", "red=60,60,63", "--write-body", "new"), "red is not seen: give --sample"),
        (("--expect", "blue=1,2,3"), "--expect blue: the body has no such ball, but green, yellow"),
        (("--expect", "red=1,2"), "--expect red=1,2: expected BALL=U,V,R"),
        (("--focal-px", "-3"), "--focal-px -3.0: expected a length in px above 0"),
        (("--camera", "cam0"), "--camera cam0: give the --calibration that holds it"),
        (("--calibration", "calibration.toml"), "which camera took the pictures? give --camera"),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(still, picture, tmp_path, capsys, words, said):
    given = [still / word if str(word).endswith(".toml") else word for word in words]
    given = [tmp_path / word if word == "new" else word for word in given]
    line = complaint(capsys, "detect", picture, "--body", still / "body.toml", *given)
    assert said in line
    assert not list(tmp_path.iterdir())


def test_a_picture_of_another_size_is_refused(still, tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((90, 160, 3), np.uint8))
    lens = ("--calibration", still / "calibration.toml", "--camera", "cam1")
    line = complaint(capsys, "detect", tmp_path / "small.png", "--body", still / "body.toml", *lens)
    assert "is 160x90 px, but" in line
    assert "1280x720" in line
