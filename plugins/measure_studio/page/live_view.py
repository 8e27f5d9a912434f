"""A live measurement in 3-D: cameras, balls, the rays to them, and the way of the body."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from nicegui import ui

from measure import api

_MM = 0.01  # A unit of the scene is 100 mm
_TRAIL = 600  # Poses
_CAMERA_MM, _LENS_MM = 40.0, 60.0
_COLORS = {"magenta": "#d0348f", "pink": "#e86aa5", "white": "#f4f4f4", "yellow": "#e8c21c"}
_RAY = "#8aa4bd"
_STATES = {"ok": (46, 160, 67), "flagged": (178, 106, 0)}


class LiveView:
    """What was measured of late, to be drawn by any page that is open."""

    def __init__(
        self, cameras: Sequence[api.Camera], places_mm: Any = (), are_good: Any = ()
    ) -> None:
        """Begin with the cameras, and the places (n, 3) of poses that are known already."""
        self._cameras = {camera.name: camera for camera in cameras}
        self._latest: Sequence[api.Measurement] = ()
        self._trail: deque[tuple[list[float], tuple[int, int, int]]] = deque(maxlen=_TRAIL)
        step = max(len(places_mm) // _TRAIL, 1)
        for place, is_good in zip(places_mm[::step], are_good[::step], strict=True):
            state = _STATES["ok" if is_good else "flagged"]
            self._trail.append(((_MM * np.asarray(place)).tolist(), state))

    def note(self, latest: Sequence[api.Measurement]) -> None:
        """Take the measurements of a frame set."""
        self._latest = latest
        for one in latest:
            if one.pose is not None:
                place = _MM * one.pose.world_from_body.translation
                self._trail.append((place.tolist(), _STATES[one.status.value]))

    def scene(self) -> Callable[[], None]:
        """Draw the cameras into the page; gives what draws all the rest anew."""
        middle = _MM * np.mean([camera.center for camera in self._cameras.values()], axis=0)
        with ui.scene(
            480, 300, grid=False, background_color="#eef1f4", fps=8, click_events=[]
        ) as scene:
            scene.axes_helper(1.0)
            for camera in self._cameras.values():
                self._draw_camera(scene, camera)
            trail = scene.point_cloud([[0, 0, 0]], [[0, 0, 0]], point_size=0.12)
            away = [_MM * camera.center - middle for camera in self._cameras.values()]
            eye = middle + np.array([0.3, -1.2, 0.6]) * float(np.max(np.linalg.norm(away, axis=1)))
            (x, y, z), (to_x, to_y, to_z) = eye.tolist(), (0.4 * middle).tolist()
            scene.move_camera(x, y, z, to_x, to_y, to_z, duration=0)
        moving: list[Any] = []

        def draw() -> None:
            with scene:
                drawn = [thing for one in self._latest for thing in self._draw(scene, one)]
            for before in moving:  # After the new ones are there, or balls would flicker
                before.delete()
            moving[:] = drawn
            if self._trail:
                places, colors = zip(*self._trail, strict=True)
                trail.set_points([*places], [[c / 255 for c in color] for color in colors])

        return draw

    def _draw_camera(self, scene: ui.scene, camera: api.Camera) -> None:
        place, turn = _MM * camera.center, camera.world_from_camera.rotation
        size = _MM * _CAMERA_MM
        scene.box(size, 0.7 * size, size).move(*place).rotate_R(turn.tolist()).material("#455a64")
        tip = place + _MM * _LENS_MM * turn[:, 2]
        scene.line(place.tolist(), tip.tolist()).material("#455a64")
        scene.text(camera.name).move(*(place + np.array([0, 0, size])))

    def _draw(self, scene: ui.scene, one: api.Measurement) -> list[Any]:
        drawn = list[Any]()
        for ball in one.positions:
            center = (_MM * ball.center).tolist()
            sphere = scene.sphere(_MM * 15.0).move(*center)
            drawn.append(sphere.material(_COLORS.get(ball.ball, ball.ball)))
            for name in ball.cameras:
                eye = (_MM * self._cameras[name].center).tolist()
                drawn.append(scene.line(eye, center).material(_RAY))
        return drawn
