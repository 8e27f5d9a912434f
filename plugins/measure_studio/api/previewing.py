"""Looking at running cameras: their newest pictures, and what is good or bad in them."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.api import Measurement
from measure.api.detecting import look
from measure.api.folders import write_named
from measure.api.lenses import Lens, LensOf
from measure.api.profiles import build_detectors, load_profile
from measure.arrays import Bytes, Floats
from measure.errors import MeasureError
from measure.host import Registry
from measure.model import Body, Detection, Image
from measure.model.observations import FULL
from measure_studio.api.recording import CaptureRequest
from measure_studio.capture import CameraAddress, CameraCount, Cameras
from measure_studio.capture.sources import POLL_S, RETRY_S

_ROWS = 400  # And columns of a picture that are judged, at least, where it has as many
_REACH_PX = 25  # Width within which an edge's contrast is taken
_EDGES, _BRIGHTEST = 0.9995, 0.99  # Quantiles that stand for the edges, and for what is bright
_SEEN_S = 5.0  # How long a ball that was found is named
_HELD_S = 1.5
"""How long a picture stays in which something was found, if no other comes: what is drawn into a
newer one would lie beside what moves."""
SEARCH_SHARE = 0.3  # Share of one core that searching pictures for balls may take
_MARK_BGR, _BALL_BGR, _CORNER_BGR = (255, 0, 255), (255, 255, 255), (255, 229, 0)
_CORNER_PX = 4  # Radius of the ring round a corner
_NAME_PX = 17  # Size of names beside outlines


@dataclass(frozen=True)
class PictureFacts:
    """What decides whether a picture can be measured."""

    size_wh: tuple[int, int]
    # steepest slope of edges as a share of the contrast, per px: about 0.5 in focus, below 0.2
    # blurred.
    sharpness: float
    level: float  # brightness that one pixel in a hundred exceeds, 0 to 1
    clipped_share: float  # share of pixels that are overexposed

    @classmethod
    def of(cls, pixels: Bytes) -> PictureFacts:
        """Judge a picture, BGR (h, w, 3)."""
        gray = cv2.cvtColor(pixels[:: max(1, len(pixels) // _ROWS)], cv2.COLOR_BGR2GRAY)
        slopes = cv2.absdiff(gray[:, 2:], gray[:, :-2])
        reach = np.ones((1, _REACH_PX), np.uint8)
        contrast = cv2.subtract(cv2.dilate(gray, reach), cv2.erode(gray, reach))[:, 1:-1]
        edges = slopes >= max(_quantile(slopes, _EDGES), 1)
        steepest = slopes[edges] / (2.0 * contrast[edges])
        return cls(
            (pixels.shape[1], pixels.shape[0]),
            float(np.median(steepest)) if len(steepest) else 0.0,
            _quantile(gray, _BRIGHTEST) / 255,
            float(np.mean(clipped(pixels))),
        )


def _quantile(levels: NDArray[Any], share: float) -> int:
    counts = cv2.calcHist([levels], [0], None, [256], [0, 256]).ravel()
    return int(np.searchsorted(np.cumsum(counts), share * levels.size))


def clipped(pixels: Bytes) -> Bytes:
    """Which pixels of a picture (h, w, 3), or which of every few, are overexposed: 0 or 1."""
    step = max(1, pixels.shape[1] // _ROWS)
    blue, green, red = cv2.split(pixels[::step, ::step])
    return np.asarray(cv2.max(cv2.max(blue, green), red) >= FULL, np.uint8)


@dataclass(frozen=True)
class CameraNow:
    """A camera at this moment."""

    count: CameraCount  # what has come of it
    problem: str  # why it delivers nothing now; empty if it does

    @classmethod
    def of(cls, name: str, count: CameraCount) -> CameraNow:
        """By what was counted of it."""
        last = count.outages[-1] if count.outages else None
        if last is not None and last.lasts:
            return cls(count, last.sentence())
        return cls(count, f"{name} has ended" if count.ended else "")


@dataclass(frozen=True, eq=False)
class _Shown:
    """A picture, and what was found in this one: balls, and corners (n, 2) px."""

    image: Image
    balls: Sequence[Detection] = ()
    corners: Floats | tuple[()] = ()

    def drawn(self, width_px: int) -> bytes:
        """It as a JPEG to look at."""
        pixels = self.image.pixels
        scale = min(1.0, width_px / pixels.shape[1])
        size = max(1, round(scale * pixels.shape[1])), max(1, round(scale * pixels.shape[0]))
        small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
        spoiled = cv2.resize(clipped(pixels), size, interpolation=cv2.INTER_NEAREST)
        small[spoiled > 0] = _MARK_BGR
        for one in self.balls:
            _outline(small, one.ball, scale * one.center_px, scale * one.radius_px)
        for u, v in np.rint(scale * np.asarray(self.corners)).astype(int).tolist():
            cv2.circle(small, (u, v), _CORNER_PX, _CORNER_BGR, 1, cv2.LINE_AA)
        return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


class Preview:
    """The newest picture of each camera; hand `add` to whatever reads them."""

    def __init__(self) -> None:
        self._newest: dict[str, _Shown] = {}
        self._came_s: dict[str, float] = {}
        self._balls: dict[str, tuple[float, Sequence[Detection]]] = {}
        self._shown: dict[tuple[str, int], tuple[_Shown, bytes, PictureFacts]] = {}
        self._held: dict[str, tuple[float, _Shown]] = {}

    def add(self, image: Image) -> None:
        """Take a picture; it is decoded only if it is looked at."""
        self._newest[image.camera] = _Shown(image)
        self._came_s[image.camera] = time.monotonic()

    def age_s(self, camera: str) -> float:
        """How long ago the newest picture of a camera came; infinite without one."""
        return time.monotonic() - self._came_s.get(camera, -math.inf)

    def newest(self, camera: str) -> Image | None:
        """The newest picture of a camera that can be read; None without one."""
        return newest.image if (newest := self._readable(camera)) else None

    def _readable(self, camera: str) -> _Shown | None:
        newest = self._newest.get(camera)
        try:
            return None if newest is None or not newest.image.pixels.size else newest
        except MeasureError:
            return None

    def pixels(self, cameras: Iterable[str]) -> dict[str, Bytes]:
        """The newest pictures of cameras, BGR (h, w, 3), of those that have one."""
        newest = {name: self.newest(name) for name in cameras}
        return {name: image.pixels for name, image in newest.items() if image is not None}

    def write(self, cameras: Iterable[str], folder: Path) -> None:
        """Write the newest picture of each camera into a new folder, named like the camera."""
        folder.mkdir()
        for name, pixels in self.pixels(cameras).items():
            write_named(folder, name, pixels)

    def hold(self, image: Image, corners: Floats) -> None:
        """Show this picture for a moment, in which corners (n, 2) px were found."""
        self._held[image.camera] = time.monotonic(), _Shown(image, corners=corners)

    def note_balls(self, image: Image, found: Iterable[Detection]) -> None:
        """Hear where balls are in a picture, which is shown with them."""
        now_s, shown = time.monotonic(), _Shown(image, tuple(found))
        self._balls[image.camera], self._held[image.camera] = (now_s, shown.balls), (now_s, shown)

    def note_measured(self, latest: Sequence[Measurement], images: Mapping[str, Image]) -> None:
        """Hear where balls are from a live measurement of these pictures."""
        views = [view for measured in latest for view in measured.views]
        for name, image in images.items():
            seen = [view.detection for view in views if view.camera == name]
            self.note_balls(image, [one for one in seen if one is not None])

    def forget_balls(self) -> None:
        """Other balls are looked for from now on."""
        self._balls, self._held = {}, {}

    def has_looked(self, camera: str) -> bool:
        """Whether balls were looked for in a camera's pictures."""
        return camera in self._balls

    def balls(self, camera: str) -> tuple[str, ...]:
        """Names of the balls that were seen of late."""
        since, found = self._balls.get(camera, (-math.inf, ()))
        late = time.monotonic() - since > _SEEN_S
        return () if late else tuple(sorted({one.ball for one in found}))

    def shown(self, camera: str, width_px: int) -> tuple[bytes, PictureFacts] | None:
        """A picture as a JPEG to look at, overexposed parts in magenta, balls outlined and named.

        The newest one, or for a moment the newest in which something was found.
        """
        since_s, shown = self._held.get(camera) or (-math.inf, None)
        if shown is None or time.monotonic() - since_s >= _HELD_S:
            shown = self._readable(camera)
        if shown is None:
            return None
        key = camera, width_px
        if key not in self._shown or self._shown[key][0] is not shown:
            self._shown[key] = shown, shown.drawn(width_px), PictureFacts.of(shown.image.pixels)
        return self._shown[key][1:]

    def last_shown(self, camera: str, width_px: int) -> Image | None:
        """The picture of a camera that somebody looks at in this width; None if nobody does."""
        return known[0].image if (known := self._shown.get((camera, width_px))) else None

    def facts(self, camera: str) -> PictureFacts | None:
        """What the picture of a camera that was shown last is like; None if none was."""
        seen = [shown[-1] for (name, _), shown in list(self._shown.items()) if name == camera]
        return seen[-1] if seen else None


