"""Marks in pictures: clicked, refined to a fraction of a pixel, and written for `calibrate`."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import dist
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np

from measure.api.detecting import PATCH_PX, detect
from measure.api.folders import inside, named_pictures, pictures_of, write_named
from measure.api.profiles import load_profile
from measure.arrays import Bytes, Floats
from measure.calibration import open_capture, patterns
from measure.calibration.board_views import board_pose
from measure.calibration.boards import MIN_MARKS, aruco_dictionary, mapped
from measure.calibration.markers import find_markers
from measure.calibration.procedure import check_calibrated
from measure.calibration.targets import MarkerField, kind_of, read_markers
from measure.errors import CalibrationError, ConfigError
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model import Body, Camera, Intrinsics, paper_body
from measure.session import dump_toml, open_session, read_body, read_calibration

MarkKind = Literal["dot", "cross", "corner", "as clicked"]
MARK_KINDS: tuple[MarkKind, ...] = get_args(MarkKind)
TAG_FAMILIES = ("APRILTAG_36H11", "4X4_100", "5X5_100", "6X6_250")
_CAPTURE = "capture.toml"
_ONE_PX = 1.0  # Marks nearer to each other than this are of one marker, clicked twice
_REACH_PX = 25.0  # How far from a click the middle of what is meant may be


@dataclass(frozen=True)
class Mark:
    """A marker's place in a picture."""

    center_px: tuple[float, float]
    radius_px: float = 0.0  # of the outline that was fitted; 0 without one
    refined: bool = True  # whether a pattern was fitted; else it lies where it was clicked


def refined_mark(
    pixels: Bytes, at_px: tuple[float, float], kind: MarkKind, lens: Intrinsics
) -> Mark | None:
    """The pattern nearest to a place in a picture, BGR (h, w, 3), as `calibrate` fits it.

    Dots and crosses are fitted as those of `marker_image`; a corner is that of two edges
    (`cv2.cornerSubPix`). None if there is nothing of that kind.
    """
    at = np.array(at_px)
    if kind == "corner":
        gray = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
        corner = at.astype(np.float32).reshape(1, 1, 2)
        end = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3
        size = PATCH_PX, PATCH_PX
        found = cv2.cornerSubPix(gray, corner.copy(), size, (-1, -1), end)
        place = np.asarray(found, np.float64).ravel()
        moved = bool(np.any(place != corner.ravel()))
        return _mark(place) if moved and np.linalg.norm(place - at) < PATCH_PX else None
    if kind == "as clicked":
        return None
    light = patterns.linear_light(pixels)
    search = patterns.dot_candidates if kind == "dot" else patterns.cross_candidates
    near = {float(np.linalg.norm(one.center_px - at)): one for one in search(light)}
    if not near or min(near) > _REACH_PX:
        return None
    match near[min(near)]:
        case patterns.Dot() as spot:
            dot = patterns.refine_dot(light, spot, patterns.outline_shape(lens, spot.center_px))
            return None if dot is None else _mark(dot.center_px, dot.radius_px)
        case bars:
            cross = patterns.refine_cross(light, bars)
            return None if cross is None else _mark(cross.center_px)


