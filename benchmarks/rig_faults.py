"""Faults of a rig, each at up to three strengths, made in a copy of a recording that is right."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from measure.arrays import Bytes
from measure.geometry import RigidTransform
from measure.model import Camera
from measure.session import Calibration, read_body, read_calibration, write_body, write_calibration

SLIGHT, CLEAR, GROSS = "slight", "clear", "gross"
Change = Callable[[Path], None]
"""What is done to a copy of a recording."""


@dataclass(frozen=True)
class Fault:
    """One fault of one strength."""

    name: str
    strength: str  # `SLIGHT`: just above what matters; `CLEAR`; `GROSS`
    causes: tuple[str, ...]  # any of these words is right
    of: str  # the camera or ball to be named; empty if any
    change: Change
    also: tuple[str, ...] = ()  # words that are to be named beside, of pairs of faults


def calibration(change: Callable[[Camera], Camera], *names: str) -> Change:
    """Change the calibration of some cameras, or of all."""

    def changed(folder: Path) -> None:
        path = folder / "calibration.toml"
        given = read_calibration(path)
        cameras = [change(c) if c.name in names or not names else c for c in given.cameras]
        write_calibration(path, Calibration(tuple(cameras), given.provenance))

    return changed


def turned(degrees: float, axis: int) -> Callable[[Camera], Camera]:
    """About an axis of the camera itself."""
    turn = np.zeros(3)
    turn[axis] = np.radians(degrees)

    def change(camera: Camera) -> Camera:
        pose = camera.world_from_camera
        return replace(camera, world_from_camera=pose.perturb([0, 0, 0, *pose.rotate(turn)]))

    return change


def pushed(x_mm: float) -> Callable[[Camera], Camera]:
    """Along its own horizontal axis."""

    def change(camera: Camera) -> Camera:
        pose = camera.world_from_camera
        step = pose.rotate(np.array([x_mm, 0.0, 0.0]))
        return replace(camera, world_from_camera=pose.perturb([*step, 0, 0, 0]))

    return change


def scaled(factor: float) -> Callable[[Camera], Camera]:
    """The whole world, as a wrong square of the board scales it."""
    return lambda c: replace(
        c,
        world_from_camera=RigidTransform(
            c.world_from_camera.rotation, factor * c.world_from_camera.translation
        ),
    )


def lens(focal: float = 1.0, right_px: float = 0.0) -> Callable[[Camera], Camera]:
    """Another focal length and principal point."""
    by = np.array([[focal, focal, 1], [1, focal, 1], [1, 1, 1]])

    def change(camera: Camera) -> Camera:
        matrix = camera.intrinsics.matrix * by
        matrix[0, 2] += right_px
        return replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))

    return change


def exchanged_calibrations(a: str, b: str) -> Change:
    """Each has the calibration of the other."""

    def changed(folder: Path) -> None:
        path = folder / "calibration.toml"
        names = {a: b, b: a}
        cameras = [
            replace(c, name=names.get(c.name, c.name)) for c in read_calibration(path).cameras
        ]
        write_calibration(path, Calibration(tuple(cameras)))

    return changed


def stamps(camera: str, late: Callable[[int, float], float]) -> Change:
    """Other stamps, of frame numbers and stamps."""

    def changed(folder: Path) -> None:
        path = folder / f"{camera}.csv"
        head, *rows = path.read_text().split()
        pairs = [row.split(",") for row in rows]
        lines = [f"{n},{late(int(n), float(t)):.9f}" for n, t in pairs]
        path.write_text("\n".join([head, *lines]) + "\n")

    return changed


def pictures(change: Callable[[list[Bytes], int], Bytes], *names: str) -> Change:
    """Change the pictures of some cameras, or of all, by their list and place in it."""

    def changed(folder: Path) -> None:
        for where in sorted(p for p in folder.iterdir() if p.is_dir()):
            if names and where.name not in names:
                continue
            paths = sorted(where.glob("*.jpg"))
            images = [np.asarray(cv2.imread(str(path)), np.uint8) for path in paths]
            for place, path in enumerate(paths):
                new = np.clip(change(images, place), 0, 255).astype(np.uint8)
                cv2.imwrite(str(path), new, [cv2.IMWRITE_JPEG_QUALITY, 95])

    return changed


def warped(image: Bytes, scale: float = 1.0, right_px: float = 0.0, down_px: float = 0.0) -> Bytes:
    """Enlarged about its middle and moved."""
    height, width = image.shape[:2]
    middle = (1 - scale) * (np.array([width, height]) - 1) / 2
    by = np.array([[scale, 0, middle[0] + right_px], [0, scale, middle[1] + down_px]], np.float32)
    return np.asarray(cv2.warpAffine(image, by, (width, height), flags=cv2.INTER_CUBIC), np.uint8)


def woven(images: list[Bytes], place: int) -> Bytes:
    """Every other line is of the next picture."""
    out = images[place].copy()
    out[1::2] = images[min(place + 1, len(images) - 1)][1::2]
    return out


def body(**changes: Callable[[np.ndarray, float], tuple[np.ndarray, float]]) -> Change:
    """Change place and radius of balls, by name; `every` for all."""

    def changed(folder: Path) -> None:
        path = folder / "body.toml"
        given = read_body(path)
        balls = []
        for ball in given.balls:
            change = changes.get(ball.name, changes.get("every"))
            if change is not None:
                place, radius = change(ball.center_mm, ball.radius_mm)
                ball = replace(ball, center_mm=place, radius_mm=radius)
            balls.append(ball)
        write_body(path, replace(given, balls=tuple(balls)))

    return changed


def _exchanged_balls(folder: Path) -> None:
    path = folder / "body.toml"
    given = read_body(path)
    first, second, *others = given.balls
    balls = (
        replace(first, center_mm=second.center_mm),
        replace(second, center_mm=first.center_mm),
        *others,
    )
    write_body(path, replace(given, balls=balls))


def _same_pictures(folder: Path) -> None:
    shutil.rmtree(folder / "cam1")
    shutil.copytree(folder / "cam0", folder / "cam1")


def _exchanged_folders(folder: Path) -> None:
    (folder / "cam0").rename(folder / "x")
    (folder / "cam1").rename(folder / "cam0")
    (folder / "x").rename(folder / "cam1")


def kept_cameras(*names: str) -> Change:
    """Some cameras alone."""

    def changed(folder: Path) -> None:
        path = folder / "session.toml"
        head, *tables = path.read_text().split("[[cameras]]")
        kept = [table for table in tables if any(f'"{name}"' in table for name in names)]
        path.write_text("[[cameras]]".join([head, *kept]))
        for pictures in folder.glob("*/"):
            if pictures.name not in names:
                shutil.rmtree(pictures)

    return changed


def copied(source: Path, folder: Path) -> None:
    """Copy a recording into a folder that is not there yet, so that it may be changed."""
    shutil.copytree(source, folder, copy_function=shutil.copyfile)
    for where in (folder, *filter(Path.is_dir, folder.iterdir())):
        where.chmod(0o755)


def both(*changes: Change) -> Change:
    """One after the other."""

    def changed(folder: Path) -> None:
        for change in changes:
            change(folder)

    return changed


def encoded(codec: str, crf: int) -> Change:
    """Each camera's pictures as a video with half as many colours as pixels."""

    def changed(folder: Path) -> None:
        path = folder / "session.toml"
        text = path.read_text()
        for where in sorted(one for one in folder.iterdir() if one.is_dir()):
            files = sorted(where.glob("*.jpg"))
            images = [np.asarray(cv2.imread(str(file)), np.uint8) for file in files]
            with av.open(str(folder / f"{where.name}.mp4"), "w") as video:
                how = {"crf": str(crf), "preset": "veryfast", "x265-params": "log-level=none"}
                if codec != "libx265":
                    del how["x265-params"]
                stream = video.add_stream(codec, rate=30, options=how)
                stream.height, stream.width = images[0].shape[:2]
                stream.pix_fmt = "yuv420p"
                for image in images:
                    video.mux(stream.encode(av.VideoFrame.from_ndarray(image, "bgr24")))
                video.mux(stream.encode(None))
            shown = f'images = "{where.name}/*.jpg"'
            text = text.replace(shown, f'video = "{where.name}.mp4"')
        path.write_text(text)

    return changed


