"""JPEGs that decode although a part of them is missing or was overwritten."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.session import decode_picture
from measure.session.damage import is_damaged

ROUGH = cv2.blur(np.random.default_rng(5).integers(0, 255, (480, 640, 3), np.uint8), (5, 5))

RANDOM = np.random.default_rng(6).bytes(4096)
BALLS = cv2.GaussianBlur(ROUGH, (0, 0), 2)
"""As smooth as pictures are."""

KINDS = {
    "plain": (),
    "4:4:4": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    "4:2:2": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
    "4:1:1": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_411),
    "progressive": (cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "own tables": (cv2.IMWRITE_JPEG_OPTIMIZE, 1),
    "restarts": (cv2.IMWRITE_JPEG_RST_INTERVAL, 10),
    "rough": (cv2.IMWRITE_JPEG_QUALITY, 5),
}


def jpeg(kind: str, pixels=ROUGH) -> bytes:
    return cv2.imencode(".jpg", pixels, KINDS[kind])[1].tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_healthy_pictures_are_not_accused(kind: str) -> None:
    small = jpeg("plain", ROUGH[:90, :120])
    for pixels in (ROUGH, ROUGH[..., 0], ROUGH[:471, :633], ROUGH[:8, :8]):
        data = jpeg(kind, pixels)
        assert not is_damaged(data)
        assert not is_damaged(data + b"a maker's note"), "some cameras write on after the end"
        film = data + RANDOM + b"\xff\xda\x00" + RANDOM
        assert not is_damaged(film), "phones a film"
        assert decode_picture(film, "").shape[:2] == pixels.shape[:2]
        thumbnail = b"\xff\xe1" + (2 + len(small)).to_bytes(2, "big") + small
        assert not is_damaged(data[:2] + thumbnail + data[2:])


DAMAGES = {
    "zeros": lambda data, at: data[:at] + bytes(4096) + data[at + 4096 :],
    "ones": lambda data, at: data[:at] + b"\xff" * 4096 + data[at + 4096 :],
    "other data": lambda data, at: data[:at] + RANDOM + data[at + 4096 :],
    "nothing": lambda data, at: data[:at] + data[at + 4096 :],
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("place", [0.2, 0.4, 0.6, 0.8])
def test_a_block_that_another_took_the_place_of_is_seen(damage: str, place: float) -> None:
    """As a bad sector or a torn copy leaves it; nothing else tells."""
    data = jpeg("plain", BALLS)
    bad = DAMAGES[damage](data, int(place * len(data)))
    assert decode_picture(bad, "").shape == BALLS.shape
    assert is_damaged(bad)


@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_is_seen(kind: str) -> None:
    assert is_damaged(jpeg(kind)[:-30])


def test_what_the_judge_does_not_know_is_not_judged() -> None:
    assert not is_damaged(b"\xff\xd8 no picture at all \xff\xd9")


def test_real_pictures_are_not_accused(renders: Path) -> None:
    files = sorted(renders.rglob("*.jpg"))[::2]
    assert files
    assert not [file for file in files if is_damaged(file.read_bytes())]
