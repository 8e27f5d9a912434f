"""A run in one sentence, and whether it may be relied on."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Floats
from measure.geometry.covariance import chi_square_quantile
from measure.model.doubts import counted
from measure.results import Run
from measure.results.statistics import consistency
from measure.results.tables import doubts_of

SUB_MM = 1.0  # A position known worse than this (95 %, mm) makes the verdict doubtful
_MIN_UNFLAGGED_SHARE = 0.5
"""Fewer unflagged poses than this share of the frame sets, and the run is bad."""
_MIN_INSIDE_95 = 0.8
"""With a smaller share of errors inside their 95 % regions the uncertainty is too small."""


def verdict(run: Run, errors: Floats | None) -> tuple[str, str]:
    """Tone ("good", "doubtful" or "bad") and sentence, by the errors (n, 6) against truth."""
    summary, unflagged = run.summary, run.unflagged
    if not run.has_pose.any():
        return "bad", f"No pose in {_sets(summary.frame_sets)}{_because(run, ~run.has_pose)}."
    if not unflagged.any():
        doubted = _sets(int(run.has_pose.sum()))
        return (
            "bad",
            f"No pose to rely on: all of {doubted} are flagged{_because(run, ~unflagged)}.",
        )
    # Median radius in mm that holds 95 % of a 3-D Gaussian, its longest axis taken all round
    longest = np.linalg.eigvalsh(run.covariances[unflagged[run.has_pose]][:, :3, :3])[:, -1]
    widest = float(np.median(np.sqrt(longest * chi_square_quantile(0.95, 3))))
    parts = [f"Position known to {_digits(widest)} mm (95 %) within this rig", _who_carries(run)]
    parts += _what_is_missing(run)
    tone, against = _against_truth(run, errors)
    tone = "doubtful" if summary.ok < summary.frame_sets or not run.finished else tone
    tone = "doubtful" if widest > SUB_MM or run.contradictions else tone
    tone = "bad" if unflagged.sum() < _MIN_UNFLAGGED_SHARE * summary.frame_sets else tone
    words = [", ".join(parts) + "." + against, *_not_counted(run)]
    words += [f"{one.level.title()}: {one.text}." for one in run.contradictions]
    return tone, " ".join(words)


def _who_carries(run: Run) -> str:
    used = [set(cameras) for cameras in run.poses["cameras"].to_pylist() if cameras]
    share = {c.name: np.mean([c.name in names for names in used]) for c in run.cameras}
    carrying = [name for name, part in share.items() if part > _MIN_UNFLAGGED_SHARE]
    idle = [name for name, part in share.items() if not part]
    without = f" ({', '.join(idle)} never)" if idle else ""
    return f"{len(carrying)} of {len(share)} cameras carry it{without}"


def _what_is_missing(run: Run) -> list[str]:
    total, flagged = run.summary.frame_sets, run.has_pose & ~run.unflagged
    parts = []
    if not run.has_pose.all():
        count = int((~run.has_pose).sum())
        parts.append(f"{count} of {total} frame sets without a pose{_because(run, ~run.has_pose)}")
    if flagged.any():
        doubts = f"the pose is doubtful in {int(flagged.sum())} of {total} frame sets"
        parts.append(f"{doubts}{_because(run, flagged)}")
    return parts if run.finished else [*parts, "the run is not finished"]


def _because(run: Run, which: Bools) -> str:
    """The most frequent reason of some frame sets, in brackets."""
    rows = [row for row, chosen in zip(doubts_of(run.poses), which, strict=True) if chosen]
    for text, count in counted(rows).items():
        return f" ({text})" if count == len(rows) else f" (most often: {text})"
    return ""


def _against_truth(run: Run, errors: Floats | None) -> tuple[str, str]:
    """Comparison with the truth, where it is known."""
    here = np.zeros(0, dtype=bool) if errors is None else np.isfinite(errors[:, :3]).all(axis=1)
    if errors is None or not here.any():
        return "good", ""
    distance = np.linalg.norm(errors[here, :3], axis=1)
    rms = float(np.sqrt(np.mean(distance**2)))
    words = f" Against the truth it is off by {_digits(rms)} mm RMS, {_digits(distance.max())} mm"
    words += " at most"
    judged = consistency(errors[run.has_pose, :3], run.covariances[:, :3, :3])
    if judged is None or judged.inside_95 >= _MIN_INSIDE_95:
        return "good", words + "."
    return "doubtful", (
        f"{words}: more than it claims, for only {judged.inside_95:.0%} of the errors lie "
        "inside their 95 % regions."
    )


def _not_counted(run: Run) -> list[str]:
    """What the uncertainty does not hold."""
    out = []
    if all(camera.pose_covariance is None for camera in run.cameras):
        scale_sd = run.scale_sd
        but = f" but for the world's scale ({scale_sd:.2%})" if scale_sd else ""
        out.append(f"The calibration is taken as exact{but}: its file states no uncertainty.")
    if not run.body.tolerance_mm:
        out.append("Balls are taken to sit where the body file says: it states no tolerance_mm.")
    return out


def _sets(count: int) -> str:
    return "the only frame set" if count == 1 else f"{count} frame sets"


def _digits(value: float) -> str:
    """Two significant digits."""
    return f"{value:#.2g}".rstrip(".")