def _outline(picture: Bytes, name: str, center_px: Floats, radius_px: float) -> None:
    """Draw a ball's outline, and its name beside it, to the right where there is room."""
    (u, v), radius = np.rint(center_px).astype(int).tolist(), max(2, round(radius_px))
    cv2.circle(picture, (u, v), radius, _BALL_BGR, 2, cv2.LINE_AA)
    font, size, weight = cv2.FontFace("sans"), _NAME_PX, 600
    _, _, wide, _ = cv2.getTextSize(picture.shape[1::-1], name, (0, 0), font, size, weight)
    right = u + radius + 4 + wide <= picture.shape[1]
    x, y = u + radius + 4 if right else u - radius - 4 - wide, v + size // 3
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        cv2.putText(picture, name, (x + dx, y + dy), (0, 0, 0), font, size, weight)
    cv2.putText(picture, name, (x, y), _BALL_BGR, font, size, weight)


class WatchedCamera:
    """Reads a camera for as long as it takes: one that is not there is tried again.

    Attributes:
        now: its state.
    """

    CONNECTING = "is being connected"

    def __init__(
        self, camera: CameraAddress, sink: Callable[[Image], None], request: CaptureRequest
    ) -> None:
        """Begin; `sink` gets every picture, from a thread of the camera's."""
        self._camera, self._sink, self._request = camera, sink, request
        self._stop, self.now = threading.Event(), CameraNow(CameraCount(), self.CONNECTING)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Read no more."""
        self._stop.set()

    def wait(self, seconds: float) -> None:
        """After `stop`, wait till the camera is free for others, not for longer than this."""
        self._thread.join(seconds)

    def _work(self) -> None:
        name, asked = self._camera.name, self._request
        while not self._stop.is_set():
            try:
                controls = asked.controls_of(name) if self._camera.is_device else {}
                source = self._camera.source(asked.size_wh, asked.rate, controls)
                with Cameras({name: source}) as rig:
                    rig.begin([self._sink])
                    while not (rig.over or self._stop.wait(POLL_S)):
                        rig.check()
                        self.now = CameraNow.of(name, rig.counts[name])
                    rig.check()
            except MeasureError as problem:
                self.now = replace(self.now, problem=str(problem))
            self._stop.wait(RETRY_S)


class BallWatch:
    """Searches the newest pictures of cameras for bodies' balls, in turn and at leisure.

    Ordinary lenses are assumed. Of balls that are found in one place the best is meant.
    """

    def __init__(
        self, preview: Preview, cameras: Sequence[str], bodies: Sequence[Body], registry: Registry
    ) -> None:
        self._preview, self._cameras = preview, cameras
        profile = load_profile()
        self._searches = [
            (body, partial(build_detectors, profile, registry, body)) for body in bodies
        ]
        self._stop = threading.Event()
        preview.forget_balls()
        threading.Thread(target=self._work, daemon=True).start()

    def stop(self) -> None:
        """Search no more."""
        self._stop.set()

    def _work(self) -> None:
        while not self._stop.wait(POLL_S):
            for name in self._cameras:
                begun = time.monotonic()
                if (image := self._preview.newest(name)) is not None:
                    height, width = image.pixels.shape[:2]
                    camera = replace(LensOf(Lens()).of(width, height, Path(name)), name=name)
                    found = [
                        one
                        for body, build in self._searches
                        for one in look(image, body, build, {}, camera)
                    ]
                    if self._stop.is_set():
                        return
                    self._preview.note_balls(image, best_balls(found))
                # A first search that compiled for minutes is no reason to rest as long.
                took_s = min(time.monotonic() - begun, RETRY_S)
                if self._stop.wait(took_s * (1 / SEARCH_SHARE - 1)):
                    return


def best_balls(found: Iterable[Detection]) -> list[Detection]:
    """The best of each ball, and of those that lie in one place."""
    best = {one.ball: one for one in sorted(found, key=lambda one: one.score)}
    kept = list[Detection]()
    for one in sorted(best.values(), key=lambda one: -one.score):
        apart = [np.linalg.norm(one.center_px - two.center_px) - two.radius_px for two in kept]
        if min(apart, default=1.0) > 0:
            kept.append(one)
    return kept


@contextmanager
def web_viewer() -> Iterator[tuple[str, str]]:
    """A viewer served to browsers of this machine, until the block ends.

    Yields:
        Where a browser finds it, and where a measurement can send to; RunError without a viewer.
    """
    from measure.viewing.viewer import open_viewer

    viewer = open_viewer([], web=True)
    try:
        yield str(viewer.address), viewer.listens
    finally:
        viewer.process.terminate()
        viewer.process.wait()
