"""A body that is waved: what it is told to do, when that is enough, and how good that is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.api import BodyWave
from measure.calibration.by_body.adjustment import adjusted, recording_of_links
from measure.calibration.by_body.linking import Instant, link
from measure.geometry import align_points
from tests.calibration.by_body.test_linking import lenses, motion, recorded, seen_by

COUNT = 30


def wave_of(rig, paper_body, are_known=True, goal_mm=0.5):
    sizes = {camera.name: camera.intrinsics.size_wh for camera in rig}
    return BodyWave(paper_body, sizes, lenses(rig) if are_known else None, goal_mm)


def stamped(instants):
    """With the times at which the pictures were taken."""
    return [
        Instant(
            one.time_s,
            {
                n: [replace(d, time_s=one.time_s) for d in some]
                for n, some in one.detections.items()
            },
        )
        for one in instants
    ]


def wave_on(wave, instants):
    """Offer instants, as long as they are not enough."""
    for one in stamped(instants):
        wave.add(one.detections, one.time_s)
        if wave.wants_locating:
            wave.known = wave.located()
        if wave.state().enough:
            break
    return wave.state()


def test_it_stops_asking_when_the_cameras_are_known_well_enough(rig, paper_body):
    wave = wave_of(rig, paper_body)
    assert wave.state().advice[:2] == (
        "cam0: show the body to this camera",
        "cam1: show the body to this camera",
    )
    state = wave_on(wave, recorded(rig, paper_body, count=COUNT))
    assert state.enough
    assert state.advice == ()
    linked = link(lenses(rig), paper_body, wave.kept)
    found = adjusted(linked.cameras, paper_body, recording_of_links(linked, paper_body)).cameras
    centers, true = (np.stack([c.center for c in some]) for some in (found, rig))
    off = align_points(true, centers).apply(centers) - true
    assert np.linalg.norm(off, axis=1).max() < 2.0  # Cameras stand 450 mm away


def test_cameras_that_never_see_it_at_once_are_named(rig, paper_body):
    """Two see it by turns with the other two."""
    instants = [
        Instant(one.time_s, {c.name: one.detections[c.name] for c in rig[2 * (k % 2) :][:2]})
        for k, one in enumerate(recorded(rig, paper_body, count=12))
    ]
    wave = wave_of(rig, paper_body)
    for one in instants:
        wave.add(one.detections, one.time_s)
    told = [line for line in wave.state().advice if "both at once" in line]
    assert told
    assert {"cam0", "cam1"} & {*told[0].split()}
    assert {"cam2", "cam3"} & {*told[0].partition(":")[0].split()}
    assert not wave.state().enough
    before = wave.state().advice
    wave.known = wave.located()  # That it cannot be done yet says less than what to do
    assert wave.state().advice == before


def test_a_body_at_rest_adds_nothing(rig, paper_body):
    wave, (first, *_) = wave_of(rig, paper_body), recorded(rig, paper_body)
    assert wave.add(first.detections, 0.0)
    assert not wave.add(first.detections, 1.0)
    assert not wave.add({}, 2.0)


@pytest.mark.parametrize("are_known", [True, False])
def test_what_the_motion_lacks_for_unknown_lenses_is_said(rig, paper_body, are_known):
    """A body that turns in one place tells no focal length; known lenses do not need that."""
    rng, wave = np.random.default_rng(0), wave_of(rig[:2], paper_body, are_known, goal_mm=1e-6)
    for k, pose in enumerate(motion(12)):
        held = replace(pose, translation=0.2 * pose.translation)
        seen = {c.name: seen_by(c, paper_body, held, paper_body.names, rng) for c in rig[:2]}
        wave.kept += stamped([Instant(k / 10, seen)])
    wave.known = wave.located()
    lacks = [line for line in wave.state().advice if line.startswith("wave the body nearer to")]
    assert not wave.state().enough
    assert bool(lacks) != are_known