def grainy(levels: float, seed: int) -> Change:
    """Noise of so many levels, another in each picture."""
    rng = np.random.default_rng(seed)

    def changed(images: list[Bytes], place: int) -> Bytes:
        noisy = images[place] + rng.normal(0, levels, images[place].shape)
        return np.clip(noisy, 0, 255).astype(np.uint8)

    return pictures(changed)


def _from_the_middle(change: Callable[[Bytes], Bytes]) -> Callable[[list[Bytes], int], Bytes]:
    return lambda images, k: change(images[k]) if k >= len(images) // 2 else images[k]


def faults() -> Iterator[Fault]:
    """Every fault at every strength."""
    scale, square = ("scale", "board-square"), ("moved", "principal-point")
    strengths = (SLIGHT, CLEAR, GROSS)

    def each(
        name: str,
        causes: tuple[str, ...],
        of: str,
        make: Callable[[Any], Change],
        *amounts: float,
        of_strengths: Sequence[str] = strengths,
    ) -> Iterator[Fault]:
        for strength, amount in zip(of_strengths, amounts, strict=False):
            yield Fault(f"{name} {amount:g}", strength, causes, of, make(amount))

    two = (CLEAR, GROSS)

    def late(name: str) -> Callable[[float], Change]:
        return lambda s: stamps(name, lambda _, t: t + s)

    yield from each("clock s", ("clock",), "cam1", late("cam1"), 0.008, 0.03, 0.15)
    yield from each("clock s of cam2", ("clock",), "cam2", late("cam2"), -0.012, -0.05, -0.2)
    step = lambda s: stamps("cam1", lambda n, t: t + s * (n >= 15))  # noqa: E731
    yield from each("clock step s", ("clock-step",), "cam1", step, 0.0334, 0.1, 0.4)
    for name, axis in (("cam1", 1), ("cam2", 0)):
        make = lambda d, n=name, a=axis: calibration(turned(d, a), n)  # noqa: E731
        yield from each(f"turned deg {name}", ("moved",), name, make, 0.1, 0.3, 1.0)
    push = lambda mm: calibration(pushed(mm), "cam3")  # noqa: E731
    yield from each("pushed mm", ("moved",), "cam3", push, 1.0, 4.0, 14.0)
    knock = lambda px: pictures(_from_the_middle(lambda i: warped(i, 1, px)), "cam2")  # noqa: E731
    yield from each("moved at px", ("moved-at",), "cam2", knock, 2.0, 5.0, 12.0)
    one = lambda f: calibration(lens(f), "cam1")  # noqa: E731
    yield from each("zoom one", ("zoom",), "cam1", one, 0.99, 1.04, 0.8)
    yield from each("zoom all", ("zoom",), "", lambda f: calibration(lens(f)), 1.01, 0.96, 1.25)
    digital = lambda f: pictures(lambda im, k: warped(im[k], f), "cam1")  # noqa: E731
    yield from each("digital zoom", ("zoom",), "cam1", digital, 1.05, 1.25, of_strengths=two)
    digital = lambda f: pictures(lambda im, k: warped(im[k], f))  # noqa: E731
    yield from each("digital zoom all", ("zoom",), "", digital, 1.05, 1.25, of_strengths=two)
    focus = lambda f: pictures(_from_the_middle(lambda i: warped(i, f)), "cam1")  # noqa: E731
    yield from each("zoom at", ("zoom",), "cam1", focus, 1.01, 1.04, of_strengths=two)
    point = lambda px: calibration(lens(right_px=px), "cam2")  # noqa: E731
    yield from each("principal point px", square, "cam2", point, 3.0, 10.0, 30.0)
    world = lambda f: calibration(scaled(f))  # noqa: E731
    yield from each("scale", scale, "", world, 1.004, 0.97, 1.25)
    yield from each("board square 27 for 25", scale, "", world, 25 / 27, of_strengths=(GROSS,))
    larger = lambda f: body(every=lambda c, r: (c, f * r))  # noqa: E731
    yield from each("radii", ("radius",), "", larger, 1.03, 0.95, 0.85)
    other = lambda mm: body(green=lambda c, r: (c, r + mm))  # noqa: E731
    yield from each("radius mm", ("radius",), "green", other, 0.7, -1.5, 3.0)
    place = lambda mm: body(yellow=lambda c, r: (c + np.array([0, mm, 0]), r))  # noqa: E731
    yield from each("ball place mm", ("ball-place",), "yellow", place, 0.5, 2.0, 6.0)

    def flip(*names: str) -> Change:
        return pictures(lambda im, k: im[k][:, ::-1], *names)

    yield Fault("mirrored", GROSS, ("mirrored",), "cam1", flip("cam1"))
    yield Fault("mirrored all", GROSS, ("mirrored",), "", flip())
    yield Fault("balls exchanged", GROSS, ("exchanged-balls",), "", _exchanged_balls)
    yield Fault("folders exchanged", GROSS, ("exchanged-cameras",), "", _exchanged_folders)
    swap = exchanged_calibrations("cam1", "cam3")
    yield Fault("calibrations exchanged", GROSS, ("exchanged-cameras",), "", swap)
    rgb = lambda im, k: im[k][:, :, ::-1]  # noqa: E731
    yield Fault("red and blue", GROSS, ("exchanged-channels",), "", pictures(rgb))
    yield Fault(
        "red and blue of one", GROSS, ("exchanged-channels",), "cam2", pictures(rgb, "cam2")
    )
    yield Fault("same pictures", GROSS, ("same-pictures",), "cam1", _same_pictures)
    yield Fault("interlaced", CLEAR, ("interlaced",), "", pictures(woven))
    yield Fault("interlaced one", CLEAR, ("interlaced",), "cam1", pictures(woven, "cam1"))
    bursts = stamps("cam1", lambda n, t: t + (5 - n % 6) / 30 + 0.0003 * (n % 6))
    yield Fault("bursts of six", CLEAR, ("clock",), "cam1", bursts)
    rate = stamps("cam1", lambda _, t: 1.2 * t)
    yield Fault("25 for 30 a second", CLEAR, ("clock",), "cam1", rate)
    for name in ("cam1", "cam2"):
        pair = both(calibration(pushed(14.0), name), kept_cameras("cam0", name))
        yield Fault(f"one of two, {name} 14 mm", CLEAR, ("moved",), "", pair)
    shake = np.cumsum(np.random.default_rng(3).normal(0, 1.2, (400, 2)), 0)
    stabilised = pictures(lambda im, k: warped(im[k], 1.0, *shake[k]), "cam1")
    yield Fault("stabilised", GROSS, ("unknown",), "cam1", stabilised)


