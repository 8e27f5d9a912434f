"""Work shared among cores: the same results whoever did it."""

from __future__ import annotations

import threading
import time

import pytest

from measure.measuring.thread_pool import CameraPool

NAMES = ["c", "a", "d", "b"]


@pytest.mark.parametrize("cores", [1, 2, 8])
def test_every_name_once_and_in_order(cores):
    done = []
    with CameraPool(4, cores) as pool:
        for names in (NAMES, NAMES[:1], []):
            done.clear()
            found = pool.map(lambda name: done.append(name) or name.upper(), names)
            assert list(found.items()) == [(name, name.upper()) for name in names]
            assert sorted(done) == sorted(names)


@pytest.mark.parametrize(("cores", "threads"), [(1, 1), (2, 2), (8, 4)])
def test_as_many_threads_as_cores_or_cameras(cores, threads):
    with CameraPool(4, cores) as pool:
        found = pool.map(lambda _: (time.sleep(0.05), threading.get_ident())[1], NAMES)
    assert len(set(found.values())) == threads
    assert threading.get_ident() in found.values()


@pytest.mark.parametrize("cores", [1, 2])
@pytest.mark.parametrize("bad", NAMES)
def test_a_camera_that_fails_is_not_passed_over(cores, bad):
    def work(name):
        time.sleep(0.01)
        if name == bad:
            raise ValueError(name)

    with CameraPool(4, cores) as pool, pytest.raises(ValueError, match=bad):
        pool.map(work, NAMES)
