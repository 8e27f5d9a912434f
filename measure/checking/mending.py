"""What mends a cause: cameras, body and stamps as they are without it.

Every mend takes what a session is measured with and gives a changed copy. How much is changed is
fitted to a part of the instants, with the same model that named the cause (`explaining`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats
from measure.checking.causes import ALL, Cause, Word
from measure.checking.evidence import (
    FOCAL,
    PER_CAMERA,
    POINT,
    ROLL,
    SCALE,
    SHARED,
    SHIFT,
    SPREAD,
    TURN,
    Evidence,
    altered,
)
from measure.checking.explaining import fitted
from measure.checking.hypotheses import MIDWAY, Hypothesis, hypotheses, laid_onto
from measure.geometry import RigidTransform
from measure.geometry.covariance import symmetric_inverse
from measure.model import Camera
from measure.session import JOINT_COVARIANCE, CameraSource, SessionParts

_BLOCKS = 15
"""Parts of a recording; every third is kept out of an estimate."""
LATER = "-later"  # Behind the name of a camera from the instant on at which it was touched


def kept_out(instants: int) -> Bools:
    """Which of so many instants (k,), in order of time, take no part in an estimate."""
    block = max(1, round(instants / _BLOCKS))
    return np.asarray(np.arange(instants) // block % 3 == 2)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A hypothesis with its parameters, from the instants that are not kept out."""

    hypothesis: Hypothesis
    values: Floats  # (q,)
    covariance: Floats  # (q, q)
    evidence: Evidence  # what it was found in, all instants

    @classmethod
    def of(
        cls, evidence: Evidence, hypothesis: Hypothesis, beside: Sequence[Hypothesis] = ()
    ) -> Estimate:
        """Fit a hypothesis together with others."""
        kept = ~kept_out(len(evidence.times_s))
        each = [_of_part(one, kept) for one in (*beside, hypothesis)]
        values, covariance = fitted(evidence.part(kept), each).last()
        return cls(hypothesis, values, covariance, evidence)

    @property
    def deviations(self) -> float:
        """By how many of its standard deviations it differs from nothing."""
        distance = float(self.values @ symmetric_inverse(self.covariance) @ self.values)
        return float(np.sqrt(max(distance, 0.0) / len(self.values)))

    @property
    def middle_s(self) -> float:
        """The time from which a drift is counted."""
        return float(np.mean(self.evidence.times_s[~kept_out(len(self.evidence.times_s))]))

    @property
    def rig(self) -> Floats:
        """The rig's parameters (p,)."""
        return np.asarray(self.hypothesis.basis @ self.values)

    def of_camera(self, index: int) -> Floats:
        """The parameters of one camera."""
        return self.rig[PER_CAMERA * index : PER_CAMERA * (index + 1)]

    def shared(self, what: int) -> float:
        """A parameter that all cameras share."""
        return float(self.rig[self.evidence.shared(what)])


def _of_part(one: Hypothesis, kept: Bools) -> Hypothesis:
    """The same of the instants kept alone."""
    return one if one.since is None else one._replace(since=int(kept[: one.since].sum()))


def kept_out_residual(evidence: Evidence, beside: Sequence[Hypothesis] = ()) -> float:
    """RMS of residuals, in their standard deviations, at the instants that are kept out.

    Args:
        beside: what else is off, and is allowed for.
    """
    out = kept_out(len(evidence.times_s))
    return float(np.sqrt(fitted(evidence.part(out), [_of_part(h, out) for h in beside]).left))


def sharper(evidence: Evidence, cause: Cause) -> Hypothesis | None:
    """What is left of a cause once it was mended roughly: all that it may concern is free.

    None of what holds or does not.
    """
    word = {later: word for word, later in MIDWAY.items()}.get(cause.cause, cause.cause)
    of = cause.of + LATER * (cause.since_s is not None and word in (Word.MOVED, Word.ZOOM))
    names = [camera.name for camera in evidence.cameras]
    if word in (Word.MOVED, Word.ZOOM) and of in names:
        parts = (SHIFT, TURN) if word is Word.MOVED else (FOCAL, POINT)
        columns = [k for what in parts for k in evidence.of_camera(names.index(of), what)]
        return Hypothesis(word, of, np.eye(evidence.size)[:, columns])
    word = Word.SCALE if word is Word.SQUARE else word
    if word not in _FITTED or cause.cause is Word.CLOCK_STEP:
        return None
    own = "" if of == ALL else of
    alike = [h for h in hypotheses(evidence) if (h.word, h.of) == (word, own)]
    drifts = cause.unit == "%"
    return next((h for h in alike if h.drifts == (drifts and h.word is Word.CLOCK)), None)