def healthy() -> Iterator[Fault]:
    """Recordings that are right, and small departures that are none."""
    yield Fault("as it is", "", (), "", lambda _: None)
    for first in (0, 6, 12):
        yield Fault(f"from frame {first}", "", (), "", cut(first, first + 14))
    for quality in (80, 60):
        yield Fault(f"JPEG quality {quality}", "", (), "", squeezed(quality))
    noise = np.random.default_rng(1).normal(0, 3, (720, 1280, 3))
    grain = lambda im, k: im[k] + np.roll(noise, 37 * k, axis=1)[: len(im[k]), : im[k].shape[1]]  # noqa: E731
    yield Fault("grain", "", (), "", pictures(grain))
    yield Fault("H.264", "", (), "", encoded("libx264", 20))
    yield Fault("dim", "", (), "", pictures(lambda im, k: np.asarray(0.7 * im[k], np.uint8)))
    yield Fault("blur", "", (), "", pictures(_blurred))


def _blurred(images: list[Bytes], place: int) -> Bytes:
    return np.asarray(cv2.GaussianBlur(images[place], (0, 0), 1.0), np.uint8)


def squeezed(quality: int) -> Change:
    """JPEG of such a quality, once more."""

    def changed(folder: Path) -> None:
        for path in folder.glob("*/*.jpg"):
            image = np.asarray(cv2.imread(str(path)), np.uint8)
            cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, quality])

    return changed


def cut(first: int, last: int) -> Change:
    """The pictures from one up to another."""

    def changed(folder: Path) -> None:
        for table in folder.glob("*.csv"):
            if not (folder / table.stem).is_dir():
                continue
            head, *rows = table.read_text().split()
            paths = sorted((folder / table.stem).glob("*.jpg"))
            for k, path in enumerate(paths):
                if not first <= k < last:
                    path.unlink()
            table.write_text("\n".join([head, *rows[first:last]]) + "\n")

    return changed
