"""Faults of drawn kind, amount, camera and ball, of scenes on which nothing was set by hand."""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks import rig_faults as made
from benchmarks.rig_faults import CLEAR, Change, Fault
from measure.arrays import Bytes, Floats
from measure.model import Camera
from measure.session import read_body, read_calibration, write_body
from measure.simulation import Scene
from measure.simulation.catalogue import cloth_room, motion, ring, shaft, stems, webcam_scene
from measure.simulation.scene import MotionLimits
from tests.simulated.catalogue import async_scene, clutter_scene, four_ball_body

SETS, HZ = 30, 30.0


def scenes() -> Iterator[Scene]:
    """Rigs of three to five cameras and bodies of three and four balls; seeds of no other scene."""
    lively = MotionLimits(speed_mm_s=60.0, turn_rad_s=1.0, slowest_hz=0.3, fastest_hz=0.9)
    three, five = ring(3, 5, distance_mm=430.0, elevation_deg=32.0), ring(5, 6, distance_mm=520.0)
    yield replace(webcam_scene(31), name="three", cameras=three)
    yield replace(webcam_scene(32), name="five", cameras=five, trajectory=motion(32, lively))
    yield replace(clutter_scene(33), name="clutter-33")
    body = four_ball_body()
    yield replace(
        webcam_scene(34),
        name="four-balls-34",
        body=body,
        attached=(*stems(body), shaft()),
        backdrop=cloth_room(0.05, 8),
        trajectory=motion(34, lively),
    )
    yield replace(async_scene(35), name="async-35")


@dataclass(frozen=True)
class Draw:
    """What is drawn for one fault."""

    rng: np.random.Generator
    camera: str
    cameras: tuple[str, str]  # two of them, for what is exchanged
    ball: str
    balls: tuple[str, str]
    start: int  # frame from which it holds, if midway

    def amount(self, least: float, most: float) -> float:
        """Of either sign, its logarithm evenly spread."""
        return float(self.rng.choice([-1, 1])) * self.size(least, most)

    def size(self, least: float, most: float) -> float:
        """Its logarithm evenly spread."""
        return float(np.exp(self.rng.uniform(np.log(least), np.log(most))))

    def vector(self, least: float, most: float, axes: int = 3) -> Floats:
        """Of such a length, to any side."""
        way = self.rng.normal(size=axes)
        return np.asarray(way * self.size(least, most) / np.linalg.norm(way))

    def midway(self, change: Callable[[np.ndarray], np.ndarray], *names: str) -> Change:
        """The pictures of cameras from the frame on."""
        return made.pictures(
            lambda images, k: change(images[k]) if k >= self.start else images[k], *names
        )


def drawn(folder: Path, seed: int, forms: bool = False) -> Iterator[Fault]:
    """One fault of each kind, and the recording as it is; in drawn forms, if it is asked for."""
    cameras = [camera.name for camera in read_calibration(folder / "calibration.toml").cameras]
    body = read_body(folder / "body.toml")
    twins = {frozenset(pair) for pair in _alike(body.centers, body.names)}
    yield Fault("as it is", "", (), "", lambda _: None)
    for number, (name, make) in enumerate(KINDS.items()):
        rng = np.random.default_rng([seed, number, zlib.crc32(folder.name.encode())])
        camera, other = (str(one) for one in rng.choice(cameras, 2, replace=False))
        pairs = [p for p in _pairs(body.names) if frozenset(p) not in twins]
        ball, pair = str(rng.choice(body.names)), pairs[int(rng.integers(len(pairs)))]
        draw = Draw(rng, camera, (camera, other), ball, pair, int(rng.integers(10, 20)))
        if name in OF_FOUR and len(body.balls) < 4:
            continue  # a body of three is its own mirror image
        causes, of, amount, change = make(draw)
        fault = Fault(f"{name} {amount}".strip(), CLEAR, causes, of, change, ALSO.get(name, ()))
        yield _in_a_form(fault, draw, cameras) if forms else fault


