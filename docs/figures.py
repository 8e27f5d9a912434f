"""Draw the figures of the explanation pages: `python docs/figures.py [joint_fit] [outline]`.

Both are computed by the program itself on pictures rendered with exact truth, and written as SVG.
What the pages quote of them is printed.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from measure.api import load_profile, measure_session, render_demo
from measure.arrays import Bytes, Floats
from measure.geometry import RigidTransform, tangent_cone
from measure.host import Registry
from measure.model import Body, Camera, Detection
from measure.model.lens import RAY, fill_rays
from measure.session import open_session
from measure.simulation import Renderer, Scene
from measure.simulation.catalogue import webcam_scene
from measure_plugins._outline.appearance import Appearance, first_appearance
from measure_plugins._outline.edges import (
    INSIDE_PX,
    LATER_STEPS,
    OUTSIDE_PX,
    EdgePairs,
    Edges,
    compare,
    corrected_edges,
    find_edge_pairs,
)
from measure_plugins._outline.rays import cast_rays, frame_about
from measure_plugins._outline.response import BallPatch, grouped_inputs, prediction_inputs
from measure_plugins._outline.self_calibration import Cone, SelfCalibration

Row = Sequence[float] | Floats
IMAGES = Path(__file__).parent / "images"
RAYS, MARGIN_PX = 72, 7.0
GREY, BLUE, GREEN, RED, YELLOW = "#888", "#2a5ec8", "#2a8c3c", "#c8322d", "#d8a800"
OFF = (0.6, -0.6, 0.5, 0.01, -0.01, 0.01)
"""The pose that the first figure starts from: 1 mm and 1 deg off (mm, rad)."""


def main() -> None:
    """Draw those that are named, or both."""
    drawn = {"joint_fit": joint_fit, "outline": outline}
    for name in sys.argv[1:] or drawn:
        (IMAGES / f"{name}.svg").write_text(drawn[name](), encoding="utf-8")


class Panel(NamedTuple):
    """A plot in a figure: place and size in px, and what its sides stand for."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where a point is in the figure; what lies outside is put on the border."""
        across = (x - self.x[0]) / (self.x[1] - self.x[0])
        up = (y - self.y[0]) / (self.y[1] - self.y[0])
        a, b = (min(max(share, 0.0), 1.0) for share in (across, up))
        return self.left + a * self.width, self.top + (1 - b) * self.height

    def axes(self, title: str, xs: Iterable[float], ys: Iterable[float], unit: str) -> list[str]:
        """Title, ticks with their values, and lines across at those of y."""
        low, right = self.top + self.height, self.left + self.width
        out = [_text(self.left, self.top - 8, title, weight="bold")]
        for y in ys:
            height = self.at(self.x[0], y)[1]
            out.append(_path(f"M{self.left:.1f} {height:.1f}H{right:.1f}", "#ddd", 1))
            out.append(_text(self.left - 5, height + 4, f"{y:g}", "end"))
        for x in xs:
            across = self.at(x, self.y[0])[0]
            out.append(_path(f"M{across:.1f} {low:.1f}v4", GREY, 1))
            out.append(_text(across, low + 16, f"{x:g}", "middle"))
        return [*out, _text(right, low + 32, unit, "end")]

    def line(self, xs: Row, ys: Row, color: str, dashed: str = "") -> str:
        """A line through points; broken where one is not a number."""
        path, pen = "", "M"
        for x, y in zip(xs, ys, strict=True):
            if np.isfinite(y):
                right, down = self.at(x, y)
                path, pen = f"{path}{pen}{right:.1f} {down:.1f}", "L"
            else:
                pen = "M"
        return _path(path, color, 1.6, dashed)

    def dots(self, xs: Row, ys: Row, color: str, size: float = 2) -> str:
        """A dot for each point that is a number."""
        return "".join(
            f'<circle cx="{self.at(x, y)[0]:.1f}" cy="{self.at(x, y)[1]:.1f}" r="{size:g}" '
            f'fill="{color}"/>'
            for x, y in zip(xs, ys, strict=True)
            if np.isfinite(y)
        )


