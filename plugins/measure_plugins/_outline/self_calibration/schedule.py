"""When a camera's appearance is learnt, and from which pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from measure.arrays import Bytes, Floats
from measure_plugins._outline.appearance.interreflection import (
    balls_behind,
    balls_nearer,
    mirrored_behind,
)
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.fitting.edges import INSIDE_PX, OUTSIDE_PX
from measure_plugins._outline.sampling.rays import STEPS, cast_rays, frame_about, mark_occluded
from measure_plugins._outline.self_calibration.environment_map import Backdrop, backdrop_of, room_of
from measure_plugins._outline.self_calibration.estimate import Lesson, take_lesson
from measure_plugins._outline.self_calibration.patch import Sight
from measure_plugins._outline.self_calibration.point_lights import Light, lamps_by, light_on
from measure_plugins._outline.self_calibration.response_and_blur import misfits
from measure_plugins._outline.self_calibration.trust import Agreement, agreement_on, believed_share

_FIRST = 2
"""The first picture is only kept: finding the balls in it is slow enough."""
_LATER = 4
"""Each lesson waits for this many times as many pictures as the one before: light and exposure may
change, but what a lesson costs must not be felt."""
_REMEMBERED = 4
_SETTLED = 2
"""After so many lessons, what pictures teach is known about as well as it ever will be."""
_BORDER_PX = 2.0

Cone = tuple[Floats, float, float]
"""Unit axis (3,), half angle in rad, distance in mm."""


class AppearanceLearner:
    """Counts one camera's pictures; now and then, learns from the balls in one and those before."""

    def __init__(
        self, lens: Floats, world_from_camera: Floats, rays: int, margin_px: float
    ) -> None:
        """Of a camera with this lens row (13,), turned this way in the world (3, 3)."""
        self._lens, self._world_from_camera = lens, world_from_camera
        self._rays, self._margin_px = rays, margin_px
        self._count, self._kept, self._due = 0, 1, _FIRST
        self._pictures: deque[list[Sight]] = deque(maxlen=_REMEMBERED)
        self._backdrops: deque[Backdrop] = deque(maxlen=_REMEMBERED)
        self._lessons, self._latest_s = 0, -np.inf
        self._lesson: Lesson | None = None
        self._believe_bent = False
        self._others: list[Light] = []
        self._agreements: list[Agreement] = []

    @property
    def settled(self) -> bool:
        """Whether there have been lessons enough to start measuring."""
        return self._lessons >= _SETTLED

    @property
    def lesson(self) -> Lesson | None:
        """The last of enough lessons; None before, and where there was too little to see."""
        return self._lesson if self.settled else None

    def told(self, now: Appearance, lessons: Sequence[Lesson], bent: bool) -> Appearance:
        """Hear what all cameras have learnt.

        Args:
            now: the appearance at present.
            lessons: the last of every camera, this one's own among them.
            bent: whether to believe that the tone curve is bent, as the other cameras' is.

        Returns:
            The appearance with that: what was shown last, explained once more.
        """
        if self._lesson is None:
            return now
        others = [one for one in lessons if one is not self._lesson]
        lights = [one.light_by(bent or one.bent) for one in others]
        self._others = [light for light in lights if light is not None]
        self._agreements = [one.agreement for one in others]
        self._believe_bent |= bent
        if bent and not self._lesson.bent:
            return self._lesson_on(now)()
        return self._lit_alike(self._lesson)

    def wants(self, found: int, time_s: float) -> bool:
        """Whether a picture is one to keep or to learn from; asked about every picture.

        Args:
            found: number of balls found in it.
            time_s: when it was taken. One that is no later than all before teaches nothing new.
        """
        if found == 0 or time_s <= self._latest_s:
            return False
        self._count, self._latest_s = self._count + 1, time_s
        return self._count >= self._kept

    def shown(
        self, pixels: Bytes, seen: Sequence[Cone], others: Sequence[Cone], now: Appearance
    ) -> Callable[[], Appearance] | None:
        """Keep a picture that is wanted; the lesson it makes possible, if it is one to learn from.

        A lesson takes long. It is on what has been shown so far, whenever it is taken.

        Args:
            pixels: (h, w, 3) the picture.
            seen: outlines found in it; their half angles from known distances.
            others: outlines of balls that are there but were not found.
            now: the appearance at present.
        """
        self._kept = 2 * self._count
        self._backdrops.append(self._backdrop(pixels, (*seen, *others)))
        self._pictures.append([self._sight(pixels, cone, (*seen, *others)) for cone in seen])
        if self._count < self._due:
            return None
        self._due, self._lessons = _LATER * self._count, self._lessons + 1
        return self._lesson_on(now)

    def _lesson_on(self, now: Appearance) -> Callable[[], Appearance]:
        """What is known by now, and yet to be learnt from."""
        sights = [sight for picture in self._pictures for sight in picture]
        backdrops = list(self._backdrops)

        def taken() -> Appearance:
            self._lesson = take_lesson(
                sights, now, self._world_from_camera, self._believe_bent, backdrops
            )
            return now if self._lesson is None else self._lit_alike(self._lesson)

        return taken

    def _lit_alike(self, lesson: Lesson) -> Appearance:
        """What a lesson taught, by the light that other cameras see, believed as they agree."""
        own, now = lesson.light_by(lesson.bent), lesson.appearance
        if own is not None and self._others and len(now.lamps) > 0:
            now = replace(now, lamps=lamps_by([own, *self._others]))
        share = believed_share([lesson.agreement, *self._agreements])
        return now if share == now.believed else replace(now, believed=share)

    def warm_up(self, pixels: Bytes, cone: Cone, now: Appearance) -> None:
        """Compile what a lesson runs."""
        sights = [self._sight(pixels, cone, [])]
        misfits(sights, now)
        agreement_on(sights, now)
        lamps_by([light_on(sights, now, self._world_from_camera)])
        backdrop = self._backdrop(pixels, [cone])
        misfits(sights, replace(now, room=room_of([backdrop], now.table)))

    def _backdrop(self, pixels: Bytes, balls: Sequence[Cone]) -> Backdrop:
        rows = np.array([[*axis, half_angle] for axis, half_angle, _ in balls])
        return backdrop_of(pixels, self._lens, rows.reshape(-1, 4))

    def _sight(self, pixels: Bytes, cone: Cone, all_cones: Sequence[Cone]) -> Sight:
        axis, half_angle, distance = cone
        rows = np.array([[*a, h, d] for a, h, d in (cone, *all_cones)])
        nearer, frame = balls_nearer(rows[0], rows), frame_about(axis)
        rays, scale = cast_rays(frame, half_angle, self._rays, self._lens)
        reach = (INSIDE_PX[0], OUTSIDE_PX[1])
        mark_occluded(rays, scale, frame, half_angle, nearer, reach, self._margin_px)
        part, corner = _cut(pixels, rays.points)
        behind = mirrored_behind(balls_behind(rows[0], rows), frame, half_angle, rays.around)
        rays, scale_px = rays._replace(points=rays.points - corner), float(np.mean(scale))
        return Sight(part, rays, half_angle, scale_px, frame, behind, distance)


def _cut(pixels: Bytes, points: Floats) -> tuple[Bytes, Floats]:
    """The part of a picture that rays across an outline (n, 2) touch, and its corner (2,) in px."""
    reach = STEPS[-1] + _BORDER_PX
    size = np.array(pixels.shape[1::-1])
    low = np.clip(np.floor(points.min(axis=0) - reach), 0, size - 1).astype(int)
    high = np.clip(np.ceil(points.max(axis=0) + reach), 1, size).astype(int)
    part = np.ascontiguousarray(pixels[low[1] : high[1] + 1, low[0] : high[0] + 1])
    return part, low.astype(np.float64)


class LessonsAside:
    """Takes a lesson at a time in a thread of its own."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="lesson")
        self._lesson: Future[Appearance] | None = None

    def begin(self, lesson: Callable[[], Appearance]) -> None:
        """Begin a lesson; while one is taken, others are left out."""
        if self._lesson is None:
            self._lesson = self._pool.submit(lesson)

    def done(self) -> Appearance | None:
        """What has been learnt, once; None as long as there is nothing."""
        if self._lesson is None or not self._lesson.done():
            return None
        lesson, self._lesson = self._lesson, None
        return lesson.result()
