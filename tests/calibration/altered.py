"""Altered copies of the rendered capture: what a user may leave out, and what may go wrong."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks.errors import body_cost
from measure.arrays import Bytes, Floats
from measure.geometry import RigidTransform
from measure.model import paper_body
from measure.session import read_calibration

Picture = Callable[[Bytes], Bytes]


class AlteredCapture:
    """A copy of a capture folder whose texts and pictures can be changed.

    The lenses are given (`known.toml`), which spares their calibration; `with_views` takes them
    from board pictures again.
    """

    def __init__(self, source: Path, folder: Path, cameras: Sequence[str]) -> None:
        self.source, self.folder = source, folder
        (folder / "extrinsic").mkdir(parents=True)
        for picture in (source / "extrinsic").glob("*.jpg"):
            (folder / "extrinsic" / picture.name).symlink_to(picture)
        for name in ("board.toml", "markers.csv", "marks.csv"):
            shutil.copy(source / name, folder / name)
        shutil.copy(source / "truth_calibration.toml", folder / "known.toml")
        head, *tables = (source / "capture.toml").read_text().split("[[cameras]]")
        kept = [t for t in tables if any(f'name = "{name}"' in t for name in cameras)]
        self.write("capture.toml", "[[cameras]]".join([head, *kept]))
        self.substitute("capture.toml", r"intrinsics = .*", 'calibration = "known.toml"')
        marked = [r for r in self.lines("marks.csv") if r.split(",")[0] in {"camera", *cameras}]
        self.write("marks.csv", "\n".join(marked) + "\n")

    def lines(self, name: str) -> list[str]:
        return (self.folder / name).read_text().splitlines()

    def write(self, name: str, text: str) -> None:
        (self.folder / name).write_text(text)

    def substitute(self, name: str, pattern: str, by: str) -> None:
        text = (self.folder / name).read_text()
        changed = re.sub(pattern, by, text)
        assert changed != text, f"{pattern} is not in {name}"
        self.write(name, changed)

    def without_hand_marks(self) -> None:
        self.substitute("capture.toml", r"marks = .*\n", "")

    def without_boards(self) -> None:
        self.substitute("capture.toml", r"board(_\w+)? = .*\n", "")

    def without_markers(self) -> None:
        self.substitute("capture.toml", r"(markers|marks|marker_image) = .*\n", "")

    def keep_rows(self, name: str, keep: Callable[[str], bool]) -> None:
        head, *rows = self.lines(name)
        self.write(name, "\n".join([head, *filter(keep, rows)]) + "\n")

    def rename_markers(self, name: str, column: int, names: dict[str, str]) -> None:
        rows = [line.split(",") for line in self.lines(name)]
        for row in rows:
            row[column] = names.get(row[column], row[column])
        self.write(name, "\n".join(",".join(row) for row in rows) + "\n")

    def swap_board_pictures(self, a: str, b: str) -> None:
        pair = [self.folder / "extrinsic" / f"{name}_board.jpg" for name in (a, b)]
        first, second = (path.readlink() for path in pair)
        for path, target in zip(pair, (second, first), strict=True):
            path.unlink()
            path.symlink_to(target)

    def swap_board_poses(self) -> None:
        """Of the first and the last camera."""
        text = (self.folder / "capture.toml").read_text()
        head, *tables = text.split("[[cameras]]")
        pattern = r"board_quat_wxyz = .*\nboard_translation_mm = .*"
        found = [re.search(pattern, table) for table in (tables[0], tables[-1])]
        poses = [match.group(0) for match in found if match is not None]
        tables[0] = tables[0].replace(poses[0], poses[1])
        tables[-1] = tables[-1].replace(poses[1], poses[0])
        self.write("capture.toml", "[[cameras]]".join([head, *tables]))

    def change_picture(self, name: str, change: Picture) -> None:
        path = self.folder / "extrinsic" / name
        picture = cv2.imread(str(path))
        assert picture is not None
        path.unlink()
        cv2.imwrite(str(path), change(np.asarray(picture, np.uint8)))

    def with_views(self, camera: str, pictures: Sequence[Bytes]) -> None:
        """Calibrate the lens from these pictures of the board."""
        (self.folder / "intrinsic").mkdir()
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(self.folder / f"intrinsic/{number:03d}.png"), picture)
        self.substitute("capture.toml", r"calibration = .*", 'intrinsics = "intrinsic/*.png"')

    def view(self, camera: str, number: int) -> Bytes:
        picture = cv2.imread(str(self.source / f"intrinsic/{camera}/{number:03d}.jpg"))
        assert picture is not None
        return np.asarray(picture, np.uint8)


def mirrored(picture: Bytes) -> Bytes:
    return np.asarray(cv2.flip(picture, 1), np.uint8)


MIDDLE = np.array([639.5, 359.5])


def zoomed(zoom: float) -> Picture:
    """So many times as large, about the middle."""

    def change(picture: Bytes) -> Bytes:
        size = (picture.shape[1], picture.shape[0])
        by = np.hstack([zoom * np.eye(2), (1 - zoom) * MIDDLE[:, None]]).astype(np.float32)
        return np.asarray(cv2.warpAffine(picture, by, size, flags=cv2.INTER_CUBIC), np.uint8)

    return change


def turned(degrees: float, axis: int) -> Picture:
    """As seen after the camera turned about its own x (0), y (1) or z (2) axis."""

    def change(picture: Bytes) -> Bytes:
        matrix = np.array([[1420.0, 0, 640], [0, 1420, 360], [0, 0, 1]])
        vector = np.zeros(3)
        vector[axis] = np.deg2rad(degrees)
        H = matrix @ cv2.Rodrigues(vector)[0] @ np.linalg.inv(matrix)
        size = (picture.shape[1], picture.shape[0])
        warped = cv2.warpPerspective(picture, H, size, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(warped, np.uint8)

    return change


def cost_mm(capture: AlteredCapture) -> float:
    """What the written calibration costs the body, in mm."""
    found = read_calibration(capture.folder / "calibration.toml").cameras
    truth = read_calibration(capture.source / "truth_calibration.toml").cameras
    true = tuple(next(c for c in truth if c.name == camera.name) for camera in found)
    middle: Floats = np.array([0.0, 0.0, 250.0])
    rng = np.random.default_rng(0)
    poses = [RigidTransform(np.eye(3), middle + rng.uniform(-40, 40, 3)) for _ in range(10)]
    shifts = body_cost(found, true, paper_body(), poses)
    return float(np.sqrt(np.mean(np.sum(shifts**2, axis=1))))