_FITTED = (
    Word.CLOCK, Word.POINT, Word.ZOOM, Word.SCALE, Word.PLACE, Word.RADIUS, Word.ROLLING,
)  # fmt: skip


class Known(NamedTuple):
    """A cause, and what it amounts to where it is a parameter of the rig."""

    cause: Cause
    found: Estimate | None


Mend = Callable[[SessionParts, Known], SessionParts | None]
"""What a session is measured with, without a cause; None if it is not known how."""


def mended(parts: SessionParts, cause: Cause, found: Estimate | None) -> SessionParts | None:
    """What a session is measured with, without a cause; None if nothing but a person mends it.

    Args:
        found: what the cause amounts to, where it is a parameter of the rig.
    """
    mend = MENDS.get(cause.cause)
    return None if mend is None else mend(parts, Known(cause, found))


def _cameras_of(parts: SessionParts, found: Estimate) -> Iterator[tuple[int, Camera]]:
    """The cameras that a cause concerns, by their places, as they are without it."""
    for index, camera in enumerate(parts.cameras):
        if found.hypothesis.of in ("", camera.name):
            yield index, altered(camera, found.of_camera(index))


def _moved(parts: SessionParts, known: Known) -> SessionParts | None:
    found = known.found
    if found is None or found.hypothesis.of not in [camera.name for camera in parts.cameras]:
        return None
    for index, camera in _cameras_of(parts, found):
        covariance = parts.cameras[index].pose_covariance
        if len(found.values) == 6:
            # In the camera's axes, shift first; a calibration's covariances are along the world's.
            turn = np.kron(np.eye(2), parts.cameras[index].world_from_camera.rotation)
            fresh = turn @ found.covariance @ turn.T
            covariance = fresh if covariance is None else covariance + fresh
            parts = _joint_grown(parts, index, fresh)
        moved = replace(camera, pose_covariance=covariance, pose_intrinsics_covariance=None)
        parts = parts.with_camera(moved)
    return parts


def _joint_grown(parts: SessionParts, index: int, fresh: Floats) -> SessionParts:
    """The covariance of all cameras together, where it is known, with that of one pose added."""
    if JOINT_COVARIANCE not in parts.provenance:
        return parts
    joint = np.array(parts.provenance[JOINT_COVARIANCE], dtype=np.float64)
    first = sum(len(camera.free) for camera in parts.cameras[:index])
    joint[first : first + 6, first : first + 6] += fresh
    return replace(parts, provenance={**parts.provenance, JOINT_COVARIANCE: joint})


def _lens(parts: SessionParts, known: Known) -> SessionParts | None:
    found = known.found
    if found is None:
        return None
    for _, camera in _cameras_of(parts, found):
        parts = parts.with_camera(camera)
    return parts


def _from_then_on(mend: Mend) -> Mend:
    """The same of a camera's later pictures, which become a camera of their own.

    Pictures between the last instant before and the first one after are left out.
    """

    def mend_later(parts: SessionParts, known: Known) -> SessionParts | None:
        cause, found = known
        if found is None or found.hypothesis.since is None:
            return mend(parts, known)
        name, since, at_s = cause.of, found.hypothesis.since, found.evidence.times_s
        source = parts.sources[parts.index(name)]
        first, last = source.table.get("frames", (source.frames[0], source.frames[-1]))
        before = source.frames[source.times_s <= at_s[since - 1] + _SAME_S]
        after = source.frames[source.times_s >= at_s[since] - _SAME_S]
        if not len(before) or not len(after):
            return None
        index, later = parts.index(name), name + LATER
        ends = source.altered(frames=(int(first), int(before[-1])))
        begins = replace(source, name=later).altered(frames=(int(after[0]), int(last)))
        sources, cameras = list(parts.sources), list(parts.cameras)
        sources[index : index + 1] = [ends, begins]
        cameras.insert(index + 1, replace(cameras[index], name=later))
        provenance = {
            key: value for key, value in parts.provenance.items() if key != JOINT_COVARIANCE
        }
        cameras[index + 1] = altered(cameras[index + 1], found.of_camera(index))
        return replace(parts, sources=tuple(sources), cameras=tuple(cameras), provenance=provenance)

    return mend_later


