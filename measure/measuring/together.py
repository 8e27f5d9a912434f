"""Several bodies in the same pictures: each is tracked by itself and confused with none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, tee

import numpy as np

from measure.measuring.association import SecondBodyFlag
from measure.measuring.measurement import Measurement, Status
from measure.measuring.pipeline import Pipeline
from measure.model import Body, FrameSet, Pose

_OVERLAP = 0.8
"""Share of the radii's sum; two balls are never nearer than the sum, but poses have errors."""
_NEAR_MM = 30.0  # How far from a declared body's balls evidence of a second body is still that body


def measure_together(
    pipelines: Sequence[Pipeline], frame_sets: Iterable[FrameSet]
) -> Iterator[tuple[Measurement, ...]]:
    """Measure several bodies; yields a measurement of each for every frame set, in order.

    Args:
        pipelines: one for each body, of the same cameras.
        frame_sets: in order of time; read once, and kept until the last body is done with them.

    Raises:
        MeasureError: what the frame sets raise, after those before it have been measured.
    """
    for one in pipelines:
        one.others = tuple(other for other in pipelines if other is not one)
    bodies = [one.body for one in pipelines]
    *copies, last = tee(frame_sets, len(pipelines))
    measured = [
        one.measure(copy) for one, copy in zip(pipelines, [*copies, _releasing(last)], strict=True)
    ]
    explained = set[str]()
    for row in zip(*measured, strict=True):
        yield _reconciled(row, bodies, explained) if len(row) > 1 else row


def _releasing(frame_sets: Iterable[FrameSet]) -> Iterator[FrameSet]:
    """The same; pixels go once they are measured, so that their memory, still cached, is reused."""
    for frame_set in frame_sets:
        yield frame_set
        for image in frame_set.images.values():
            image.release()


def _reconciled(
    row: tuple[Measurement, ...], bodies: Sequence[Body], explained: set[str]
) -> tuple[Measurement, ...]:
    """The same, where bodies that are declared are no strangers, and do not share a place.

    Args:
        explained: flags of a second body that was a declared one; they hold on for a while, and
            are dropped then as well.
    """
    poses = [(body, one.pose) for body, one in zip(bodies, row, strict=True)]
    out = [_known(one, poses[:k] + poses[k + 1 :], explained) for k, one in enumerate(row)]
    for i, j in combinations(range(len(row)), 2):
        one, other = row[i].pose, row[j].pose
        if one is not None and other is not None and _overlap(bodies[i], one, bodies[j], other):
            out[i] = out[i].flagged(f"a ball of it lies in one of body '{bodies[j].name}'")
            out[j] = out[j].flagged(f"a ball of it lies in one of body '{bodies[i].name}'")
    return tuple(out)


def _known(
    measured: Measurement, others: Sequence[tuple[Body, Pose | None]], explained: set[str]
) -> Measurement:
    """The measurement without flags of a second body that is one of the others."""
    pose = measured.pose
    raised = [f for f in (() if pose is None else pose.flags) if isinstance(f, SecondBodyFlag)]
    if pose is None or not raised:
        return measured
    for body, its in others:
        if its is not None:
            balls = its.world_from_body.apply(body.centers)
            middle = balls.mean(axis=0)
            reach = _NEAR_MM + np.max(np.linalg.norm(balls - middle, axis=1))
            explained |= {f for f in raised if np.linalg.norm(f.place - middle) < reach}
    flags = tuple(flag for flag in pose.flags if flag not in explained)
    status = Status.FLAGGED if flags else Status.OK
    return replace(measured, pose=replace(pose, flags=flags), status=status)


def _overlap(body: Body, pose: Pose, other: Body, its: Pose) -> bool:
    apart = np.linalg.norm(
        pose.world_from_body.apply(body.centers)[:, None]
        - its.world_from_body.apply(other.centers),
        axis=2,
    )
    return bool(np.any(apart < _OVERLAP * (body.radii[:, None] + other.radii)))
