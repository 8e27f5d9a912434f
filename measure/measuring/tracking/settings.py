"""Settings of predictive tracking."""

from __future__ import annotations

from measure.host import Settings, setting


class PredictiveConfig(Settings):
    """Settings of tracking in SE(3)."""

    acceleration_mm_s2: float = setting(
        1500.0, "Standard deviation of the body's acceleration.", unit="mm/s^2", gt=0
    )
    angular_acceleration_rad_s2: float = setting(
        15.0, "Standard deviation of its angular acceleration.", unit="rad/s^2", gt=0
    )
    speed_mm_s: float = setting(
        60.0, "Standard deviation of the speed of a body just found.", unit="mm/s", gt=0
    )
    angular_speed_rad_s: float = setting(
        0.7, "Standard deviation of its angular speed.", unit="rad/s", gt=0
    )
    confidence: float = setting(
        0.9999, "Share of correct detections that every gate lets pass.", gt=0.5, lt=1
    )
    systematic_px: float = setting(
        0.5,
        "Systematic error of a detection, added to its standard deviation in every gate.",
        unit="px",
        ge=0,
    )
    view_bias_px: float = setting(
        0.3,
        "Standard deviation of a ball-view's own bias, on top of its noise, where all "
        "ball-views together are tested against the pose.",
        unit="px",
        ge=0,
    )
    reach_sigmas: float = setting(3.5, "Standard deviations of the prediction to search.", gt=0)
    min_reach_px: float = setting(3.0, "Least reach of a search.", unit="px", gt=0)
    radius_slack: float = setting(0.15, "Relative error of an outline's radius.", gt=0, lt=1)
    recover_frames: int = setting(
        1, "Frames in which a suspended detection must be good before it counts again.", ge=0
    )
    lost_after: int = setting(
        3, "Frames without an accepted pose before whole frames are searched.", ge=1
    )
    max_gap_s: float = setting(0.5, "A longer pause than this ends the prediction.", unit="s", gt=0)
    min_color_match: float = setting(
        0.15, "Least share of a ball's inside that has its colour, where that is checked.", ge=0
    )
    max_rms_px: float = setting(
        2.5, "A pose with larger reprojection errors is flagged.", unit="px", gt=0
    )
    max_sd_mm: float = setting(
        2.0, "A pose with a larger standard deviation is flagged.", unit="mm", gt=0
    )
    distance_tolerance_mm: float = setting(
        1.0, "Error of a distance between two balls that is never flagged.", unit="mm", ge=0
    )
