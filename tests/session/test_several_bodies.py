"""Bodies that are measured together are told apart, or refused by name."""

from __future__ import annotations

import re

import numpy as np
import pytest

from measure.errors import MeasureError, SessionError
from measure.model import Ball, BallColor, Body
from measure.session import check_bodies, read_bodies, read_trajectory, write_bodies

PLACES = {"green": (38.0, 0.0, 0.0), "yellow": (0.0, 38.0, 0.0), "red": (-30.0, -6.0, 8.0)}


def body(name, places=PLACES, **colors):
    return Body(
        name,
        tuple(
            Ball(ball, BallColor.named(colors.get(ball, ball)), np.array(place), 15.0)
            for ball, place in places.items()
        ),
    )


def shifted(mm):
    return PLACES | {"red": (-30.0 - mm, -6.0, 8.0)}


def test_equal_layouts_in_other_colors_and_other_layouts_in_equal_colors_pass():
    tool = body("tool")
    check_bodies([tool, body("base", green="blue", yellow="orange", red="purple")], "base", "x")
    check_bodies([tool, body("base", shifted(12.0))], "", "x")


@pytest.mark.parametrize("other", [body("base"), body("base", shifted(1.5))])
def test_bodies_that_look_alike_are_refused_by_name(other):
    with pytest.raises(SessionError, match="'tool' and 'base' cannot be distinguished"):
        check_bodies([body("tool"), other], "", "session.toml")


def test_a_body_inside_a_larger_one_is_refused():
    turned = body("turned", PLACES | {"blue": (5.0, -30.0, 20.0)})
    with pytest.raises(SessionError, match="cannot be distinguished"):
        check_bodies([turned, body("tool")], "", "session.toml")


def test_reddish_twins_of_samples_are_alike():
    samples = BallColor.from_samples(np.array([[30, 30, 190], [32, 34, 200], [35, 36, 210]]))
    balls = list(body("base").balls)
    balls[2] = Ball("red", samples, balls[2].center_mm, 15.0)
    with pytest.raises(SessionError, match="cannot be distinguished"):
        check_bodies([body("tool"), Body("base", tuple(balls))], "", "session.toml")


@pytest.mark.parametrize(
    ("names", "reference", "said"),
    [
        (("a", "a"), "", "two bodies are called 'a'"),
        (("a", "b/c"), "", "cannot name a body"),
        (("a", "b"), "c", "the reference 'c' must be one of several bodies; there is a, b"),
        (("a",), "a", "must be one of several"),
        ("abcdefg", "", "at most 6"),
    ],
)
def test_names_that_cannot_be(names, reference, said):
    bodies = [body(name, shifted(20.0 * k)) for k, name in enumerate(names)]
    with pytest.raises(SessionError, match=f"^session.toml: .*{re.escape(said)}"):
        check_bodies(bodies, reference, "session.toml")


def test_bodies_are_read_back_as_written(tmp_path):
    bodies = [body("tool"), body("base", shifted(12.0), red="blue")]
    write_bodies(tmp_path / "bodies.toml", bodies)
    again = read_bodies(tmp_path / "bodies.toml")
    assert [one.name for one in again] == ["tool", "base"]
    for one, other in zip(bodies, again, strict=True):
        np.testing.assert_array_equal(one.centers, other.centers)
        assert [b.color for b in one.balls] == [b.color for b in other.balls]


def test_a_truth_of_several_bodies_is_read_by_name(tmp_path):
    path = tmp_path / "truth.csv"
    rows = [f"{t},{name},{x},0,0,1,0,0,0" for t in (0, 1) for name, x in (("a", t), ("b", 10))]
    path.write_text("\n".join(["time_s,body,x_mm,y_mm,z_mm,qw,qx,qy,qz", *rows]) + "\n")
    assert read_trajectory(path, body="b").at(0.5).translation[0] == 10
    assert read_trajectory(path, body="a").at(0.5).translation[0] == 0.5
    with pytest.raises(MeasureError, match="holds the rigid bodies a, b: name one"):
        read_trajectory(path)
    with pytest.raises(MeasureError, match="none of them is called 'c'"):
        read_trajectory(path, body="c")
