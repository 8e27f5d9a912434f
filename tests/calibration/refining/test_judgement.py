from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.calibration import judge_refinement, refine_rig
from measure.calibration.refining.procedure import (
    Halves,
    RefineVerdict,
    compare_halves,
    refuse_misfit,
)
from measure.errors import CalibrationError
from tests.calibration.refining.cases import BODY, PRIOR, Case, case

JOINT = np.diag(np.tile(PRIOR**2, 4))


def judged(given: Case, joint: np.ndarray | None) -> RefineVerdict:
    halves = compare_halves(given.start, BODY, given.recording, None, joint)
    found = refine_rig(given.start, BODY, given.recording, None, joint, halves.variance_factor)
    refuse_misfit(found, BODY)
    return judge_refinement(given.start, BODY, given.recording, found, halves)


def test_a_good_refinement_has_nothing_against_it() -> None:
    verdict = judged(case(1), JOINT)
    assert verdict.notes == ()
    assert 0.5 < verdict.surprise < 1.5
    assert verdict.camera_sd_mm[1] < 0.8 * verdict.camera_sd_mm[0]
    assert verdict.held_out_px[1] < 0.5 * verdict.held_out_px[0]


def test_next_to_no_gain_is_said() -> None:
    slip = PRIOR / 80
    verdict = judged(case(1, frames=30, slip=slip), np.diag(np.tile(slip**2, 4)))
    assert any(note.startswith("this recording adds little") for note in verdict.notes)


def moved(given: Case, degrees: float) -> Case:
    """Camera 2 turned about its own vertical since it was calibrated."""
    turn = np.deg2rad([0, 0, 0, 0, 0, degrees])
    start = list(given.start)
    start[2] = replace(start[2], world_from_camera=start[2].world_from_camera.perturb(turn))
    return replace(given, start=tuple(start))


def test_a_camera_moved_after_calibration_is_refused() -> None:
    slip = PRIOR / 20
    given = moved(case(2, frames=40, slip=slip), 0.5)
    with pytest.raises(CalibrationError, match=r"cam2.*calibrate again"):
        judged(given, np.diag(np.tile(slip**2, 4)))


def test_a_change_beyond_what_is_stated_is_said_or_refused() -> None:
    given = moved(case(3, frames=40), 0.4)
    try:
        notes = judged(given, JOINT).notes
    except CalibrationError as refusal:
        notes = (str(refusal),)
    assert any("contradicts the first calibration" in note and "cam2" in note for note in notes)


def test_frame_sets_that_fit_worse_are_refused() -> None:
    given = case(4, frames=30)
    found = refine_rig(given.start, BODY, given.recording, None, JOINT)
    with pytest.raises(CalibrationError, match="fit worse"):
        judge_refinement(given.start, BODY, given.recording, found, Halves(1.0, (0.2, 0.3)))


def test_errors_that_drift_make_cautious() -> None:
    """What neither noise nor a constant explains shows in the halves, and only there."""
    steady, drifting = (
        np.mean([compare_halves(g.start, BODY, g.recording).variance_factor for g in given])
        for given in ([case(s, drift_px=d) for s in range(3)] for d in (0.0, 0.3))
    )
    assert steady < 1.5
    assert drifting > 2


def test_too_few_frame_sets_to_halve_are_said() -> None:
    verdict = judged(case(6, frames=15), JOINT)
    assert any("too few to hold some out" in note for note in verdict.notes)
    assert np.isnan(verdict.held_out_px[0])
