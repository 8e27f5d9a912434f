"""What a live measurement says of its rig while it goes on."""

from __future__ import annotations

import time
from concurrent.futures import Executor, Future
from pathlib import Path

import pytest

from measure import api
from measure.checking.causes import Cause, Word
from measure.checking.watching import EVERY_S, RigWatch
from measure.host import Registry
from measure.session import Calibration, open_session, write_calibration
from tests.api.test_wrong_rigs import turned

pytestmark = pytest.mark.slow
LOOK_S = 0.12


class AtOnce(Executor):
    """Looks are done where they are asked for."""

    def submit(self, fn, /, *args, **kwargs):
        done = Future()
        done.set_result(fn(*args, **kwargs))
        return done


def watched(folder: Path, calibration: Path | None = None) -> tuple[list[tuple[Cause, ...]], float]:
    """What is named after each frame set of a recording of 0.4 s; and the seconds of a look."""
    with open_session(folder, calibration) as session:
        stages = api.measure_session(session, api.load_profile(), Registry.discover())
        measured = [one for _, one in stages]
        watch = RigWatch(session.body, session.cameras, AtOnce(), every_s=LOOK_S)
        said, costs_s = [], []
        for one in measured:
            began_s = time.process_time()
            watch.add(one)
            costs_s.append(time.process_time() - began_s)
            said.append(watch.causes)
    return said, sorted(costs_s)[-2]  # the first look loads what it needs


def test_a_camera_that_was_turned_is_named_by_the_second_look_at_little_cost(still, tmp_path):
    with open_session(still) as session:
        cameras = turned(session.cameras, 0.3)
    write_calibration(tmp_path / "c.toml", Calibration(tuple(cameras)))
    said, cost_s = watched(still, tmp_path / "c.toml")
    assert said[6:8] == [(), ()]  # one look may err
    assert [(c.cause, c.of) for c in said[-1][:1]] == [(Word.MOVED, cameras[1].name)]
    assert cost_s < 0.05 * EVERY_S


def test_a_right_rig_is_not_blamed(still):
    said, _ = watched(still)
    assert not any(said)
