"""What is slow at the start is done before the first frame, and said if it takes long."""

from __future__ import annotations

import logging
import time

from measurements import BODY, CAMERAS

from measure.api import measuring
from measure.measuring import Pipeline, Stages


class _Part:
    def __init__(self):
        self.warm = 0

    def warm_up(self):
        self.warm += 1


def test_every_stage_is_warmed_up_once_and_cameras_share_it():
    parts = [_Part() for _ in range(5)]
    detectors = {"cam0": parts[0], "cam1": parts[1]}
    stages = Stages(detectors, *parts[2:], False, False, False)
    Pipeline(BODY, CAMERAS, stages).warm_up()
    assert [part.warm for part in parts] == [1, 0, 1, 1, 1]


def test_only_a_long_warm_up_is_explained(monkeypatch, caplog):
    monkeypatch.setattr(measuring, "PATIENCE_S", 0.05)
    with caplog.at_level(logging.WARNING):
        with measuring.a_word_if_it_takes_long():
            pass
        time.sleep(0.1)
        assert caplog.text == ""
        with measuring.a_word_if_it_takes_long():
            time.sleep(0.2)
    assert "compiling" in caplog.text
