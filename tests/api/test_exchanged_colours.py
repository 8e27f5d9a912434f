"""Colours that are each other with red and blue exchanged: the pictures, or the body file?"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure import api
from measure.host import Registry
from measure.session import read_body, write_body
from tests.simulated.catalogue import scene_catalogue
from tests.simulated.sessions import part_of, rendered

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def four() -> Path:
    """A body of blue, orange, purple and white balls."""
    return rendered(scene_catalogue()["four-balls"], np.arange(8) / 30)


@pytest.fixture
def session(four: Path, tmp_path: Path) -> Path:
    """Its first pictures."""
    return part_of(four, range(4), tmp_path / "four")


def exchange_channels(folder: Path, cameras: str) -> None:
    for path in folder.glob(f"{cameras}/*.jpg"):
        cv2.imwrite(str(path), cv2.imread(str(path))[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])


def exchange_places(folder: Path, one: str, other: str) -> None:
    body = read_body(folder / "body.toml")
    to = {one: other, other: one}
    balls = [
        replace(b, center_mm=body.centers[body.index(to.get(b.name, b.name))]) for b in body.balls
    ]
    write_body(folder / "body.toml", replace(body, balls=tuple(balls)))


@pytest.mark.parametrize(("cameras", "of"), [("cam*", "all"), ("cam3", "cam3")])
def test_pictures_are_told_from_a_body_file(session: Path, cameras: str, of: str) -> None:
    exchange_channels(session, cameras)
    *rows, _ = (session / "cam3.csv").read_text().splitlines()  # a picture is lost
    (session / "cam3.csv").write_text("\n".join(rows) + "\n")
    sorted((session / "cam3").iterdir())[-1].unlink()
    found = api.check(session, Registry.discover(), clock_samples=0)
    assert [(str(c.cause), c.of) for c in found.causes] == [("exchanged-channels", of)]


@pytest.mark.parametrize("two", [("blue", "orange"), ("purple", "white")])
def test_a_body_file_is_told_from_pictures_and_from_a_ball_out_of_place(
    session: Path, two: tuple[str, str]
) -> None:
    exchange_places(session, *two)
    first, *_ = api.check(session, Registry.discover(), clock_samples=0).causes
    assert first.cause == "exchanged-balls"
    assert set(first.of.split(", ")) == set(two)


@pytest.mark.parametrize("two", [("blue", "orange"), ("purple", "white"), ("blue", "purple")])
def test_a_run_blames_no_ball_that_sits_where_it_should(
    four: Path, tmp_path: Path, two: tuple[str, str]
) -> None:
    """It looks where the body file puts balls, and hardly sees the two there."""
    folder = Path(shutil.copytree(four, tmp_path / "four"))
    exchange_places(folder, *two)
    without = api.RunOptions(recording=False)
    summary = api.run(folder, tmp_path / "run", api.load_profile(), Registry.discover(), without)
    assert summary.ok == 0
    assert not [f.text for f in summary.findings if f.code == "ball-place" and f.subject not in two]
