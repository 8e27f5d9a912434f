"""The recorded body compared with its file: distances, radii, colours, handedness.

No pose is needed, so the check works with a body file too wrong to track with.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from measure.arrays import Floats
from measure.checking.causes import ALL, Cause, Word, significant
from measure.checking.finding import Finding, Level
from measure.errors import DegenerateGeometryError
from measure.estimation.body_layout import looks_mirrored, thickness
from measure.geometry.covariance import MAD_TO_SD
from measure.geometry.transform import align_points
from measure.limits import SIGNIFICANT_SIGMAS
from measure.measuring.body_size import OutlineGrowth
from measure.measuring.pose_hypotheses import by_ball, intersect_rays
from measure.model import Body, Camera, Detection, Doubt

_MAX_PLANAR_MM = 1.0
_SAME_DISTANCE_MM = 1.0
_MAX_BALLS_PERMUTED = 6
_ALIKE_SHARE = 0.1  # By which ratios of distances may differ where one factor is behind them
_ONE_ALONE = 0.3
"""A ball is named alone if the others' sizes agree with each other this much better."""


@dataclass(frozen=True)
class Compared:
    """One length of the body: as measured, and in the file."""

    what: tuple[str, ...]  # the ball whose radius it is, or the two whose distance
    measured_mm: float  # over all frames
    sd_mm: float
    file_mm: float  # what the body file says
    frames: int
    tolerance_mm: float = 0.5  # a difference that does not matter, beyond the uncertainty

    @property
    def agrees(self) -> bool:
        """Whether the difference is explained by the uncertainty, or too small to matter."""
        return self.may_be(self.file_mm)

    def may_be(self, length_mm: float) -> bool:
        """Whether the length may be this one."""
        return (
            abs(self.measured_mm - length_mm) <= SIGNIFICANT_SIGMAS * self.sd_mm + self.tolerance_mm
        )


def layout_causes(distances: Sequence[Compared], body: Body) -> list[Cause]:
    """The simplest explanation of distances that disagree, with no pose known."""
    for d in distances:
        if d.measured_mm < sum(body.radii[body.index(name)] for name in d.what) / 2:
            return [_on_one_ball(d)]
    wrong = [d for d in distances if not d.agrees]
    if not wrong:
        return []
    complete = len(distances) == len(body.balls) * (len(body.balls) - 1) // 2
    if complete and (swap := _swap(distances, body)) is not None:
        return [swap]
    shared = set.intersection(*(set(d.what) for d in wrong)) if len(wrong) > 1 else set[str]()
    lines = ", ".join(_line(d) for d in wrong)
    surest = max(wrong, key=lambda d: abs(d.measured_mm - d.file_mm) / max(d.sd_mm, 1e-9))
    ball = shared.pop() if shared else ""
    text = f"ball {ball} is not where the body file says: {lines}" if ball else lines
    cause = Cause(
        Word.PLACE,
        ball or ", ".join(wrong[0].what),
        text,
        _MEND_PLACES,
        Level.WRONG,
        surest.measured_mm,
        surest.sd_mm,
        "mm",
        nothing=surest.file_mm,
    )
    return significant([cause])


def _on_one_ball(d: Compared) -> Cause:
    """Two balls that would be inside of each other: the one's colour was found on the other."""
    a, b = d.what
    text = (
        f"the colours of {a} and {b} are found on one ball, {d.measured_mm:.1f} mm apart: the "
        "light has a colour of its own"
    )
    remedy = "balance the cameras' white in this light; `measure run` learns the colours in it"
    return Cause(Word.EXPOSURE, f"{a}, {b}", text, remedy, Level.WEAK)


_MEND_PLACES = "correct the places in the body file (`measure body` finds them)"


def _line(d: Compared) -> str:
    return (
        f"{d.measured_mm:.2f} +- {d.sd_mm:.2f} mm between {d.what[0]} and {d.what[1]}, "
        f"the body file says {d.file_mm:.2f} mm"
    )