_LEFT_OPEN = {"moved", "moved-at", "zoom", "principal-point"}
"""What two cameras alone cannot tell from each other."""


def _in_a_form(fault: Fault, draw: Draw, cameras: list[str]) -> Fault:
    """The same as a video, with grain, or of some cameras: those that it concerns among them."""
    rng = np.random.default_rng(int(draw.rng.integers(2**31)))
    codec = made.encoded(*FORMATS[int(rng.integers(len(FORMATS)))])
    grain = made.grainy(float(rng.uniform(2.0, 8.0)), int(rng.integers(2**31)))
    count = int(rng.choice([2, 3]))
    rest = [name for name in cameras if name not in draw.cameras]
    kept = [*draw.cameras, *rest][:count]
    forms = {
        "": [],
        "as a video": [codec],
        "grainy": [grain],
        "grainy, as a video": [grain, codec],
        f"of {count} cameras": [made.kept_cameras(*kept)],
    }
    form = str(rng.choice([*forms]))
    causes, of = fault.causes, fault.of
    if "of 2" in form:
        of = of if of in ("", *draw.ball.split()) else ""
        causes = (*causes, "moved") if {*causes} & _LEFT_OPEN else causes
    change = made.both(fault.change, *forms[form])
    return replace(fault, name=f"{fault.name} {form}".strip(), causes=causes, of=of, change=change)


FORMATS = [("libx264", 18), ("libx264", 23), ("libx264", 28), ("libx265", 22)]


def _pairs(names: tuple[str, ...]) -> list[tuple[str, str]]:
    return [(a, b) for k, a in enumerate(names) for b in names[k + 1 :]]