def _path(path: str, color: str, width: float, dashed: str = "") -> str:
    dash = f' stroke-dasharray="{dashed}"' if dashed else ""
    return f'<path d="{path}" stroke="{color}" stroke-width="{width:g}" fill="none"{dash}/>'


def _text(
    x: float, y: float, text: str, anchor: str = "start", color: str = "#333", weight: str = ""
) -> str:
    bold = f' font-weight="{weight}"' if weight else ""
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{color}"'
    return f"<text {place}{bold}>{text}</text>"


def _figure(width: int, height: int, parts: Iterable[str]) -> str:
    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} style="font:12px sans-serif">'
    return "\n".join([head, '<rect width="100%" height="100%" fill="#fff"/>', *parts, "</svg>\n"])


def joint_fit() -> str:
    """The residual of an outline point, and those of one camera before and after the fit."""
    with tempfile.TemporaryDirectory() as scratch:
        session = render_demo(Path(scratch) / "demo", 8)
        with open_session(session) as opened:
            profile, registry = load_profile("precise"), Registry.discover()
            *_, (_, last) = measure_session(opened, profile, registry)
            body, camera = opened.body, opened.cameras[0]
    assert last.pose is not None
    found = [v.detection for v in last.views if v.camera == camera.name and v.detection]
    pose = last.pose.world_from_body
    before = Panel(400, 30, 340, 120, (0, 360), (-6, 6))
    after = Panel(400, 220, 340, 120, (0, 360), (-1, 1))
    turns = range(0, 361, 90)
    parts = [*_geometry(20, 40)]
    parts += before.axes("r at a pose 1 mm and 1 deg off, px", turns, (-6, -3, 0, 3, 6), "")
    parts += after.axes("r at the fitted pose, px", turns, (-1, -0.5, 0, 0.5, 1), "direction, deg")
    for one in found:
        color = {"green": GREEN, "yellow": YELLOW, "red": RED}[one.ball]
        parts.append(before.dots(*_residuals(one, camera, body, pose.perturb(OFF)), color))
        turn, left = _residuals(one, camera, body, pose)
        parts.append(after.dots(turn, left, color))
        print(f"{one.ball}: {np.sqrt(np.mean(left**2)):.2f} px RMS at the fitted pose")
    return _figure(760, 390, parts)


def _residuals(
    seen: Detection, camera: Camera, body: Body, pose: RigidTransform
) -> tuple[Floats, Floats]:
    """Directions in the picture (n,) in deg, right 0, down 90; residuals (n,) in px: formula 1."""
    assert seen.outline_px is not None
    n, ball = len(seen.outline_px), body.balls[body.index(seen.ball)]
    rays = np.empty((RAY, n))
    fill_rays(seen.outline_px, 0, n, camera.intrinsics.row, rays)
    cone = tangent_cone(camera.camera_from_world.apply(pose.apply(ball.center_mm)), ball.radius_mm)
    sine = np.linalg.norm(np.cross(rays[:3].T, cone.axis), axis=1)
    moved = -np.stack([cone.axis @ rays[3:6], cone.axis @ rays[6:9]]) / sine
    angles = np.degrees(np.arctan2(moved[1], moved[0])) % 360
    return angles, np.linalg.norm(moved, axis=0) * cone.residuals(rays[:3].T)


