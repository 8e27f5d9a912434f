"""Pictures of several cameras decode side by side, and each of them once."""

import threading

import numpy as np
import pytest

from measure.model import Image

BLACK = np.zeros((2, 3, 3), np.uint8)


def _in_threads(images: list[Image]) -> list[object]:
    """What reading the pixels gave or raised, each in a thread of its own."""
    out: list[object] = []

    def read(image: Image) -> None:
        try:
            out.append(image.pixels)
        except (ValueError, threading.BrokenBarrierError) as problem:
            out.append(problem)

    threads = [threading.Thread(target=read, args=(image,)) for image in images]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return out


def test_pictures_of_two_cameras_decode_at_the_same_time():
    both_decode = threading.Barrier(2, timeout=10)

    def decode():
        both_decode.wait()
        return BLACK

    seen = _in_threads([Image("left", 0, 0.0, decode), Image("right", 0, 0.0, decode)])
    assert [type(one) for one in seen] == [np.ndarray, np.ndarray]


def test_a_picture_asked_for_by_two_threads_is_decoded_once():
    calls, asked = [], threading.Event()

    def decode():
        calls.append(1)
        asked.wait(0.2)
        return BLACK

    image = Image("left", 0, 0.0, decode)
    one, other = _in_threads([image, image])
    assert one is other is BLACK
    assert len(calls) == 1


def test_a_picture_that_cannot_be_decoded_says_so_every_time():
    def decode():
        raise ValueError("torn")

    image = Image("left", 0, 0.0, decode)
    for _ in range(2):
        with pytest.raises(ValueError, match="torn"):
            _ = image.pixels


@pytest.mark.parametrize(("encoded", "times"), [(b"a JPEG", 2), (None, 1)])
def test_released_pixels_are_decoded_again_where_they_can_be(encoded, times):
    calls = []

    def decode():
        calls.append(1)
        return BLACK

    image = Image("left", 0, 0.0, decode, encoded)
    for _ in range(2):
        assert image.pixels is BLACK
        image.release()
    assert len(calls) == times
