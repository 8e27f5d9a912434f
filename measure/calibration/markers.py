"""Finding and naming markers in a picture from a rough camera pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.calibration import patterns
from measure.calibration.boards import MIN_MARKS
from measure.calibration.extrinsics import located_by_marks
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.model import Camera, MarkerObservation

MarkerKind = Literal["dot", "cross"]

_SINGULARS: dict[MarkerKind, str] = {"dot": "bright dot", "cross": "cross"}
_PLURALS: dict[MarkerKind, str] = {"dot": "bright dots", "cross": "crosses"}
_FIRST_REACH_PX = 40.0
_LAST_REACH_PX = 4.0
_ASSIGNMENT_ROUNDS = 6
_SIZE_RATIO = 1.35


@dataclass(frozen=True, eq=False)
class FoundMarkers:
    """Markers found in one picture."""

    marks: dict[str, Floats]  # by name (2,) px
    doubtful: dict[str, str]  # left out, with the reason, by name


def find_markers(
    bgr: Bytes, camera: Camera, markers: MarkerField, kind: MarkerKind = "dot"
) -> FoundMarkers:
    """Find the markers of a field in a picture (h, w, 3), from a camera with a rough pose.

    Candidates are assigned to predicted places all at once (the least sum of squared distances,
    nobody twice), the pose is refined from that, and so on with a shrinking reach. CalibrationError
    if too few fit the pose.
    """
    light, plural = patterns.linear_light(bgr), _PLURALS[kind]
    candidates: list[patterns.Dot] | list[patterns.Cross]
    candidates = (
        patterns.dot_candidates(light) if kind == "dot" else patterns.cross_candidates(light)
    )
    if len(candidates) < MIN_MARKS:
        raise CalibrationError(
            f"camera {camera.name}: {len(candidates)} {plural} in the marker picture, at least "
            f"{MIN_MARKS} are needed; mark them by hand in marks.csv"
        )
    rough = np.stack([candidate.center_px for candidate in candidates])
    for reach in np.geomspace(_FIRST_REACH_PX, _LAST_REACH_PX, _ASSIGNMENT_ROUNDS):
        ids, numbers = assign(camera.project(markers.points), rough, float(reach))
        if len(ids) < MIN_MARKS:
            raise CalibrationError(
                f"camera {camera.name}: only {len(ids)} {plural} lie within {reach:.0f} px of "
                "where the board's pose puts the markers; are board and markers in the same "
                "world, is the picture mirrored? (or mark them by hand in marks.csv)"
            )
        camera = located_by_marks(camera, markers.points, MarkerObservation(ids, rough[numbers]))
    chosen = {markers.names[i]: candidates[n] for i, n in zip(ids, numbers, strict=True)}
    return _refined(light, camera, markers, chosen, kind)


def assign(predicted: Floats, found: Floats, reach_px: float) -> tuple[Ints, Ints]:
    """Pair predictions (k, 2) with finds (n, 2), nobody twice, at the least total squared distance.

    Gives the numbers of both; none are farther apart than `reach_px`. NaN is predicted of what
    cannot be seen.
    """
    from scipy.optimize import linear_sum_assignment

    squared = np.sum((predicted[:, None] - found[None]) ** 2, axis=2)
    squared = np.where(np.isfinite(squared), np.minimum(squared, reach_px**2), reach_px**2)
    rows, columns = linear_sum_assignment(squared)
    near = squared[rows, columns] < reach_px**2
    return rows[near], columns[near]


def _refined(
    light: Floats,
    camera: Camera,
    markers: MarkerField,
    chosen: Mapping[str, patterns.Dot | patterns.Cross],
    kind: MarkerKind,
) -> FoundMarkers:
    fitted = {
        name: patterns.refine_dot(
            light, rough, patterns.outline_shape(camera.intrinsics, rough.center_px)
        )
        if isinstance(rough, patterns.Dot)
        else patterns.refine_cross(light, rough)
        for name, rough in chosen.items()
    }
    wrong = f"its picture is not that of a {_SINGULARS[kind]}"
    doubtful = {name: wrong for name, mark in fitted.items() if mark is None}
    dots = {name: mark.radius_px for name, mark in fitted.items() if isinstance(mark, patterns.Dot)}
    doubtful |= _wrong_sizes(camera, markers, dots)
    marks = {n: mark.center_px for n, mark in fitted.items() if mark and n not in doubtful}
    visible = camera.intrinsics.contains(camera.project(markers.points), 5.0)
    for number, name in enumerate(markers.names):
        if visible[number] and name not in marks and name not in doubtful:
            doubtful[name] = f"no {_SINGULARS[kind]} near its place"
    return FoundMarkers(marks, doubtful)


def _wrong_sizes(
    camera: Camera, markers: MarkerField, radius_px: Mapping[str, float]
) -> dict[str, str]:
    """Dots that are larger or smaller than the others at their distances, with the reason."""
    distance = np.linalg.norm(markers.points - camera.center, axis=1)
    sizes = {name: r * float(distance[markers.index(name)]) for name, r in radius_px.items()}
    usual = float(np.median(list(sizes.values()))) if sizes else 1.0
    return {
        name: f"its size is {size / usual:.2f} times that of the other markers"
        for name, size in sizes.items()
        if not 1 / _SIZE_RATIO < size / usual < _SIZE_RATIO
    }