def _geometry(left: float, top: float) -> list[str]:
    """A camera, a ball, its cone of tangents, and the bearing of a point outside of it."""
    x, y, ball_x, ball_y, radius = left + 10, top + 190, left + 240, top + 130, 68.0
    away = float(np.hypot(ball_x - x, ball_y - y))
    axis, half = float(np.arctan2(ball_y - y, ball_x - x)), float(np.arcsin(radius / away))
    outside, right, down = axis - half - 0.12, np.cos(axis + half), np.sin(axis + half)

    def ray(angle: float, length: float, color: str, dashed: str = "") -> str:
        along = f"M{x:.1f} {y:.1f}l{length * np.cos(angle):.1f} {length * np.sin(angle):.1f}"
        return _path(along, color, 1.6, dashed)

    def arc(reach: float, start: float, end: float, color: str) -> str:
        a, b = (np.array([np.cos(t), np.sin(t)]) * reach for t in (start, end))
        curve = f"A{reach:.0f} {reach:.0f} 0 0 1 {x + b[0]:.1f} {y + b[1]:.1f}"
        return _path(f"M{x + a[0]:.1f} {y + a[1]:.1f}{curve}", color, 1.6)

    def mark(angle: float, reach: float, text: str, color: str, anchor: str = "start") -> str:
        return _text(
            x + reach * np.cos(angle), y + reach * np.sin(angle), text, anchor, color=color
        )

    return [
        f'<circle cx="{ball_x}" cy="{ball_y}" r="{radius}" fill="#e8f3ea" stroke="{GREEN}"/>',
        f'<circle cx="{ball_x}" cy="{ball_y}" r="2.5" fill="#333"/>',
        f'<circle cx="{x}" cy="{y}" r="3.5" fill="#333"/>',
        ray(axis, away, "#333"),
        ray(axis - half, 300, GREEN),
        ray(axis + half, 300, GREEN),
        ray(outside, 290, RED, "5 3"),
        arc(96, axis - half, axis, GREEN),
        arc(210, outside, axis - half, RED),
        mark(axis - half / 2, 102, "α", GREEN),
        mark(outside - 0.06, 190, "v, outline point", RED, "end"),
        mark(outside + 0.05, 215, "r / g", RED),
        mark(axis + 0.1, 150, "u", "#333"),
        _text(ball_x + 6, ball_y + 14, "c"),
        _text(ball_x + 8, ball_y + 42, "R", color=GREEN),
        _path(f"M{ball_x} {ball_y}l{-down * radius:.1f} {right * radius:.1f}", GREEN, 1.2),
        _text(x - 4, y + 20, "camera"),
        _text(left, top - 18, "the residual of one outline point", weight="bold"),
    ]


def outline() -> str:
    """What a camera shows across an edge, what is predicted of it, and both all round a ball."""
    scene = webcam_scene()
    camera, renderer = scene.camera("cam0"), Renderer(scene, "cam0")
    shown = [(renderer.picture(t, k), _cones(scene, camera, t)) for k, t in enumerate((0.0, 0.4))]
    appearance = _estimated(camera, shown)
    patch = _patch(camera, shown[0][0], shown[0][1][0])
    found = find_edge_pairs(grouped_inputs(patch, appearance))
    edges = corrected_edges(found, appearance.correction_weight)
    bias = np.repeat(found.predicted[1], RAYS // found.predicted.shape[1])
    typical = int(np.nanargmin(np.abs(bias - np.nanmedian(bias))))
    middle = [float(np.nanmedian(some)) for some in (found.at[1], bias, edges.shifts)]
    said = "half level {:.2f} px, predicted {:.2f} px, corrected {:.2f} px".format(*middle)
    print(f"outside the true outline, median of {RAYS} rays: {said}")
    return _figure(
        760, 310, [*_profile(patch, appearance, typical), *_all_round(patch, found, edges)]
    )


def _cones(scene: Scene, camera: Camera, time_s: float) -> list[Cone]:
    """Outlines of the balls where the scene has them."""
    pose = scene.trajectory.at(np.array([time_s]))[0]
    centers = [camera.camera_from_world.apply(pose.apply(b.center_mm)) for b in scene.body.balls]
    cones = [tangent_cone(c, b.radius_mm) for c, b in zip(centers, scene.body.balls, strict=True)]
    return [
        (cone.axis, cone.half_angle, float(np.linalg.norm(center)))
        for cone, center in zip(cones, centers, strict=True)
    ]


def _estimated(camera: Camera, shown: Sequence[tuple[Bytes, list[Cone]]]) -> Appearance:
    """A camera's appearance after eight pictures: two, again and again."""
    turned = camera.world_from_camera.rotation
    calibration = SelfCalibration(camera.intrinsics.row, turned, RAYS, MARGIN_PX)
    now = first_appearance("srgb")
    for number in range(8):
        pixels, cones = shown[number % len(shown)]
        if calibration.wants_image(len(cones), float(number)):
            estimation = calibration.add_image(pixels, cones, [], now)
            now = now if estimation is None else estimation()
    return now


def _patch(camera: Camera, pixels: Bytes, cone: Cone) -> BallPatch:
    """A ball with the rays across its true outline."""
    axis, half_angle, distance = cone
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, RAYS, camera.intrinsics.row)
    behind = np.empty((8, 0))
    px = float(np.mean(scale))
    return BallPatch(pixels, rays, half_angle, px, frame, behind, distance)


