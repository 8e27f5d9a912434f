"""Whether the body that is tracked may be another: raised by a search, settled by looking again.

A search that finds balls of a second body, or the body further away than it can have moved, leaves
a doubt. Tracking in windows never sees what else there is, so whole images are searched beside it
now and then; the doubt ends when they show the body alone.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.geometry import chi_square_quantile
from measure.measuring.tracking.predictive.motion_filter import MotionState

_MOTION_CONFIDENCE = 0.9999
_REVIEW_EVERY_S = 0.5
_REVIEWS_ALONE = 3  # Reviews in a row that must show no other body: one may be hidden for a moment


class IdentityDoubt:
    """The flags of a search that hold until later images contradict them."""

    def __init__(self) -> None:
        self._second_body: tuple[str, ...] = ()
        self._restart: tuple[MotionState | None, MotionState] | None = None
        self._reviewed_s: float | None = None
        self._alone = 0
        self._raised = False

    def begin(
        self, second_body: tuple[str, ...], lost: MotionState | None, found: MotionState
    ) -> None:
        """A search has found the body.

        Args:
            second_body: flags of another body beside it.
            lost: the motion when it was last seen; None if it never was.
        """
        self._second_body, self._restart = second_body, (lost, found)
        self._reviewed_s, self._alone, self._raised = found.time_s, 0, bool(second_body)

    def flags(
        self, state: MotionState | None, acceleration: Floats, observed: Floats
    ) -> tuple[str, ...]:
        """The doubts that hold.

        Args:
            acceleration: (6,) standard deviations by the settings.
            observed: (6,) the same by what was observed since, where it is known.
        """
        moved: tuple[str, ...] = ()
        if self._restart is not None:
            known = state is not None and state.accelerations_known
            moved = _implausible_motion(*self._restart, observed if known else acceleration)
            if not moved:
                self._restart = None
        self._raised = bool(self._second_body or moved)
        return self._second_body + moved

    def due(self, time_s: float) -> bool:
        """Whether a doubt holds and whole images were not searched for some time."""
        if not self._raised or self._reviewed_s is None:
            return False
        return time_s - self._reviewed_s >= _REVIEW_EVERY_S

    def reviewed(self, second_body: tuple[str, ...], time_s: float) -> None:
        """Take what whole images show: flags of another body, or none."""
        self._reviewed_s = time_s
        if second_body:
            self._second_body, self._alone = second_body, 0
            return
        self._alone += 1
        if self._alone >= _REVIEWS_ALONE:
            self._second_body, self._restart, self._raised = (), None, False


def _implausible_motion(
    lost: MotionState | None, found: MotionState, acceleration_sd: Floats
) -> tuple[str, ...]:
    """A flag if a body was found further from where it was lost than it can have moved.

    Args:
        lost: the motion when the body was last seen; None if it never was.
        acceleration_sd: (6,) as in `MotionState.at`.
    """
    if lost is None:
        return ()
    expected = lost.at(found.time_s, acceleration_sd)
    step = found.world_from_body.difference(expected.world_from_body)
    noise = expected.covariance[:6, :6] + found.covariance[:6, :6]
    if step @ np.linalg.solve(noise, step) < chi_square_quantile(_MOTION_CONFIDENCE, 6):
        return ()
    moved = np.linalg.norm(found.world_from_body.translation - lost.world_from_body.translation)
    text = f"found {moved:.0f} mm from where it was {found.time_s - lost.time_s:.2f} s before"
    return (f"{text}, further than it can have moved: this may be another body",)
