"""Which cameras are away, by a clock of our own: told at once, once, and when they are back."""

from __future__ import annotations

import pytest

from measure_studio.capture.cameras import OutageWatch

PERIOD_S = 1 / 15
EPOCH_S = 1.7e9


class Watched:
    """A watch on cameras `a` and `b`, and what it told, with the time of it."""

    def __init__(self):
        self.tick, self.told = 0, []
        self.watch = OutageWatch(["a", "b"], lambda: self.now)
        self.watch.begin(EPOCH_S)

    @property
    def now(self):
        return self.tick / 60

    def run(self, seconds, delivers="ab", exact=True):
        """Let cameras deliver for some time, and look twenty times a second."""
        for _ in range(round(60 * seconds)):
            self.tick += 1
            if self.tick % 4 == 0:
                for name in delivers:
                    self.watch.came(name, EPOCH_S + self.now, exact)
            if self.tick % 3 == 0:
                self.told += [(self.now, outage) for outage in self.watch.look()]

    def changes(self):
        return [(outage.camera, outage.lasts) for _, outage in self.told]


@pytest.fixture
def watched():
    out = Watched()
    out.run(3.0)
    assert out.told == []
    return out


def test_a_camera_that_stops_is_told_within_a_second_of_the_third_picture(watched):
    begun = watched.now
    watched.run(5.0, "b")
    ((when, outage),) = watched.told
    assert outage.camera == "a"
    assert when - (outage.since_s - EPOCH_S) - 3 * PERIOD_S < 0.6
    assert outage.since_s - EPOCH_S == pytest.approx(begun, abs=1e-6)
    assert watched.watch.away == ("a",)
    watched.run(2.0)
    assert watched.changes() == [("a", True), ("a", False)]
    over = watched.told[1][1]
    assert over.until_s - over.since_s == pytest.approx(5.0 + PERIOD_S, abs=1e-6)
    assert watched.watch.away == ()
    assert watched.watch.of("a") == (over,)
    assert watched.watch.of("b") == ()


def test_a_camera_that_stutters_has_one_outage(watched):
    for _ in range(6):
        watched.run(1.5, "b")
        watched.run(0.4)
    watched.run(3.0)
    assert watched.changes() == [("a", True), ("a", False)]


@pytest.mark.parametrize(("missing", "count"), [(2, 0), (5, 1)])
def test_pictures_that_are_missing_are_told_though_others_follow(watched, missing, count):
    """By the camera's own clock; one or two are no outage."""
    watched.run(missing * PERIOD_S, "b")
    watched.run(3.0)
    assert len(watched.watch.of("a")) == count
    assert watched.changes() == [("a", True), ("a", False)][: 2 * count]


def test_by_times_of_arrival_pictures_may_be_late(watched):
    watched.run(5 * PERIOD_S, "b")
    watched.run(3.0, exact=False)
    assert watched.told == []


def test_the_reason_is_the_last_that_is_known(watched):
    watched.run(1.0, "b")
    assert watched.told[0][1].reason == "no picture came"
    watched.watch.fail("a", "answers 404 Not Found")
    watched.run(1.0, "b")
    assert watched.watch.of("a")[0].reason == "answers 404 Not Found"
    watched.run(3.0)
    assert watched.told[1][1].sentence().startswith("a is back after 2.1 s (answers 404")
    watched.run(1.0, "b")
    assert watched.told[2][1].reason == "no picture came"


def test_pictures_that_cannot_be_decoded_are_missing(watched):
    for _ in range(20):
        watched.run(PERIOD_S)
        watched.watch.read("a", readable=False)
    assert watched.changes() == [("a", True)]
    assert watched.told[0][1].reason == "its pictures cannot be decoded"
    watched.watch.read("a", readable=True)
    watched.run(2.0)
    assert watched.changes() == [("a", True), ("a", False)]


def test_pictures_of_another_camera_are_missing_though_they_can_be_decoded(watched):
    for _ in range(20):
        watched.run(PERIOD_S)
        watched.watch.read("a", readable=True)
        watched.watch.compare("a", "b")
    assert watched.changes() == [("a", True)]
    assert watched.told[0][1].sentence() == "a is away: it shows the pictures of b"
    watched.watch.compare("a", "")
    watched.run(2.0)
    assert watched.changes() == [("a", True), ("a", False)]


def test_a_camera_that_never_delivers_is_away_from_the_beginning():
    watched = Watched()
    watched.run(4.0, "b")
    ((_, outage),) = watched.told
    assert outage.since_s == EPOCH_S


def test_a_file_that_is_over_is_not_away(watched):
    watched.watch.end("a")
    watched.run(5.0, "b")
    assert watched.told == []
