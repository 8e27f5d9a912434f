"""`measure target --run`: a body whose balls hide each other less."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.model import Body
from measure.session import read_body
from tests.results.conftest import CAMERAS, PERIOD_S, measurement, true_pose, written

TARGETS = Path(__file__).parents[2] / "calibration_targets"
FRAMES = 60


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return written(tmp_path / "run", map(measurement, range(FRAMES))).path


def hidden(body: Body) -> float:
    """Share of the run's views in which outlines overlap, and the ball is the further one."""
    found = []
    for pose in (true_pose(k * PERIOD_S) for k in range(FRAMES)):
        for camera in CAMERAS:
            away = pose.apply(body.centers) - camera.center
            far = np.linalg.norm(away, axis=1)
            apart = np.arccos(np.clip((away / far[:, None]) @ (away / far[:, None]).T, -1, 1))
            wide = np.arcsin(body.radii / far)
            before = (apart < wide + wide[:, None]) & (far < far[:, None])
            found.append(before.any(axis=1))
    return float(np.mean(found))


def test_arms_become_as_long_as_the_views_of_a_run_ask(run, tmp_path, capsys):
    short, drawn = TARGETS / "raven_three_ball.toml", tmp_path / "longer.svg"
    assert main(["target", str(short), "--run", str(run), "-o", str(drawn)]) == 0
    told, body = capsys.readouterr().out, read_body(tmp_path / "longer.toml")
    times = body.centers[0, 0] / 38.0
    assert f"with arms {times:g} times as long it would be {hidden(body):.0%}" in told
    np.testing.assert_allclose(body.centers, times * read_body(short).centers, atol=0.06)
    assert hidden(read_body(short)) > 0.15 > hidden(body)
    assert f"in {hidden(read_body(short)):.0%} of views" in told
    assert drawn.read_text().count("<circle") == 3
    again = ["target", str(tmp_path / "longer.toml"), "--run", str(run)]
    assert main([*again, "-o", str(tmp_path / "same.svg")]) == 0
    assert "its arms are long enough" in capsys.readouterr().out
    np.testing.assert_array_equal(read_body(tmp_path / "same.toml").centers, body.centers)


def test_what_no_arms_can_be_drawn_for_is_refused(run, tmp_path, capsys):
    out = ["-o", str(tmp_path / "sheet.pdf")]
    assert main(["target", "charuco_8x5_27", "--run", str(run), *out]) == 2
    assert "is no body: --run makes a body's arms longer" in capsys.readouterr().err
    lost = written(tmp_path / "lost", (measurement(k, lost=True) for k in range(5))).path
    assert main(["target", "raven_three_ball", "--run", str(lost), *out]) == 2
    assert "no pose in it says where the cameras see the body" in capsys.readouterr().err
    assert not [*tmp_path.glob("sheet*")]
