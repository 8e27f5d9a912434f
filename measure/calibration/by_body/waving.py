"""A body that is waved to calibrate cameras: what to do next, and whether that is enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, rms_length
from measure.calibration.by_body.adjustment import adjusted, recording_of_links, shape_of
from measure.calibration.by_body.lenses import link_by_focal_lengths, motion_lacks, usual_lens
from measure.calibration.by_body.linking import Instant, link
from measure.calibration.by_body.single_view import View, body_poses
from measure.calibration.refining.recording import ball_places
from measure.calibration.waving import (
    TILTED_DEG,
    CameraWave,
    Now,
    WaveState,
    advice_of,
    cells_seen,
    expected_mm,
    is_new,
    pairs_seen,
)
from measure.errors import CalibrationError, DegenerateGeometryError
from measure.geometry import RigidTransform
from measure.model import Body, Detection, Intrinsics

_FIT_EVERY = 15  # Instants after which the cameras are located anew
_NEW_SHARE = 0.03  # Share of the diagonal by which a view differs from those that are kept


@dataclass(frozen=True, eq=False)
class _Sighting:
    """The body in one picture, by an ordinary lens if its own is unknown."""

    pixels: Floats  # (k, 2) where all its balls are
    distance_mm: float
    camera_from_body: RigidTransform

    def apart_px(self, other: _Sighting) -> float:
        """RMS distance of the balls in two pictures of a camera."""
        return rms_length(self.pixels - other.pixels)


class Located(NamedTuple):
    """What is known of the cameras by the first instants of a wave."""

    instants: int
    sd_mm: float = float("nan")  # expected error of the body's position; NaN where there is none
    motion: str = ""  # what unknown lenses need
    problem: str = ""  # why the cameras cannot be located


@dataclass
class BodyWave:
    """Takes what cameras see of a body at instants, and keeps what adds something."""

    body: Body
    sizes_wh: dict[str, tuple[int, int]]  # of the pictures, by camera
    lenses: Mapping[str, Intrinsics] | None = None  # None if they are unknown
    goal_mm: float = 0.2  # expected error of the body's position that is good enough
    kept: list[Instant] = field(default_factory=list)
    _seen: list[dict[str, _Sighting]] = field(default_factory=list)  # At what is kept
    _now: dict[str, Now] = field(default_factory=dict)
    known: Located = field(default_factory=lambda: Located(0))  # what `located` gave last

    def add(self, detections: Mapping[str, Sequence[Detection]], time_s: float) -> bool:
        """Take what may be balls at one instant, by camera, and say whether it is kept.

        It is if a camera sees the body where it did not before, or two cameras with few common
        instants see it together.
        """
        found = {name: self._sighting(name, some) for name, some in detections.items()}
        seen = {name: one for name, one in found.items() if one is not None}
        self._now = dict.fromkeys(seen, Now.SEEN)
        if not is_new(seen, self._seen, _Sighting.apart_px, self.sizes_wh, _NEW_SHARE):
            return False
        self.kept.append(Instant(time_s, detections))
        self._seen.append(seen)
        return True

    @property
    def wants_locating(self) -> bool:
        """Whether so much was added that `located` is worth its time."""
        return len(self.kept) >= self.known.instants + _FIT_EVERY

    def copy(self) -> BodyWave:
        """What is kept so far, for another process to locate the cameras by."""
        return replace(self, sizes_wh={**self.sizes_wh}, kept=[*self.kept], _seen=[], _now={})

    def state(self) -> WaveState:
        """How far it is."""
        cameras = {name: self._camera(name) for name in self.sizes_wh}
        pairs = pairs_seen(cameras, self._seen)
        state = WaveState(cameras, pairs, self.known.sd_mm, self.goal_mm, ())
        if state.enough:
            return state
        lacks = [*filter(None, [self.known.motion]), *advice_of(cameras, pairs, "body")]
        rest = self.known.problem or "every camera: carry the body to other places, and turn it"
        return replace(state, advice=tuple(lacks) or (rest,))

    def _sighting(self, name: str, detections: Sequence[Detection]) -> _Sighting | None:
        """The body by the pose on which the picture agrees best; None if it is not seen whole."""
        lens = self.lens(name)
        poses = body_poses(View.of(detections, self.body, lens), self.body)
        if not poses:
            return None
        places = poses[0].apply(self.body.centers)
        away_mm = float(np.linalg.norm(places.mean(axis=0)))
        return _Sighting(lens.project(places), away_mm, poses[0])

    def lens(self, name: str) -> Intrinsics:
        """The lens of a camera whose pictures came; a usual one if it is unknown."""
        return usual_lens(self.sizes_wh[name]) if self.lenses is None else self.lenses[name]

    def _camera(self, name: str) -> CameraWave:
        own = [one[name] for one in self._seen if name in one]
        far = np.array([one.distance_mm for one in own])
        # Tilted from how the body was held in the first picture that showed all of it.
        turns = [one.camera_from_body @ own[0].camera_from_body.inverse() for one in own]
        turned = [np.degrees(np.linalg.norm(turn.rotvec)) > TILTED_DEG for turn in turns]
        return CameraWave(
            len(own),
            cells_seen(self.sizes_wh[name], [one.pixels for one in own]),
            int(np.sum(turned)),
            float(far.max() / far.min()) if own else np.nan,
            np.nan,
            self._now.get(name, Now.NOTHING),
        )

    def located(self) -> Located:
        """How well the cameras are known by what is kept; it takes some seconds."""
        lenses, body = {name: self.lens(name) for name in self.sizes_wh}, self.body
        count = len(self.kept)
        try:
            by = link_by_focal_lengths if self.lenses is None else link
            linked = by(lenses, body, self.kept)
            recording = recording_of_links(linked, body)
            try:
                refinement = adjusted(linked.cameras, body, recording)
            except CalibrationError:
                return Located(count)  # more instants make a better start
            if self.lenses is None and (lacks := motion_lacks(refinement.cameras, recording)):
                return Located(count, motion=lacks)
            shape = shape_of(refinement, body, recording)
            around = ball_places(recording.world_from_body, body.centers)
            return Located(count, expected_mm(body, shape.cameras, around, shape.joint))
        except (CalibrationError, DegenerateGeometryError) as problem:
            return Located(count, problem=str(problem))
