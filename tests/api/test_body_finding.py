"""A body found in a recording: its distances and their uncertainty, its frame, and refusals."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure import api
from measure.api.refining import _frame_like
from measure.checking.unknown_body import (
    PALETTES,
    find_layout,
    left_out,
    locate,
    probe,
    search_bodies,
    wrong_size,
)
from measure.cli.app import main
from measure.errors import ConfigError, SessionError
from measure.estimation.body_layout import looks_mirrored
from measure.geometry import RigidTransform
from measure.model import BallColor
from measure.session import read_body
from tests.scenes import FOUR, RAVEN, a_pose, ring, see

COLORS = ("white", "blue", "orange", "green", "yellow", "red")


def seen_frames(body, radius_mm, count=20, colors=COLORS, scale=1.0):
    """Balls located in simulated frame sets with 0.2 px of noise, by the colours searched for.

    By a calibration `scale` times too large.
    """
    cameras, rng, frames = ring(), np.random.default_rng(3), []
    for _ in range(count):
        found = {}
        for detection in see(cameras, body, a_pose(rng), sd_px=0.2, rng=rng):
            found.setdefault(detection.camera, []).append(detection)
        frames.append(locate(found, probe(colors, scale * radius_mm), list(cameras.values())))
    return frames, probe(colors, scale * radius_mm)


@pytest.mark.parametrize("body", [RAVEN, FOUR], ids=["three", "four"])
def test_the_layout_follows_from_what_stays_as_far_apart(body):
    frames, searched = seen_frames(body, body.radii[0])
    found = find_layout(frames, searched, pick=True)
    assert set(found.names) == set(body.names)
    np.testing.assert_allclose(found.centers.mean(axis=0), 0, atol=1e-9)
    truth = body.centers_of(found.names)
    for i in range(len(truth)):
        off = np.linalg.norm(found.centers - found.centers[i], axis=1)
        np.testing.assert_allclose(off, np.linalg.norm(truth - truth[i], axis=1), atol=0.3)
    assert not looks_mirrored(truth, found.centers)


@pytest.mark.parametrize("factor", [0.5, 0.8, 25 / 27, 1.25, 2.0])
def test_a_wrong_radius_is_refused_with_the_one_that_is_seen(factor):
    frames, searched = seen_frames(RAVEN, RAVEN.radii[0], scale=factor)
    with pytest.raises(SessionError, match=r"radius of (19\.\d\d|20\.\d\d) mm.*square measured"):
        find_layout(frames, searched, pick=True)


def test_balls_that_do_not_agree_on_their_size_refuse_none():
    """By a common colour some look too large, and others too small, in every picture."""
    frames, searched = seen_frames(FOUR, FOUR.radii[0])
    looks = dict(zip(FOUR.names, (1.09, 0.94, 1.06, 1.07), strict=True))
    uneven = [
        {n: replace(ball, radius_mm=looks[n] * ball.radius_mm) for n, ball in f.items()}
        for f in frames
    ]
    assert set(find_layout(uneven, searched, pick=True).names) == set(FOUR.names)
    alike = [
        {n: replace(ball, radius_mm=1.1 * ball.radius_mm) for n, ball in f.items()} for f in frames
    ]
    with pytest.raises(SessionError, match="square measured"):
        find_layout(alike, searched, pick=True)


def test_a_size_too_near_to_refuse_explains_what_fails_later():
    frames, searched = seen_frames(RAVEN, RAVEN.radii[0], scale=1.04)
    assert set(find_layout(frames, searched, pick=True).names) == set(RAVEN.names)
    assert "Squares 1.0" in wrong_size(frames, searched)
    assert not wrong_size(*seen_frames(RAVEN, RAVEN.radii[0]))


def test_balls_that_do_not_move_together_are_no_body():
    frames, searched = seen_frames(RAVEN, 20.0)
    others, _ = seen_frames(RAVEN.with_centers(1.2 * RAVEN.centers), 20.0)
    with pytest.raises(SessionError, match="no three of them keep their distances"):
        find_layout(frames[:10] + others[:10], searched, pick=True)


def test_two_colors_are_no_body():
    frames, searched = seen_frames(RAVEN, 20.0)
    poorer = [{n: ball for n, ball in f.items() if n != "red"} for f in frames]
    with pytest.raises(SessionError, match=r"2 balls \(green, yellow\) seen.*needs 3 balls"):
        find_layout(poorer, searched, pick=True)


def test_two_balls_of_one_color_are_refused():
    cameras, rng, frames = ring(), np.random.default_rng(5), []
    twin = FOUR.with_centers(FOUR.centers + np.array([0.0, 0.0, 90.0]))
    for _ in range(12):
        pose, found = a_pose(rng), {}
        both = see(cameras, FOUR, pose) + [d for d in see(cameras, twin, pose) if d.ball == "blue"]
        for detection in both:
            found.setdefault(detection.camera, []).append(detection)
        frames.append(locate(found, probe(COLORS, 15.0), list(cameras.values())))
    with pytest.raises(SessionError, match=r"two blue balls are seen.*--like"):
        find_layout(frames, probe(COLORS, 15.0), pick=True)


@pytest.mark.parametrize("count", [0, 1, 3, 9])
def test_learnt_colors_are_searched_beside_the_common_ones(count):
    """In bodies of three to eight colours, as many as a detector tells apart at once."""
    learnt = {f"mine {k}": BallColor.named("blue") for k in range(count)}
    common = {color for group in PALETTES for color in group}
    for without in ((), ("blue", "white"), common if count >= 3 else ()):
        searched = search_bodies(15.0, learnt, without)
        names = [name for body in searched for name in body.names]
        assert sorted(names) == sorted((common - {*without}) | learnt.keys())
        assert all(3 <= len(body.balls) <= 8 for body in searched)
        assert all(b.color is learnt[b.name] for p in searched for b in p.balls if b.name in learnt)


def test_fewer_than_three_colors_are_no_body():
    common = {color for group in PALETTES for color in group}
    with pytest.raises(SessionError, match="needs 3 balls"):
        search_bodies(15.0, {"mine": BallColor.named("blue")}, common - {"red"})


@pytest.mark.slow
def test_a_session_without_a_body_gives_one_within_its_uncertainty(still, tmp_path, capsys):
    session = tmp_path / "session"
    shutil.copytree(still, session)
    truth = read_body(session / "body.toml")
    (session / "body.toml").unlink()
    out = tmp_path / "found.toml"
    assert main(["body", str(session), "--radius-mm", "20", "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    for row in told["distances"]:
        ends = truth.centers_of([row["from"], row["to"]])
        off = row["distance_mm"] - np.linalg.norm(ends[0] - ends[1])
        assert abs(off) < 3 * row["sd_mm"] < 0.3
    found = read_body(out)
    assert found.tolerance_mm == pytest.approx(told["tolerance_mm"])
    assert set(found.names) == set(truth.names)
    aligned = tmp_path / "like.toml"
    shutil.copy(still / "body.toml", tmp_path / "known.toml")
    words = ["body", str(session), "--radius-mm", "20.7", "--like", str(tmp_path / "known.toml")]
    assert main([*words, "-o", str(aligned), "--json"]) == 0
    for radius_mm, sd_mm in json.loads(capsys.readouterr().out)["seen_radii_mm"].values():
        assert abs(radius_mm - 20) < 3 * sd_mm < 0.3, "a radius 3.5 % off does no harm"
    np.testing.assert_allclose(read_body(aligned).centers, truth.centers, atol=0.1)


def _as_measured(body, name, by):
    """Centres in the world, the file's body, and distances, where the file has a ball elsewhere."""
    place = RigidTransform.from_rotvec([0.3, -0.5, 0.2], [40.0, -20.0, 250.0])
    filed = body.centers.copy()
    filed[body.index(name)] += by
    pairs = {pair: (mm, 0.03) for pair, mm in body.distances().items()}
    return place.apply(body.centers), body.with_centers(filed), pairs