_SAME_S = 0.005  # By which stamps of one instant may differ


def _scale(parts: SessionParts, known: Known) -> SessionParts | None:
    found = known.found
    if found is None:
        return None
    factor = float(np.exp(-found.shared(SCALE)))
    cameras = tuple(
        replace(
            camera,
            world_from_camera=RigidTransform(
                camera.world_from_camera.rotation, factor * camera.world_from_camera.translation
            ),
        )
        for camera in parts.cameras
    )
    body = parts.bodies[0]
    arm_mm = float(np.mean(np.linalg.norm(body.centers - body.middle, axis=1)))
    scale_sd = float(np.hypot(np.sqrt(found.covariance[0, 0]), body.distance_sd_mm / arm_mm))
    return replace(parts, cameras=cameras, scale_sd=scale_sd)


def _place(parts: SessionParts, known: Known) -> SessionParts | None:
    found = known.found
    if found is None:
        return None
    body = parts.bodies[0]
    moved = found.rig[found.evidence.shared(SHARED) + len(body.balls) :].reshape(-1, 3)
    centers = (body.centers + moved) * np.exp(found.shared(SPREAD))
    return parts.with_body(body.with_centers(np.round(centers, 4) + 0.0))


def _radius(parts: SessionParts, known: Known) -> SessionParts | None:
    cause, found = known
    body = parts.bodies[0]
    if found is not None:
        first = found.evidence.radius(0)
        radii = body.radii * np.exp(found.rig[first : first + len(body.balls)])
    elif cause.estimate is None:
        return None
    elif cause.unit == "%":
        radii = body.radii * (1 + cause.estimate / 100)
    else:
        radii = np.where([n == cause.of for n in body.names], cause.estimate, body.radii)
    balls = tuple(
        replace(ball, radius_mm=round(float(radius), 4))
        for ball, radius in zip(body.balls, radii, strict=True)
    )
    return parts.with_body(replace(body, balls=balls))


def _exchanged_balls(parts: SessionParts, known: Known) -> SessionParts | None:
    cause, found = known
    body = parts.bodies[0]
    orders = permutations(range(len(body.balls)))
    if found is not None:  # the order that moves the balls as was found
        moved = found.hypothesis.basis[found.evidence.place(0)[0] :, 0][: 3 * len(body.balls)]
        wanted = body.centers + moved.reshape(-1, 3)
        laid = {o: laid_onto(body.centers, body.centers[[*o]]) for o in orders}
        off = {o: float(np.abs(centers - wanted).max()) for o, centers in laid.items()}
        order = [*min(off, key=off.__getitem__)]
    elif cause.instead:
        order = [body.index(cause.instead.get(name, name)) for name in body.names]
    else:
        return None
    return parts.with_body(body.with_centers(body.centers[order]))


def _clock(parts: SessionParts, known: Known) -> SessionParts | None:
    """A clock that is off, or drifts; or stamps that are those of arrival, or of another rate."""
    cause, found = known
    source = parts.sources[parts.index(cause.of)]
    own = source.times_s
    if found is not None:
        late_s, *rate = found.values.tolist()
        new = own + late_s + (rate[0] * (own - found.middle_s) if rate else 0.0)
    elif cause.unit == "ms" and cause.estimate is not None:
        new = own + 1e-3 * cause.estimate
    elif cause.unit == "%" and cause.estimate is not None:
        new = own[0] + (own - own[0]) / (1 + cause.estimate / 100)
    else:  # bursts: pictures are taken evenly
        count = np.arange(len(own))
        new = np.polyval(np.polyfit(count, own, 1), count)
    return _stamped(parts, source, new)