def _share(values: Floats) -> Floats:
    """Colours (3, m) along a ray as shares of the way from outside (0) to inside (1)."""
    ends = [
        np.median(values[:, (low <= LATER_STEPS) & (high >= LATER_STEPS)], axis=1)
        for low, high in (OUTSIDE_PX, INSIDE_PX)
    ]
    rise = ends[1] - ends[0]
    return np.asarray(rise @ (values - ends[0][:, None]) / (rise @ rise))


def _crossing(share: Floats) -> float:
    """Where shares fall through one half, nearest to the true outline."""
    falls = np.flatnonzero((share[:-1] > 0.5) & (share[1:] <= 0.5))
    at = LATER_STEPS[falls] + (share[falls] - 0.5) / (share[falls] - share[falls + 1])
    return float(at[np.argmin(np.abs(at))])


def _profile(patch: BallPatch, appearance: Appearance, ray: int) -> list[str]:
    """The ray whose bias is the median one: picture, prediction and their half levels."""
    seen, predicted = compare(prediction_inputs(patch, appearance))
    panel = Panel(50, 40, 310, 220, (-7, 6), (-0.2, 1.4))
    out = panel.axes(
        "across one edge: 1 inside, 0 outside", range(-6, 7, 2), (0, 0.5, 1), "px outside the truth"
    )
    steps = list(LATER_STEPS)
    out.append(panel.line((0, 0), panel.y, GREEN, "5 3"))
    out.append(_text(panel.at(0.15, 1.3)[0], panel.at(0.15, 1.3)[1], "true edge", color=GREEN))
    for values, color in ((seen, "#333"), (predicted, BLUE)):
        share = _share(values[:, :, ray])
        drawn = panel.dots if color == "#333" else panel.line
        out.append(drawn(steps, share, color))
        reach = 0.25 if color == "#333" else 0.14
        out.append(panel.line((_crossing(share),) * 2, (0.5 - reach, 0.5 + reach), color))
    rows = (("#333", "picture"), (BLUE, "predicted picture"), (GREY, "bars: half levels"))
    out += _legend(225, 90, rows)
    return out


def _all_round(patch: BallPatch, found: EdgePairs, edges: Edges) -> list[str]:
    """Crossings in picture and prediction, and corrected edges, by direction in the picture."""
    panel = Panel(430, 40, 310, 220, (0, 360), (-3, 1))
    title = "half level outside the true outline, px"
    unit = "direction, deg (0 right, 90 down)"
    out = panel.axes(title, range(0, 361, 90), (-3, -2, -1, 0, 1), unit)
    turn = np.degrees(np.arctan2(patch.rays.normals[:, 1], patch.rays.normals[:, 0])) % 360
    together = RAYS // found.predicted.shape[1]
    order = np.argsort(turn)
    out.append(panel.dots(turn, found.at[1], "#333"))
    out.append(panel.line(turn[order], np.repeat(found.predicted[1], together)[order], BLUE))
    out.append(panel.dots(turn, edges.shifts, GREEN, 2.5))
    rows = (("#333", "in the picture"), (BLUE, "in the predicted picture"), (GREEN, "corrected"))
    return out + _legend(440, 224, rows)


def _legend(x: float, y: float, rows: Iterable[tuple[str, str]]) -> list[str]:
    return [_text(x, y + 15 * i, f"● {text}", color=color) for i, (color, text) in enumerate(rows)]


if __name__ == "__main__":
    main()