@pytest.mark.parametrize(
    ("body", "name", "by"),
    [
        (RAVEN, "yellow", [0, 3, 0]),
        (FOUR, FOUR.names[1], [1, 2, -2]),
        (FOUR, FOUR.names[3], [-3, 0, 1]),
    ],
)
def test_one_ball_that_a_file_has_elsewhere_moves_no_frame(body, name, by) -> None:
    centers, filed, distances = _as_measured(body, name, np.array(by, dtype=float))
    like, words = _frame_like(centers, body.names, filed, distances)
    np.testing.assert_allclose(like.inverse().apply(centers), body.centers, atol=1e-6)
    others = ", ".join(n for n in body.names if n != name)
    assert f"fitted to {others}: {name} lies {np.linalg.norm(by):.2f} mm from where" in words


def test_a_frame_is_fitted_to_all_where_they_agree_or_nothing_tells() -> None:
    centers, filed, distances = _as_measured(RAVEN, "yellow", np.zeros(3))
    like, words = _frame_like(centers, RAVEN.names, filed, distances)
    np.testing.assert_allclose(like.inverse().apply(centers), RAVEN.centers, atol=1e-6)
    assert words == "fitted to all balls"
    centers, filed, distances = _as_measured(RAVEN, "yellow", np.array([2.0, 2.0, 0.0]))
    filed = filed.with_centers(filed.centers + np.array([[0, 1.5, 0], [0, 0, 0], [-2.0, 0, 0]]))
    _, words = _frame_like(centers, RAVEN.names, filed, distances)
    assert "their distances do not tell which of them is off" in words


def test_what_is_seen_but_no_ball_of_the_body_is_said():
    frames, searched = seen_frames(RAVEN, 20.0)
    off = [np.array([0.0, 0.0, 90 + 9 * i % 50]) for i in range(len(frames))]
    white = [
        f | {"white": replace(f["red"], center=f["red"].center + by)}
        for f, by in zip(frames, off, strict=True)
    ]
    (said,) = left_out(white, searched, RAVEN.names)
    assert "white is seen, but left out: its distances from the others change by" in said
    assert left_out(frames, searched, RAVEN.names) == ()


def test_the_colour_of_a_ball_is_learnt_from_a_pixel_on_it(tmp_path):
    picture = np.full((240, 320, 3), 90, np.uint8)
    teal = (150, 140, 20)
    cv2.circle(picture, (100, 80), 30, teal, -1)
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    colors = api.learnt_colors([f"lid={tmp_path / 'a.png'}:100,80"])
    assert colors["lid"].matches(np.array([teal])).all()
    assert not colors["lid"].matches(np.array([[30, 30, 200]])).any()
    with pytest.raises(ConfigError, match="--sample lid=200,200: no ball-like patch"):
        api.learnt_colors([f"lid={tmp_path / 'a.png'}:200,200"])
    with pytest.raises(ConfigError, match="expected NAME=PICTURE:U,V"):
        api.learnt_colors(["lid=100,80"])