def _swap(distances: Sequence[Compared], body: Body) -> Cause | None:
    """The exchange of colours that explains all distances, if there is one."""
    length = {frozenset(d.what): d.file_mm for d in distances}
    names = body.names
    if len(names) > _MAX_BALLS_PERMUTED:
        return None
    ways = sorted(
        permutations(names), key=lambda p: sum(a != b for a, b in zip(names, p, strict=True))
    )
    for way in ways[1:]:
        new = dict(zip(names, way, strict=True))
        if all(d.may_be(length[frozenset((new[d.what[0]], new[d.what[1]]))]) for d in distances):
            moved = [name for name in names if new[name] != name]
            text = (
                f"the colours of {', '.join(moved[:-1])} and {moved[-1]} are exchanged "
                "in the body file: the distances fit when they change places"
            )
            cure = "exchange them in the body file"
            of, instead = ", ".join(moved), {name: new[name] for name in moved}
            return Cause(Word.EXCHANGED_BALLS, of, text, cure, Level.WRONG, instead=instead)
    return None


def radius_causes(radii: Sequence[Compared]) -> list[Cause]:
    """Balls whose radius disagrees."""
    return [
        Cause(
            Word.RADIUS,
            r.what[0],
            f"ball {r.what[0]} has a radius of {r.measured_mm:.1f} +- {r.sd_mm:.1f} mm, "
            f"the file says {r.file_mm:.1f} mm",
            _MEND_RADII,
            Level.WRONG,
            r.measured_mm,
            r.sd_mm,
            "mm",
            nothing=r.file_mm,
        )
        for r in radii
        if not r.agrees
    ]


_MEND_RADII = "measure them with callipers, or state a larger radius_tolerance_mm"


def size_causes(body: Body, seen: OutlineGrowth) -> list[Cause]:
    """The balls' sizes and their uncertainty where outlines at known poses contradict the file."""
    if not seen.contradicts(body):
        return []
    off, covariance = seen.growth_mm / body.radii, seen.covariance_mm2
    relative = covariance / np.outer(body.radii, body.radii)
    share, sd = float(np.mean(off)), float(np.sqrt(np.mean(relative)))
    what = "balls look larger or smaller than the body file says"
    if np.all(np.sign(off) == np.sign(share)):
        size = "larger" if share > 0 else "smaller"
        what = f"all balls look {size} than the body file says, by {abs(share):.1%} +- {sd:.1%}"
    rows = zip(body.balls, seen.growth_mm, np.sqrt(np.diag(covariance)), strict=True)
    each = ", ".join(
        f"{ball.name} {ball.radius_mm + growth:.2f} +- {sd:.2f} mm for {ball.radius_mm:g}"
        for ball, growth, sd in rows
    )
    of, text = ALL, f"{what} (radii: {each})"
    scatter = np.abs(off - np.median(off))
    if len(off) > 2 and np.sort(scatter)[-2] < _ONE_ALONE * scatter.max():
        of = body.names[int(np.argmax(scatter))]
    alike = Cause(Word.RADIUS, of, text, _MEND_RADII, Level.WEAK, 100 * share, 100 * sd, "%")
    alone = [
        replace(alike, estimate=float(r + more), sd=float(sd_mm), unit="mm", nothing=float(r))
        for r, more, sd_mm in zip(
            body.radii, seen.growth_mm, np.sqrt(np.diag(covariance)), strict=True
        )
    ]
    if of != ALL:
        return significant([alone[body.index(of)]])
    return significant([max([alike, *alone], key=lambda cause: cause.deviations)])


def twin_findings(body: Body) -> list[Finding]:
    """A line if the body with some balls exchanged is the same body, turned.

    Which of the two is measured rests on the colours in the file alone: no picture contradicts a
    file in which they are exchanged.
    """
    names = body.names
    if len(names) > _MAX_BALLS_PERMUTED:
        return []
    found = []
    for order in permutations(range(len(names))):
        moved = [k for k, other in enumerate(order) if k != other]
        if not moved:
            continue
        try:
            turn = align_points(body.centers[list(order)], body.centers)
        except DegenerateGeometryError:
            continue
        off_mm = np.linalg.norm(turn.apply(body.centers) - body.centers[list(order)], axis=1)
        if np.max(off_mm) < _SAME_DISTANCE_MM:
            angle = float(np.degrees(np.linalg.norm(turn.rotvec)))
            found.append((len(moved), [names[k] for k in moved], angle))
    if not found:
        return []
    _, exchanged, angle = min(found)
    others = f" (and {len(found) - 1} more such exchanges)" if len(found) > 1 else ""
    text = Doubt("twin-colours", balls=exchanged, angle_deg=angle, others=others)
    return [Finding(Level.NOTE, "body", text)]


