"""Files as spreadsheets, other editors and other cameras leave them, in any folder."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.session import open_session
from tests.session.conftest import Recording, write_recording


def _seen(recording: Recording) -> list[tuple[float, float]]:
    """Time and grey level of every picture of the first camera."""
    with open_session(recording.path) as session:
        images = [frame_set.images["cam0"] for frame_set in session.frame_sets()]
        return [(image.time_s, float(np.median(image.pixels))) for image in images]


def test_byte_order_marks_and_carriage_returns_change_nothing(tmp_path):
    recording = write_recording(tmp_path / "rec")
    before = _seen(recording)
    for file in ("session.toml", "body.toml", "calibration.toml", "cam0.csv", "cam1.csv"):
        text = (recording.path / file).read_text()
        (recording.path / file).write_bytes(text.replace("\n", "\r\n").encode("utf-8-sig"))
    assert _seen(recording) == before
    assert len(before) == 6


def test_a_folder_of_any_name_and_a_link_to_it(tmp_path):
    recording = write_recording(tmp_path / "Ünï cödé 球 [1]")
    link = tmp_path / "link"
    link.symlink_to(recording.path)
    assert len(_seen(recording)) == 6
    assert _seen(Recording(link)) == _seen(recording)


@pytest.mark.parametrize("kind", ["16 bits", "transparency"])
def test_pictures_of_other_kinds_have_the_same_values(tmp_path, kind):
    recording = write_recording(tmp_path / "rec")
    before = _seen(recording)
    for path in recording.path.glob("cam*/*.jpg"):
        pixels = cv2.imread(str(path))
        opaque = cv2.cvtColor(pixels, cv2.COLOR_BGR2BGRA)
        other = pixels.astype(np.uint16) * 257 if kind == "16 bits" else opaque
        assert cv2.imwrite(str(path.with_suffix(".png")), other)
        path.unlink()
    session = recording.path / "session.toml"
    session.write_text(session.read_text().replace(".jpg", ".png"))
    assert _seen(recording) == before
