"""The examples in docs/files.md are files that open."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from measure.errors import SessionError
from measure.session import open_session, read_body, read_calibration
from tests.session.conftest import jpeg

DOCS = Path(__file__).parents[2] / "docs/files.md"


@pytest.fixture
def files(tmp_path: Path) -> Path:
    found = re.findall(r"<!-- file: (\S+) -->\n```toml\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert [name for name, _ in found] == ["session.toml", "body.toml", "calibration.toml"]
    for name, text in found:
        (tmp_path / name).write_text(text)
    return tmp_path


def test_body_and_calibration(files: Path) -> None:
    assert read_body(files / "body.toml").names == ("green", "yellow", "red")
    camera = read_calibration(files / "calibration.toml").camera("cam0")
    assert np.allclose(camera.project([[0.0, 0.0, 0.0]]), [[639.5, 359.5]])


def test_session(files: Path) -> None:
    """The example names everything a session can; two cameras with pictures make it whole."""
    text = (files / "session.toml").read_text()
    small = (files / "calibration.toml").read_text().replace("[1280, 720]", "[64, 48]")
    (files / "calibration.toml").write_text(
        small
        + small[: small.index("[provenance]")]
        .replace("cam0", "cam1")
        .replace("[0.0, 0.0, 500.0]", "[90.0, 0.0, 500.0]")
    )
    (files / "session.toml").write_text(
        text.replace('video = "cam1.mp4"', 'images = "cam1/*.jpg"\ntimestamps = "cam1.csv"')
    )
    (files / "robot.parquet").write_bytes(b"")
    (files / "truth.csv").write_text("")
    for name, offset in (("cam0", 0.0), ("cam1", 0.012)):
        (files / name).mkdir()
        rows = ["frame,time_s"]
        for k in range(3):
            (files / name / f"{k}.jpg").write_bytes(jpeg(20 * k))
            rows.append(f"{k},{k / 30 + offset}")
        (files / f"{name}.csv").write_text("\n".join(rows))
    with open_session(files) as session:
        assert session.name == "example"
        assert session.description == "free text"
        assert session.truth_path == files / "truth.csv"
        assert session.robot_log == files / "robot.parquet"
        assert [len(s.images) for s in session.frame_sets()] == [2, 2, 2]
        assert np.allclose(session.streams["cam1"].times_s, np.arange(3) / 30)
    (files / "robot.parquet").unlink()
    with pytest.raises(SessionError, match=r"robot\.parquet: no such file"):
        open_session(files)