def blind_to(body: Body, located: Collection[str]) -> tuple[str, ...]:
    """Mistakes in the file that leave all distances between the located balls unchanged."""
    names = [name for name in body.names if name in located]
    centers = body.centers[[body.index(name) for name in names]].reshape(-1, 3)
    out = [
        f"where ball {name} is: it was located too seldom"
        for name in body.names
        if name not in located
    ]
    before = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    for a, b in combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[a], order[b] = b, a
        if np.max(np.abs(before - before[np.ix_(order, order)])) < _SAME_DISTANCE_MM:
            out.append(f"an exchange of {names[a]} and {names[b]}")
    if len(names) < 4 or thickness(centers) < _MAX_PLANAR_MM:
        out.append("a mirrored layout: the balls located lie in one plane")
    return tuple(out)


_MIN_FRAMES, _MIN_SHARE = 3, 0.25
"""Frames, and their share of those that show any ball, that a length is known from: of a hidden
ball's colour something else may be found now and then."""
_RANGE_RATIO = 2.5
_EDGE_BIAS_PX = 0.8
"""Systematic error of a ball's radius: glossy paint loses its colour inside the true outline."""
_SAME_BALL_RADII = 0.2
"""Distance of an outline's centre from a ball's, in radii, up to which it is that ball's."""
_MAX_INDEPENDENT_FRAMES = 10
"""Frames share errors of calibration and edges: no more count as independent."""


@dataclass(frozen=True, eq=False)
class LocatedBalls:
    """Balls located in one frame set, independent of the body's shape."""

    centers: Mapping[str, Floats]  # (3,) in the world by ball name, mm
    variances: Mapping[str, float]  # mean variance of a coordinate by ball name, mm^2
    # (mm, standard deviation in mm) by ball name, from the outlines.
    radii: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class BodyCheck:
    """The body as recorded, compared with its file."""

    distances: tuple[Compared, ...] = ()  # of every pair of balls that was located often enough
    radii: tuple[Compared, ...] = ()  # of every ball that was located often enough
    causes: tuple[Cause, ...] = ()  # what is wrong, by these alone; empty if nothing is
    blind_to: tuple[str, ...] = ()  # mistakes that the located balls cannot show, a line each

    @property
    def factor(self) -> float | None:
        """About how many times larger the body looks, if distances disagree with the file."""
        ratios = np.array([d.measured_mm / d.file_mm for d in self.distances])
        if all(d.agrees for d in self.distances):
            return None
        alike = np.ptp(ratios) < _ALIKE_SHARE * np.median(ratios)
        return float(np.median(ratios)) if alike else None


def locate_balls(
    detections: Mapping[str, Sequence[Detection]], body: Body, cameras: Sequence[Camera]
) -> LocatedBalls:
    """Balls where the rays of most cameras intersect, in whole frames, if no colour repeats."""
    centers, variances, radii = {}, {}, {}
    for ball, candidates in zip(body.balls, by_ball(detections, body.balls, cameras), strict=True):
        points = intersect_rays(candidates, SIGNIFICANT_SIGMAS, _RANGE_RATIO, max_points=1)
        if not len(points.points) or points.support[0] < min(3, len(cameras)):
            continue
        centers[ball.name] = points.points[0]
        variances[ball.name] = float(points.sd_mm[0] ** 2)
        near = outline_sizes(candidates.detections, points.points[0], cameras)
        if near:
            # The deviation is that of one view, as the bias of edges is common to all.
            radius, sd = np.median(near, axis=0).tolist()
            radii[ball.name] = (radius, sd)
    return LocatedBalls(centers, variances, radii)


