"""How much of predictions is believed: as much as they foresee of what can be seen of them."""

from __future__ import annotations

import pytest

from measure_plugins._outline.appearance.model import BELIEVED
from measure_plugins._outline.self_calibration.trust import Agreement, agreement_on, believed_share
from tests.plugins.outline.lessons import learner_of, settled
from tests.simulated.catalogue import relit_scenes

GREY, WEBCAM = "plain-grey 14", "still 12"


@pytest.fixture(scope="module")
def shares():
    """What two cameras each believe by themselves, and having conferred."""
    return {name: _shares(relit_scenes()[name]) for name in (GREY, WEBCAM)}


def _shares(scene):
    learners = [learner_of(scene.camera(name)) for name in ("cam0", "cam1")]
    alone = [settled(learner, scene, f"cam{i}") for i, learner in enumerate(learners)]
    heard = [learner.lesson for learner in learners]
    told = [x.told(now, heard, bent=False) for x, now in zip(learners, alone, strict=True)]
    return [now.believed for now in alone], [now.believed for now in told]


def test_plain_pictures_are_believed_more_than_a_webcam_s(shares):
    assert min(shares[GREY][1]) > 0.93 > 0.86 > max(shares[WEBCAM][1])


@pytest.mark.parametrize("scene", [GREY, WEBCAM])
def test_cameras_that_confer_believe_the_same(shares, scene):
    alone, told = shares[scene]
    assert told[0] == pytest.approx(told[1])
    assert told[0] not in alone


def test_what_is_usual_is_believed_where_nothing_is_seen():
    assert believed_share([]) == pytest.approx(BELIEVED)
    assert believed_share([Agreement(0.0, 0.0)]) == pytest.approx(BELIEVED)
    nothing = agreement_on([], None)
    assert nothing == Agreement(0.0, 0.0)


def test_the_more_is_seen_of_what_is_foreseen_the_more_is_believed():
    shares = [believed_share([Agreement(slope * 1e4, 1e4)]) for slope in (-0.5, 0.0, 0.5, 1.0, 2.0)]
    assert shares == sorted(shares)
    assert shares[0] == pytest.approx(0.65)
    assert shares[-1] == pytest.approx(1.05)


def test_cameras_count_by_how_much_they_foresee():
    sure, unsure = Agreement(900.0, 1000.0), Agreement(0.0, 10.0)
    assert believed_share([sure, unsure]) == pytest.approx(believed_share([sure]), abs=0.01)
