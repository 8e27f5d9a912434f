"""Systematic errors of edges: `python -m benchmarks.residuals SESSION TRUTH OUT.svg`.

Measures the session and draws, for each camera and ball, how far outside the true outline its
edges lie, by the direction in the picture in which they lie from the ball's centre: median over the
frame sets, and the middle half of them. Prints per camera and ball what that does to the centre.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from measure.api import load_profile, measure_session
from measure.arrays import Floats
from measure.host import Registry
from measure.model import Camera, Detection
from measure.session import Session, Trajectory, open_session, read_trajectory

BIN_DEG = 15
_WIDE, _HIGH, _GAP = 300.0, 150.0, 46.0
_REACH_PX = 1.2
_COLORS = {
    "green": "#2a8c3c",
    "yellow": "#d8a800",
    "red": "#c8322d",
    "blue": "#2a5ec8",
    "orange": "#e07b1a",
    "purple": "#7d3cb5",
    "white": "#888888",
}

Views = dict[tuple[str, str], Floats]
"""By camera and ball: direction in deg (right 0, up 90) and px outside the true outline (n, 2)."""


def main() -> None:
    """Print a row per camera and ball; draw."""
    parser = argparse.ArgumentParser(prog="benchmarks.residuals", description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("out", type=Path, help="SVG to write")
    given = parser.parse_args()
    with open_session(given.session) as session:
        views = edge_errors(session, read_trajectory(given.truth))
    print(f"{'camera':8}{'ball':8}{'right px':>9}{'up px':>9}{'larger px':>10}")
    for (camera, ball), rows in sorted(views.items()):
        right, up, larger = _shift(rows)
        print(f"{camera:8}{ball:8}{right:9.3f}{up:9.3f}{larger:10.3f}")
    given.out.write_text(drawn(views), encoding="utf-8")


def edge_errors(session: Session, truth: Trajectory) -> Views:
    """Measure a session with the precise profile; errors of all edges it uses."""
    profile, registry = load_profile("precise"), Registry.discover()
    found: dict[tuple[str, str], list[Floats]] = defaultdict(list)
    for _, one in measure_session(session, profile, registry):
        for view in one.views:
            if view.effective and view.detection is not None:
                place = truth.at(np.array([view.detection.time_s]))[0]
                ball = session.body.balls[session.body.index(view.ball)]
                center, camera = place.apply(ball.center_mm), session.camera(view.camera)
                rows = _outside(view.detection, camera, center, ball.radius_mm)
                found[view.camera, view.ball].append(rows)
    return {key: np.concatenate(rows) for key, rows in found.items()}


def _outside(detection: Detection, camera: Camera, center: Floats, radius_mm: float) -> Floats:
    assert detection.outline_px is not None
    rays = camera.intrinsics.unproject(detection.outline_px)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = camera.camera_from_world.apply(center[None])[0]
    distance = np.linalg.norm(seen)
    beyond = np.arccos(rays @ seen / distance) - np.arcsin(radius_mm / distance)
    away = detection.outline_px - camera.project(center[None])[0]
    direction = np.degrees(np.arctan2(-away[:, 1], away[:, 0])) % 360
    return np.column_stack([direction, beyond * camera.intrinsics.focal_px])


def _shift(rows: Floats) -> Floats:
    """Least-squares shift to the right and up, and growth, of an outline with these errors."""
    turn = np.radians(rows[:, 0])
    design = np.column_stack([np.cos(turn), np.sin(turn), np.ones(len(turn))])
    return np.asarray(np.linalg.lstsq(design, rows[:, 1], rcond=None)[0])


def drawn(views: Views) -> str:
    """An SVG: a panel per camera, a line per ball."""
    cameras = sorted({camera for camera, _ in views})
    panels = [
        _panel({ball: v for (c, ball), v in sorted(views.items()) if c == camera}, camera, i)
        for i, camera in enumerate(cameras)
    ]
    rows = (len(cameras) + 1) // 2
    width, height = 2 * _WIDE + 3 * _GAP, rows * (_HIGH + _GAP) + _GAP
    style = "font:12px sans-serif;background:#fff"
    size = f'viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" height="{height:.0f}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} style="{style}">'
    ground = '<rect width="100%" height="100%" fill="#fff"/>'
    return "\n".join([head, ground, *panels, "</svg>"]) + "\n"


def _panel(balls: dict[str, Floats], camera: str, i: int) -> str:
    left, top = _GAP + (i % 2) * (_WIDE + _GAP), _GAP + (i // 2) * (_HIGH + _GAP)
    parts = [f'<g transform="translate({left:.0f},{top:.0f})">']
    parts.append(f'<text x="0" y="-8">{camera}: edge outside the true outline, px</text>')
    for level in (-1.0, -0.5, 0.0, 0.5, 1.0):
        y, color = _y(level), "#777" if level == 0 else "#ddd"
        parts.append(f'<path d="M0 {y:.1f}H{_WIDE:.0f}" stroke="{color}"/>')
        parts.append(f'<text x="-6" y="{y + 4:.1f}" text-anchor="end">{level:g}</text>')
    for angle, word in ((0, "right"), (90, "up"), (180, "left"), (270, "down"), (360, "right")):
        x = angle / 360 * _WIDE
        parts.append(f'<text x="{x:.0f}" y="{_HIGH + 14:.0f}" text-anchor="middle">{word}</text>')
    parts += [_line(ball, rows) for ball, rows in balls.items()]
    return "\n".join([*parts, "</g>"])


def _line(ball: str, rows: Floats) -> str:
    """The median along the outline, and bars over the middle half."""
    color, pen, parts = _COLORS.get(ball, "#333"), "M", []
    path = ""
    for low in range(0, 360, BIN_DEG):
        here = rows[(rows[:, 0] >= low) & (rows[:, 0] < low + BIN_DEG), 1]
        if len(here) < 8:
            pen = "M"
            continue
        x, quarters = (low + BIN_DEG / 2) / 360 * _WIDE, np.quantile(here, [0.25, 0.5, 0.75])
        a, b, c = (_y(float(value)) for value in quarters)
        path += f"{pen}{x:.1f} {b:.1f}"
        parts.append(f'<path d="M{x:.1f} {a:.1f}V{c:.1f}" stroke="{color}" stroke-opacity=".5"/>')
        pen = "L"
    return "\n".join([*parts, f'<path d="{path}" stroke="{color}" fill="none" stroke-width="2"/>'])


def _y(value: float) -> float:
    return _HIGH / 2 * (1 - float(np.clip(value / _REACH_PX, -1, 1)))


if __name__ == "__main__":
    run_command(main)
