"""Settings of association."""

from __future__ import annotations

from measure.host.settings import Settings, setting


class AssociationSettings(Settings):
    """When candidates of several cameras count as one body."""

    sigmas: float = setting(
        3.5, "Candidates agree with a pose within this many standard deviations.", gt=0
    )
    extra_px: float = setting(
        1.5, "Added to every candidate's standard deviation in quadrature.", unit="px", ge=0
    )
    range_ratio: float = setting(
        1.4, "How far an outline's size may mislead about the distance, as a factor.", gt=1
    )
    min_views: int = setting(5, "Least number of ball sightings, over all cameras.", ge=4)
    min_share: float = setting(
        0.4, "Least share of the balls in view, over all cameras, that must be found.", ge=0, le=1
    )
    rival_score: float = setting(
        0.5,
        "Another pose whose score is this share of the best one's makes the answer ambiguous.",
        gt=0,
        le=1,
    )
    twin_score: float = setting(
        0.9,
        "The same, for a pose that rests mostly on the same candidates: a mirror image, say.",
        gt=0,
        le=1,
    )
    rival_mm: float = setting(
        8.0, "Poses count as different if some ball is this far apart.", unit="mm", gt=0
    )
    max_points: int = setting(40, "Most possible centres kept per ball.", ge=3)