def check_body(located: Iterable[LocatedBalls], body: Body) -> BodyCheck:
    """Compare the balls located in all frames with the body file."""
    frames = list(located)
    least = max(_MIN_FRAMES, round(_MIN_SHARE * sum(bool(frame.centers) for frame in frames)))
    distances = tuple(
        compared
        for a, b in combinations(body.names, 2)
        if (compared := _distance(frames, body, a, b, least)) is not None
    )
    radii = tuple(
        compared
        for name in body.names
        if (compared := _radius(frames, body, name, least)) is not None
    )
    known = {name for compared in distances for name in compared.what}
    causes = [*layout_causes(distances, body), *radius_causes(radii)]
    if _mostly_mirrored(frames, body):
        text = "the balls form the mirror image of the body file"
        cure = "one coordinate has the wrong sign in it: correct it"
        causes.insert(0, Cause(Word.MIRRORED, "body", text, cure, Level.WRONG))
    return BodyCheck(distances, radii, tuple(causes), blind_to(body, known))


def outline_sizes(
    detections: Sequence[Detection], center: Floats, cameras: Sequence[Camera]
) -> list[tuple[float, float]]:
    """(radius in mm, its standard deviation) from every outline around a ball at `center`."""
    by_name = {camera.name: camera for camera in cameras}
    out = []
    for d in detections:
        camera = by_name[d.camera]
        off = np.linalg.norm(camera.project(center[None])[0] - d.center_px)
        if not off < _SAME_BALL_RADII * d.radius_px:
            continue
        focal = camera.intrinsics.focal_px
        distance = float(np.linalg.norm(center - camera.center))
        radius = distance * d.radius_px / np.hypot(d.radius_px, focal)
        sd_px = np.hypot(_EDGE_BIAS_PX, np.sqrt(d.variance_px2))
        out.append((float(radius), float(radius * sd_px / d.radius_px)))
    return out


def _distance(
    frames: Sequence[LocatedBalls], body: Body, a: str, b: str, least: int
) -> Compared | None:
    both = [f for f in frames if a in f.centers and b in f.centers]
    if len(both) < least:
        return None
    lengths = np.array([np.linalg.norm(f.centers[a] - f.centers[b]) for f in both])
    stated = np.sqrt(np.median([f.variances[a] + f.variances[b] for f in both]))
    file_mm = float(np.linalg.norm(body.centers[body.index(a)] - body.centers[body.index(b)]))
    median, scatter = _robust_mean(lengths, float(stated))
    sd = float(np.hypot(scatter, body.distance_sd_mm))
    return Compared((a, b), median, sd, file_mm, len(both))


def _radius(frames: Sequence[LocatedBalls], body: Body, name: str, least: int) -> Compared | None:
    seen = [f.radii[name] for f in frames if name in f.radii]
    if len(seen) < least:
        return None
    values = np.array([radius for radius, _ in seen])
    common = float(np.median([sd for _, sd in seen]))
    median, scatter = _robust_mean(values, 0.0)
    file_mm = float(body.radii[body.index(name)])
    return Compared((name,), median, float(np.hypot(scatter, common)), file_mm, len(seen))


def _robust_mean(values: Floats, stated_sd: float) -> tuple[float, float]:
    """Median, and its standard deviation by scatter or as stated, whichever is larger."""
    median = float(np.median(values))
    scatter = MAD_TO_SD * float(np.median(np.abs(values - median)))
    count = min(len(values), _MAX_INDEPENDENT_FRAMES)
    return median, float(1.25 * max(scatter, stated_sd) / np.sqrt(count))


def _mostly_mirrored(frames: Sequence[LocatedBalls], body: Body) -> bool:
    votes = [
        looks_mirrored(body.centers, np.stack([f.centers[name] for name in body.names]))
        for f in frames
        if all(name in f.centers for name in body.names)
    ]
    return len(votes) >= _MIN_FRAMES and float(np.mean(votes)) > 0.5
