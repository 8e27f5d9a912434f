"""Settings of the tracking "frame-update"."""

from __future__ import annotations

from measure.host.settings import Settings, setting


class FrameUpdateSettings(Settings):
    """How far a circle may move and vary, and when the system restarts."""

    motion_mm_s: float = setting(
        100.0, "motion threshold: fastest motion of a ball across the view", unit="mm/s", gt=0
    )
    motion_base_px: float = setting(
        4.0, "motion threshold: what a resting circle may move between frames", unit="px", gt=0
    )
    color_percent: float = setting(
        25.0, "colour match below which a circle is suspended", unit="%", ge=0, le=100
    )
    good_frames: int = setting(
        5, "a suspended circle recovers after more good frames in a row than this", ge=0
    )
    consistency_mm: float = setting(
        3.0, "largest distance of a ray from the 3-D centre of its ball", unit="mm", gt=0
    )
    radius_percent: float = setting(
        10.0, "r_min and r_max about the radius of earlier frames", unit="%", gt=0, lt=90
    )
    min_distance_radii: float = setting(
        1.0, "d_min, least distance of two circles of one colour, in radii", gt=0
    )
    skip_frames: int = setting(
        3, "frame sets skipped before a restart when too few circles are effective", ge=0
    )
    tolerance_step: float = setting(1.5, "factor on all tolerable ranges at each restart", ge=1)
    tolerance_max: float = setting(3.0, "largest factor on the tolerable ranges", ge=1)
    tolerance_decay: float = setting(
        0.5, "share of the raised tolerance that is left after a good frame", ge=0, lt=1
    )
    search_tolerance: float = setting(
        2.0, "tolerance from which a restart searches whole frames", ge=1
    )
    flag_residual_mm: float = setting(
        1.0, "RMS misfit of the balls to the body from which a pose is flagged", unit="mm", gt=0
    )
    flag_rays_mm: float = setting(
        1.0,
        "RMS distance of all rays from their balls from which a pose is flagged",
        unit="mm",
        gt=0,
    )
    max_residual_mm: float = setting(
        3.0, "RMS misfit of the balls to the body from which a pose is refused", unit="mm", gt=0
    )