def _alike(centers: Floats, names: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Balls whose exchange changes no distance, and no picture shows."""
    before = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    for a, b in _pairs(names):
        order = list(range(len(names)))
        i, j = names.index(a), names.index(b)
        order[i], order[j] = j, i
        if np.allclose(before, before[np.ix_(order, order)], atol=0.5):
            yield a, b


_Made = tuple[tuple[str, ...], str, str, Change]
"""Words that are right, what they concern, how much, and what is done."""


def _clock(d: Draw) -> _Made:
    late = d.amount(0.01, 0.2)
    change = made.stamps(d.camera, lambda _, t: t + late)
    return ("clock",), d.camera, f"{late:+.3f} s", change


def _clock_step(d: Draw) -> _Made:
    late = d.size(0.033, 0.4)
    change = made.stamps(d.camera, lambda n, t: t + late * (n >= d.start))
    return ("clock-step",), d.camera, f"{late:+.3f} s", change


def _rate(d: Draw) -> _Made:
    rate = 1 + d.amount(0.02, 0.25)
    return ("clock",), d.camera, f"{rate:.3f}", made.stamps(d.camera, lambda _, t: rate * t)


def _turn(d: Draw) -> _Made:
    deg, axis = d.amount(0.12, 2.0), int(d.rng.integers(2))
    change = made.calibration(made.turned(deg, axis), d.camera)
    return ("moved", "principal-point"), d.camera, f"{deg:+.2f} deg", change


def _roll(d: Draw) -> _Made:
    deg = d.amount(0.5, 6.0)
    return ("moved",), d.camera, f"{deg:+.2f} deg", made.calibration(made.turned(deg, 2), d.camera)


def _push(d: Draw) -> _Made:
    step = d.vector(1.5, 20.0)

    def change(camera: Camera) -> Camera:
        pose = camera.world_from_camera.perturb([*step, 0, 0, 0])
        return replace(camera, world_from_camera=pose)

    size = float(np.linalg.norm(step))
    return ("moved",), d.camera, f"{size:.1f} mm", made.calibration(change, d.camera)


def _knock(d: Draw) -> _Made:
    x, y = d.vector(2.0, 15.0, axes=2)
    change = d.midway(lambda image: made.warped(image, 1.0, x, y), d.camera)
    return ("moved-at",), d.camera, f"{np.hypot(x, y):.1f} px", change


def _zoom(d: Draw) -> _Made:
    factor = 1 + d.amount(0.01, 0.2)
    return ("zoom",), d.camera, f"{factor:.3f}", made.calibration(made.lens(factor), d.camera)


def _zoom_all(d: Draw) -> _Made:
    factor = 1 + d.amount(0.01, 0.25)
    return ("zoom",), "", f"{factor:.3f}", made.calibration(made.lens(factor))


def _digital_zoom(d: Draw) -> _Made:
    factor = d.size(1.02, 1.3)
    change = made.pictures(lambda images, k: made.warped(images[k], factor), d.camera)
    return ("zoom",), d.camera, f"{factor:.3f}", change


def _zoom_midway(d: Draw) -> _Made:
    factor = 1 + d.size(0.01, 0.06)
    change = d.midway(lambda image: made.warped(image, factor), d.camera)
    return ("zoom",), d.camera, f"{factor:.3f}", change


def _principal_point(d: Draw) -> _Made:
    step = d.vector(3.0, 40.0, axes=2)

    def change(camera: Camera) -> Camera:
        matrix = camera.intrinsics.matrix.copy()
        matrix[:2, 2] += step
        return replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))

    amount = f"{np.linalg.norm(step):.0f} px"
    return ("moved", "principal-point"), d.camera, amount, made.calibration(change, d.camera)


def _scale(d: Draw) -> _Made:
    factor = 1 + d.amount(0.005, 0.2)
    change = made.calibration(made.scaled(factor))
    return ("scale", "board-square"), "", f"{factor:.3f}", change


def _radii(d: Draw) -> _Made:
    factor = 1 + d.amount(0.03, 0.2)
    return ("radius",), "", f"{factor:.3f}", made.body(every=lambda c, r: (c, factor * r))


def _radius(d: Draw) -> _Made:
    more = d.amount(0.7, 3.5)
    change = made.body(**{d.ball: lambda c, r: (c, r + more)})
    return ("radius",), d.ball, f"{more:+.1f} mm", change


def _place(d: Draw) -> _Made:
    step = d.vector(0.8, 8.0)
    change = made.body(**{d.ball: lambda c, r: (c + step, r)})
    return ("ball-place",), d.ball, f"{np.linalg.norm(step):.1f} mm", change


def _mirror(d: Draw) -> _Made:
    change = made.pictures(lambda images, k: images[k][:, ::-1], d.camera)
    return ("mirrored",), d.camera, "", change


def _upside_down(d: Draw) -> _Made:
    change = made.pictures(lambda images, k: images[k][::-1, ::-1], d.camera)
    return ("mirrored",), d.camera, "", change


def _mirror_all(_: Draw) -> _Made:
    return ("mirrored",), "", "", made.pictures(lambda images, k: images[k][::-1])


def _exchange_balls(d: Draw) -> _Made:
    def change(folder: Path) -> None:
        body = read_body(folder / "body.toml")
        to = dict(zip(d.balls, reversed(d.balls), strict=True))
        centers = np.stack([body.centers[body.index(to.get(n, n))] for n in body.names])
        write_body(folder / "body.toml", body.with_centers(centers))

    return ("exchanged-balls",), "", " ".join(d.balls), change


def _exchange_cameras(d: Draw) -> _Made:
    def change(folder: Path) -> None:
        one, other = (folder / name for name in d.cameras)
        one.rename(folder / "x")
        other.rename(one)
        (folder / "x").rename(other)

    return ("exchanged-cameras",), "", " ".join(d.cameras), change


def _exchange_calibrations(d: Draw) -> _Made:
    change = made.exchanged_calibrations(*d.cameras)
    return ("exchanged-cameras",), "", " ".join(d.cameras), change


def _channels(d: Draw) -> _Made:
    change = made.pictures(lambda images, k: images[k][:, :, ::-1], d.camera)
    return ("exchanged-channels",), d.camera, "", change


def _channels_of_all(_: Draw) -> _Made:
    return ("exchanged-channels",), "", "", made.pictures(lambda images, k: images[k][:, :, ::-1])


def _same_pictures(d: Draw) -> _Made:
    def change(folder: Path) -> None:
        one, other = (folder / name for name in d.cameras)
        shutil.rmtree(other)
        shutil.copytree(one, other)

    return ("same-pictures",), d.camera, " ".join(d.cameras), change


def _same_pictures_again(d: Draw) -> _Made:
    quality = int(d.rng.integers(60, 96))

    def change(folder: Path) -> None:
        one, other = (folder / name for name in d.cameras)
        for source, target in zip(
            sorted(one.glob("*.jpg")), sorted(other.glob("*.jpg")), strict=True
        ):
            cv2.imwrite(str(target), _read(source), [cv2.IMWRITE_JPEG_QUALITY, quality])

    return ("same-pictures",), d.camera, f"{' '.join(d.cameras)} {quality}", change


def _repeated(d: Draw) -> _Made:
    count = int(d.rng.integers(3, 8))

    def change(folder: Path) -> None:
        files = sorted((folder / d.camera).glob("*.jpg"))
        for later in files[d.start + 1 : d.start + 1 + count]:
            shutil.copy(files[d.start], later)

    return ("repeated-pictures",), d.camera, str(count), change


def _repeated_again(d: Draw) -> _Made:
    count = int(d.rng.integers(3, 8))
    last = d.start + count
    change = made.pictures(
        lambda images, k: images[d.start if d.start < k <= last else k], d.camera
    )
    return ("repeated-pictures",), d.camera, str(count), change


def _blurred(d: Draw) -> _Made:
    length = int(d.rng.integers(9, 18))
    kernel = np.ones((1, length)) if d.rng.random() < 0.5 else np.eye(length)
    change = made.pictures(
        lambda images, k: np.asarray(cv2.filter2D(images[k], -1, kernel / length), np.uint8)
    )
    return ("blurred",), "", f"{length} px", change


def _overexposed(d: Draw) -> _Made:
    return _brightened(d.size(2.4, 3.5))


def _dark(d: Draw) -> _Made:
    return _brightened(d.size(0.2, 0.3))


def _brightened(factor: float) -> _Made:
    return (
        ("exposure",),
        "",
        f"{factor:.2f}",
        made.pictures(lambda images, k: np.clip(factor * images[k], 0, 255).astype(np.uint8)),
    )


def _grain(d: Draw) -> _Made:
    sd, along = d.size(6, 16), float(d.rng.choice([0.0, 1.0]))

    def grainy(images: list[Bytes], k: int) -> Bytes:
        grain = d.rng.normal(0, 1, images[k].shape)
        if along:
            grain = np.asarray(cv2.GaussianBlur(grain, (9, 1), along), np.float64)
        return np.clip(images[k] + sd * grain / grain.std(), 0, 255).astype(np.uint8)

    return (), "", f"{sd:.0f} levels", made.pictures(grainy)


def _read(path: Path) -> Bytes:
    return np.asarray(cv2.imread(str(path)), np.uint8)


def _interlaced(d: Draw) -> _Made:
    return ("interlaced",), d.camera, "", made.pictures(made.woven, d.camera)


def _interlaced_all(_: Draw) -> _Made:
    return ("interlaced",), "", "", made.pictures(made.woven)


def _bursts(d: Draw) -> _Made:
    size, apart_s = int(d.rng.integers(2, 7)), d.size(0.0003, 0.005)
    change = made.stamps(d.camera, lambda n, t: t - (n % size) * (1 / HZ - apart_s))
    return ("clock",), d.camera, f"of {size}", change


def _clock_set(d: Draw) -> _Made:
    late = d.size(1.0, 1000.0)
    change = made.stamps(d.camera, lambda n, t: t + late * (n >= d.start))
    return ("clock-step",), d.camera, f"{late:+.1f} s", change


def _wander(d: Draw) -> _Made:
    step_px, returns = d.size(1.0, 4.0), float(d.rng.choice([1.0, 0.85]))
    at = np.zeros((SETS, 2))
    for k in range(1, SETS):
        at[k] = returns * at[k - 1] + d.rng.normal(0, step_px, 2)
    change = made.pictures(lambda images, k: made.warped(images[k], 1.0, *at[k]), d.camera)
    return ("unknown",), d.camera, f"{step_px:.1f} px", change


def _mirror_body(d: Draw) -> _Made:
    def change(folder: Path) -> None:
        body = read_body(folder / "body.toml")
        sign = np.where(np.arange(3) == axis, -1.0, 1.0)
        write_body(folder / "body.toml", body.with_centers(body.centers * sign))

    axis = int(d.rng.integers(3))
    return ("mirrored",), "", "xyz"[axis], change


def _clock_and_moved(d: Draw) -> _Made:
    late, deg = d.amount(0.02, 0.1), d.amount(0.2, 1.5)
    moved = made.calibration(made.turned(deg, int(d.rng.integers(2))), d.cameras[1])
    change = made.both(made.stamps(d.camera, lambda _, t: t + late), moved)
    return ("clock", "moved"), "", f"{late:+.3f} s {deg:+.2f} deg", change


def _scale_and_radius(d: Draw) -> _Made:
    factor, more = 1 + d.amount(0.01, 0.05), d.amount(1.0, 3.0)
    radius = made.body(**{d.ball: lambda c, r: (c, r + more)})
    change = made.both(made.calibration(made.scaled(factor)), radius)
    return ("scale", "board-square", "radius"), "", f"{factor:.3f} {more:+.1f} mm", change


def _pushed_and_bent(d: Draw) -> _Made:
    moved, bent = _push(d), _place(d)
    causes, amount = (*moved[0], *bent[0]), f"{moved[2]}, {bent[2]}"
    return causes, "", amount, made.both(moved[3], bent[3])


ALSO = {
    "clock and moved": ("clock", "moved"),
    "scale and radius": ("scale or board-square", "radius"),
    "pushed and bent": ("moved", "ball-place"),
}
"""What is to be named of pairs of faults, in any order."""
OF_FOUR = ("body mirrored",)
KINDS: dict[str, Callable[[Draw], _Made]] = {
    "clock": _clock,
    "clock step": _clock_step,
    "rate": _rate,
    "turned": _turn,
    "rolled": _roll,
    "pushed": _push,
    "moved at": _knock,
    "zoom": _zoom,
    "zoom all": _zoom_all,
    "digital zoom": _digital_zoom,
    "zoom at": _zoom_midway,
    "principal point": _principal_point,
    "scale": _scale,
    "radii": _radii,
    "radius": _radius,
    "ball place": _place,
    "mirrored": _mirror,
    "upside down": _upside_down,
    "mirrored all": _mirror_all,
    "balls exchanged": _exchange_balls,
    "folders exchanged": _exchange_cameras,
    "calibrations exchanged": _exchange_calibrations,
    "red and blue of one": _channels,
    "red and blue": _channels_of_all,
    "same pictures": _same_pictures,
    "same pictures again": _same_pictures_again,
    "repeated": _repeated,
    "repeated again": _repeated_again,
    "blurred": _blurred,
    "overexposed": _overexposed,
    "dark": _dark,
    "grain": _grain,
    "interlaced one": _interlaced,
    "interlaced": _interlaced_all,
    "bursts": _bursts,
    "clock set": _clock_set,
    "wanders": _wander,
    "body mirrored": _mirror_body,
    "clock and moved": _clock_and_moved,
    "scale and radius": _scale_and_radius,
    "pushed and bent": _pushed_and_bent,
}