def found_tags(pixels: Bytes, family: str) -> dict[str, Mark]:
    """Middles of the ArUco or AprilTag markers in a picture, by number (see `TAG_FAMILIES`)."""
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(f"DICT_{family}"), options)
    corners, ids, _ = detector.detectMarkers(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    found = {}
    for number, at in () if ids is None else zip(ids.ravel(), corners, strict=True):
        # The middle under perspective, where the diagonals cross.
        seen = np.asarray(at, np.float64).reshape(4, 2)
        found[str(number)] = _mark(mapped(square, seen, np.array([[0.5, 0.5]]))[0])
    return found


def _mark(place: Floats, radius_px: float = 0.0) -> Mark:
    return Mark((float(place[0]), float(place[1])), radius_px)


def begin_marks(out: Path, source: Path, calibration: Path, markers: Path | None = None) -> Marking:
    """Make a capture folder of one picture a camera, of cameras whose lenses are calibrated.

    Args:
        out: the folder; the pictures may lie in it already.
        source: a folder with pictures that are named like the cameras (cam0.png), or a recorded
            session: its first ones are taken.
        calibration: gives the lenses.
        markers: a table or a target file with their places, or a body that lies in the origin.
    """
    if (out / _CAPTURE).exists():
        raise ConfigError(f"{out}: holds a capture already: give a new folder")
    field = MarkerField() if markers is None else _markers_in(markers)
    if (source / "session.toml").is_file():
        with open_session(source, calibration, paper_body()) as session:
            first = next(session.frame_sets()).images
            pictures = {name: image.pixels for name, image in first.items()}
    else:
        pictures = named_pictures(source, [c.name for c in read_calibration(calibration).cameras])
    out.mkdir(parents=True, exist_ok=True)
    for name, pixels in pictures.items():
        write_named(out, name, pixels)
    shutil.copyfile(calibration, out / "lenses.toml")
    about: dict[str, object] = {"name": out.resolve().name}
    about["marker_tolerance_mm"] = field.tolerance_mm
    tables = [{"name": name, "calibration": "lenses.toml"} for name in pictures]
    (out / _CAPTURE).write_text(dump_toml({"capture": about, "cameras": tables}), "utf-8")
    begun = Marking(out)
    begun.points = dict(zip(field.names, field.points, strict=True))
    return begun


def _markers_in(file: Path) -> MarkerField:
    if file.suffix == ".toml" and kind_of(file) == "body":
        body = read_body(file)
        return MarkerField(body.names, body.centers, body.tolerance_mm or 0.1)
    return read_markers(file)


class Marking:
    """A capture folder whose markers are being marked.

    Attributes:
        folder: of the capture.
        pictures: what is marked, by camera: its marker picture, or that of the board, or a file
            that is named like the camera.
        points: places of markers in the world (3,), mm, by name.
        marks: by camera and marker.
    """

    def __init__(self, folder: Path, lenses: Path | None = None) -> None:
        """Open a capture; `lenses` is a calibration of lenses that the capture does not know.

        CalibrationError if one is not known to either, or a picture is missing or of another size.
        """
        opened = self._opened = open_capture(folder)
        self._lenses = dict(opened.lenses)
        for one in read_calibration(lenses).cameras if lenses else ():
            self._lenses.setdefault(one.name, one.intrinsics)
        self.folder, self.pictures = opened.path.parent, dict[str, Path]()
        for camera in opened.cameras:
            own = pictures_of(self.folder, camera.name)
            file = camera.marker_image or camera.board_image or next(iter(own), None)
            if camera.name not in self._lenses or file is None:
                lacks = "a picture" if file is None else "a calibration that knows its lens"
                raise CalibrationError(f"{opened.path}: camera {camera.name} needs {lacks}")
            self.pictures[camera.name] = self.folder / file
            self._pixels(camera.name)
        self.points = dict(zip(opened.markers.names, opened.markers.points, strict=True))
        self.marks = {
            name: {marker: _mark(at) for marker, at in opened.marks.get(name, {}).items()}
            for name in self.pictures
        }

    def place(self, name: str, text: str) -> None:
        """Know where a marker is in the world: x, y, z in mm, as it is typed."""
        with suppress(ValueError):
            at = np.array([float(number) for number in text.replace(",", " ").split()])
            if name.strip() and at.shape == (3,) and np.isfinite(at).all():
                self.points[name] = at
                return
        raise ConfigError(f"{name or 'marker'}: expected its name, and x, y, z in mm: 120, 35.5, 0")

    def set(self, camera: str, name: str, at_px: tuple[float, float], kind: MarkKind) -> Mark:
        """Mark a marker in a picture; ConfigError where there is none of its kind, or another."""
        if not name.strip():
            raise ConfigError("which marker is it? give its name or number first")
        found = refined_mark(self._pixels(camera), at_px, kind, self._lenses[camera])
        if found is None and kind != "as clicked":
            reach_px = PATCH_PX if kind == "corner" else _REACH_PX
            raise ConfigError(
                f"{camera}: no {kind} within {reach_px:g} px of the click: nothing was marked for "
                f'{name}; click its middle, or choose "as clicked"'
            )
        mark, marks = found or Mark(at_px, refined=False), self.marks[camera]
        for other, there in marks.items():
            if other != name and dist(there.center_px, mark.center_px) < _ONE_PX:
                raise ConfigError(f"{camera}: {other} is there: nothing was marked for {name}")
        marks[name] = mark
        return mark

    def _pixels(self, camera: str) -> Bytes:
        (one,) = (c for c in self._opened.cameras if c.name == camera)
        return self._opened.still(one, str(self.pictures[camera]), self._lenses[camera])

    def propose(
        self,
        camera: str,
        family: str,
        kind: MarkKind = "dot",
        balls: tuple[Body, Registry] | None = None,
    ) -> list[str]:
        """Mark what is found in a picture and is not marked yet; gives the names.

        Numbered tags; a body's balls, at their middles; and, once four marks say about where the
        camera stands, the other markers whose places are known.
        """
        mine, pixels, lens = self.marks[camera], self._pixels(camera), self._lenses[camera]
        found = found_tags(pixels, family)
        if balls is not None:
            body, registry = balls
            known = Camera(camera, lens, RigidTransform.identity())
            (seen,) = detect([self.pictures[camera]], registry, load_profile(), body, known)
            found |= {d.ball: _mark(d.center_px, d.radius_px) for d in reversed(seen.detections)}
        at = {n: np.array(m.center_px) for n, m in (found | mine).items() if n in self.points}
        if len(at) >= MIN_MARKS and kind in ("dot", "cross"):
            field = MarkerField(tuple(self.points), np.stack([*self.points.values()]))
            points = np.stack([self.points[name] for name in at])
            pose = board_pose(lens, points, np.stack([*at.values()])).inverse()
            with suppress(CalibrationError):
                others = find_markers(pixels, Camera(camera, lens, pose), field, kind).marks
                found = {name: _mark(place) for name, place in others.items()} | found
        self.marks[camera] = found | mine
        return [name for name in found if name not in mine]

    def save(self) -> list[str]:
        """Write the marks, and the places of markers; gives the marks left out for want of one.

        Raises:
            CalibrationError: what `calibrate` would refuse; all is written then, too.
        """
        rows = [
            (camera, name, *(f"{x:.4f}" for x in mark.center_px))
            for camera, mine in self.marks.items()
            for name, mark in mine.items()
            if name in self.points
        ]
        if not rows:
            raise ConfigError("no marker is marked whose place in the world is known")
        marks, markers = self._named("marks"), self._named("markers")
        if markers.suffix == ".csv":
            places = [(name, *(f"{x:.6g}" for x in at)) for name, at in self.points.items()]
            _write_table(markers, ("name", "x_mm", "y_mm", "z_mm"), places)
        _write_table(marks, ("camera", "name", "u_px", "v_px"), rows)
        self._opened = open_capture(self.folder)
        check_calibrated(self._opened)
        return sorted({name for mine in self.marks.values() for name in mine} - self.points.keys())

    def _named(self, key: Literal["marks", "markers"]) -> Path:
        """The file of that name; the capture takes it over, if it does not know one.

        ConfigError: the capture, which a stranger may have written, names one outside its folder.
        """
        known: str | None = getattr(self._opened.settings, key)
        if known is None:
            file = self.folder / _CAPTURE
            head, table, rest = file.read_text("utf-8").partition("[capture]")
            file.write_text(f'{head}{table}\n{key} = "{key}.csv"{rest}', "utf-8")
        return inside(self.folder, known or f"{key}.csv")


def _write_table(file: Path, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    with file.open("w", encoding="utf-8", newline="") as to:
        csv.writer(to, lineterminator="\n").writerows([head, *rows])
