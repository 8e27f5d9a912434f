"""In which colour the state of a ball in a camera is drawn: the same in the viewer and on pages."""

from __future__ import annotations

from measure.model.observations import Reason

EFFECTIVE = (80, 220, 120)
REASONS = {
    Reason.NONE: EFFECTIVE,
    Reason.JUMPED: (255, 140, 0),
    Reason.COLOR: (220, 80, 220),
    Reason.NOT_FOUND: (165, 125, 60),
    Reason.INCONSISTENT: (255, 60, 60),
    Reason.RECOVERING: (90, 190, 255),
    Reason.NO_IMAGE: (110, 110, 110),
    Reason.MOVED: (150, 70, 200),
}
UNKNOWN = (150, 150, 150)
AXES_MM = 40.0  # Length of a body's axes, as they are drawn


def css(reason: str) -> str:
    """The colour of a reason against a view, or of "effective", for pages."""
    colors = {"effective": EFFECTIVE, **{str(one): color for one, color in REASONS.items()}}
    return "#{:02x}{:02x}{:02x}".format(*colors.get(reason, UNKNOWN))
