"""What is told of pictures without decoding them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure_studio.capture.sources import Shot, size_wh

SIZE = (64, 48)


@pytest.mark.parametrize("progressive", [0, 1])
def test_the_size_of_a_jpeg_is_told(progressive):
    pixels = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    how = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    data = cv2.imencode(".jpg", pixels, how)[1].tobytes()
    filled = data[:2] + b"\xff\xff" + data[2:]
    alone = data[:2] + b"\xff\x01" + data[2:]
    for one in (data, filled, alone):
        assert size_wh(Shot(0.0, None, one)) == SIZE
    assert size_wh(Shot(0.0, None, None, pixels)) == SIZE


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xd8", b"\xff\xd8 no marker here", b"\xff\xd8\xff\xda" + bytes(20)]
)
def test_what_tells_no_size_has_none(data):
    assert size_wh(Shot(0.0, None, data)) is None


def test_a_jpeg_of_broken_lengths_ends():
    assert size_wh(Shot(0.0, None, b"\xff\xd8" + b"\xff\xe0\x00\x00" * 20)) is None
