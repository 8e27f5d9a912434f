"""What the balls' distances over a run say against the body file."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from measure.results import RunWriter, read_run
from tests.results.conftest import BODY, CAMERAS, made_from, measurement

SD_MM = 0.04


def notes(folder, stated, noise_mm=0.0, sets=8, size=1.0):
    """Of a run in which BODY's balls are located where they are, but `stated` is the body file."""
    rng = np.random.default_rng(2)
    covariance = np.diag([SD_MM**2] * 3 + [1e-6] * 3)
    with RunWriter(folder, made_from(), [stated], CAMERAS) as writer:
        for index in range(sets):
            found = measurement(index, covariance=covariance, size=size)
            positions = [
                replace(f, center=f.center + rng.normal(0, noise_mm, 3)) for f in found.positions
            ]
            writer.append(replace(found, positions=tuple(positions)))
        summary = writer.finish()
    again, said = read_run(folder).summary, list(map(str, summary.notes))
    assert again == summary
    assert list(map(str, again.notes)) == said
    return tuple(n for n in said if not n.startswith("note: with green and red exch"))


def resized(share, *names):
    """BODY with some balls, or all, further from the origin."""
    balls = [
        replace(b, center_mm=b.center_mm * (share if b.name in names or not names else 1.0))
        for b in BODY.balls
    ]
    return replace(BODY, balls=tuple(balls))


def test_nothing_is_said_of_the_right_body(folder):
    assert notes(folder, BODY, noise_mm=SD_MM) == ()


def test_a_body_a_hundredth_smaller_than_its_file_says_is_told(folder):
    (note,) = notes(folder, resized(1.01), noise_mm=SD_MM)
    finding = json.loads((folder / "summary.json").read_text())["findings"][0]
    assert (finding["code"], finding["subject"], finding["level"]) == ("ball-place", "all", "wrong")
    assert abs(finding["estimate"] - 1 / 1.01) < 2 * finding["sd"]
    assert "scale of all" in finding["rivals"]
    said = re.match(r"wrong: the balls are (\S+) \+- (\S+) times as far apart as the body", note)
    assert said is not None, note
    assert abs(float(said[1]) - 1 / 1.01) < 2 * float(said[2])
    assert "or the scale of the calibration is off, " in note


def test_a_ball_that_sits_elsewhere_is_told(folder):
    (note,) = notes(folder, resized(1.015, "yellow"), noise_mm=SD_MM)
    assert "ball yellow is not where the body file says" in note


@pytest.mark.parametrize("change", ["less than it could tell", "too few frame sets"])
def test_what_may_be_chance_is_not_told(folder, change):
    few = change == "too few frame sets"
    assert notes(folder, resized(1.01 if few else 1.002), sets=4 if few else 8) == ()


def test_uncertainty_holds_what_all_frame_sets_err_by_alike(folder):
    notes(folder, BODY)
    for distance in read_run(folder).distances:
        assert distance.uncertainty_mm == pytest.approx(np.sqrt(2) * SD_MM)


@pytest.mark.parametrize(("size", "word"), [(0.99, "smaller"), (1.01, "larger")])
def test_balls_that_all_look_larger_or_smaller_are_told(folder, size, word):
    (note,) = notes(folder, BODY, size=size)
    assert f"all balls look {word} than the body file says, by 1.0% +- 0." in note
    assert f"green {20 * size:.2f} +- 0." in note
    assert "callipers" in note


def test_sizes_within_the_stated_tolerance_are_not_told(folder):
    assert notes(folder, replace(BODY, radius_tolerance_mm=0.3), size=0.99) == ()