def _clock_step(parts: SessionParts, known: Known) -> SessionParts | None:
    cause, found = known
    source = parts.sources[parts.index(cause.of)]
    own = source.times_s
    if found is not None:
        step_s = -float(found.values[0])
        at_s, since = found.evidence.times_s, found.hypothesis.since or 0
        first_s, last_s = at_s[max(since - 2, 0)], at_s[since]
    elif cause.estimate is not None and cause.since_s is not None:
        step_s, first_s, last_s = 1e-3 * cause.estimate, cause.since_s, cause.since_s
    else:
        return None
    steps, period_s = np.diff(own), float(np.median(np.diff(own)))
    near = np.flatnonzero((own[1:] > first_s - period_s) & (own[:-1] < last_s + period_s))
    if not len(near):
        return None
    at = int(near[np.argmin(np.abs(steps[near] - period_s - step_s))])
    if steps[at] > period_s + step_s / 2 > period_s:  # the stamps themselves say how much
        step_s = float(steps[at] - period_s)
    return _stamped(parts, source, own - step_s * (np.arange(len(own)) > at))


def _stamped(parts: SessionParts, source: CameraSource, times_s: Floats) -> SessionParts | None:
    if np.any(np.diff(times_s) <= 0):
        return None
    camera = parts.cameras[parts.index(source.name)]
    return parts.with_camera(camera, replace(source, times_s=times_s))


def _rolling(parts: SessionParts, known: Known) -> SessionParts | None:
    found = known.found
    if found is None:
        return None
    for index, camera in enumerate(parts.cameras):
        readout_s = camera.readout_s + float(found.of_camera(index)[ROLL][0])
        parts = parts.with_camera(replace(camera, readout_s=readout_s))
    return parts


def _exchanged_cameras(parts: SessionParts, known: Known) -> SessionParts | None:
    """Pictures, with their stamps, are named by the camera that took them."""
    cause = known.cause
    sources = [replace(s, name=cause.instead.get(s.name, s.name)) for s in parts.sources]
    by_name = {source.name: source for source in sources}
    return replace(parts, sources=tuple(by_name[camera.name] for camera in parts.cameras))


_SIGNS = {None: (1, 1), "left to right": (-1, 1), "top to bottom": (1, -1), "upside down": (-1, -1)}


def _mirrored(parts: SessionParts, known: Known) -> SessionParts | None:
    cause = known.cause
    if not cause.instead:
        return None  # the body file: which coordinate has the wrong sign no picture can tell
    for name, way in cause.instead.items():
        source = parts.sources[parts.index(name)]
        both = np.multiply(_SIGNS[way], _SIGNS[source.table.get("mirrored")]).tolist()
        stored = next(key for key, signs in _SIGNS.items() if [*signs] == both)
        camera = parts.cameras[parts.index(name)]
        parts = parts.with_camera(camera, source.altered(mirrored=stored))
    return parts


def _channels(parts: SessionParts, known: Known) -> SessionParts | None:
    cause = known.cause
    for name in cause.instead:
        source = parts.sources[parts.index(name)]
        exchanged = not source.table.get("red_blue_exchanged", False)
        camera = parts.cameras[parts.index(name)]
        parts = parts.with_camera(camera, source.altered(red_blue_exchanged=exchanged))
    return parts


MENDS: Mapping[Word, Mend] = {
    Word.CLOCK: _clock,
    Word.CLOCK_STEP: _clock_step,
    Word.MOVED: _moved,
    Word.MOVED_AT: _from_then_on(_moved),
    Word.ZOOM: _from_then_on(_lens),
    Word.POINT: _lens,
    Word.SCALE: _scale,
    Word.SQUARE: _scale,
    Word.PLACE: _place,
    Word.RADIUS: _radius,
    Word.ROLLING: _rolling,
    Word.EXCHANGED_BALLS: _exchanged_balls,
    Word.EXCHANGED_CAMERAS: _exchanged_cameras,
    Word.EXCHANGED_CHANNELS: _channels,
    Word.MIRRORED: _mirrored,
}
"""By cause, what mends it; of any other a person must."""
