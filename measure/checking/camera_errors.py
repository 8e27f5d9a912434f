"""Which error of a camera explains best that it disagrees with the others: each in turn is tried.

At the poses measured, the residuals of all ball-views are linear in small errors of the cameras:
a late clock, a turn, another focal length. The pose of every instant is eliminated (Schur
complement; Triggs et al. 2000, section 6), as is a common scale, which the body file or all cameras
may have wrong; and the error that lowers the sum of squares most is taken, then those that lower
what is left.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.checking.clocks import Instant, Reduced, eliminate_pose, linearise
from measure.checking.finding import Finding, Level
from measure.geometry import chi_square_quantile
from measure.geometry.normal_equations import symmetric_inverse
from measure.model import Body, Camera

_BIAS_PX = 0.15
"""Standard deviation of what a ball-view errs by in all frame sets alike (light on its edge)."""
_WEAK, _WRONG = 1 - 6.3e-5, 1 - 2e-9
"""Shares of a normal variable within four and within six standard deviations."""
_RIVAL_SHARE, _ALIKE_PROBABILITY = 0.7, 0.99
"""Of the best explanation's gain: what explains as much is an explanation as well; and the simpler
one is named first if the other's greater gain may be chance."""
_BLOCKS = 8
_MIN_INSTANTS = 5


class Kind(StrEnum):
    """What may be wrong with a camera."""

    CLOCK = "clock"
    TURN = "turn"
    FOCAL = "focal length"


_COLUMNS = {Kind.CLOCK: slice(0, 1), Kind.TURN: slice(1, 3), Kind.FOCAL: slice(3, 4)}
"""Of a camera's four parameters: seconds, rad about its x and y axes, a share of the focal length.

A roll about the line of sight is left out: balls close together hardly show it.
"""
_SIZE = 4


@dataclass(frozen=True)
class CameraError:
    """The likeliest error of a camera."""

    camera: str
    kind: Kind
    # of a clock in s, to be added to its stamps; of a turn in deg; of a focal length the share by
    # which it is longer than calibrated.
    amount: float
    sd: float  # its standard deviation, with a constant bias of each ball-view
    level: Level  # WRONG beyond six standard deviations, WEAK beyond four
    # other errors that this motion cannot tell from it: camera and kind.
    rivals: tuple[tuple[str, Kind], ...]


def camera_errors(
    instants: Sequence[Instant], body: Body, cameras: Sequence[Camera]
) -> tuple[CameraError, ...]:
    """Find the errors of cameras that explain the residuals, the most important first.

    The body must move. Of less than three cameras none are found: of two either may be wrong.
    """
    if len(cameras) < 3 or len(instants) < _MIN_INSTANTS:
        return ()
    system = _System.of(instants, len(body.balls), cameras)
    found: list[CameraError] = []
    taken = [_SIZE * len(cameras)]  # the common scale
    left = list(range(len(cameras)))
    while len(left) >= 3 and (best := system.best(left, taken)) is not None:
        fit, alike = best
        rivals = tuple((cameras[other.camera].name, other.kind) for other in alike)
        name = cameras[fit.camera].name
        found.append(CameraError(name, fit.kind, fit.amount, fit.sd, fit.level, rivals))
        taken += _parameters(fit.camera, fit.kind)
        left.remove(fit.camera)
    return tuple(found)


class _Fit(NamedTuple):
    """One error of one camera, beside those that were taken before."""

    camera: int
    kind: Kind
    amount: float
    sd: float
    level: Level
    gain: float


def _parameters(camera: int, kind: Kind) -> list[int]:
    return list(range(_SIZE * camera, _SIZE * (camera + 1)))[_COLUMNS[kind]]


@dataclass(frozen=True, eq=False)
class _System:
    """The normal equations of all cameras' errors, block by block of the recording."""

    normal: Floats  # (b, p, p)
    right: Floats  # (b, p)
    # (v, p) what a bias of 1 px adds to the right side, for every ball, camera and axis.
    by_bias: Floats
    scale: float  # mean square of the residuals over their stated variance, 1 at least

    @classmethod
    def of(cls, instants: Sequence[Instant], balls: int, cameras: Sequence[Camera]) -> _System:
        size = _SIZE * len(cameras) + 1
        blocks = min(_BLOCKS, len(instants))
        normal, right = np.zeros((blocks, size, size)), np.zeros((blocks, size))
        by_bias = np.zeros((len(cameras) * balls, 2, size))
        square = degrees = 0.0
        for k, instant in enumerate(instants):
            part = _reduced(instant, cameras)
            block = k * blocks // len(instants)
            normal[block] += part.normal
            right[block] += part.right
            views = instant.cameras * balls + instant.sightings.balls
            np.add.at(by_bias, views, part.by_residual)
            square, degrees = square + part.chi_square, degrees + part.degrees
        scale = max(1.0, square / max(degrees, 1.0))
        return cls(normal, right, by_bias.reshape(-1, size), scale)

    def best(self, left: Sequence[int], taken: Sequence[int]) -> tuple[_Fit, list[_Fit]] | None:
        """The error that explains most, and those that explain it as well."""
        fits = [fit for camera in left for fit in self._significant(camera, taken)]
        if not fits:
            return None
        most = max(fit.gain for fit in fits)
        alike = [fit for fit in fits if fit.gain > _RIVAL_SHARE * most]
        camera = max(alike, key=lambda fit: fit.gain).camera
        chance = self.scale * chi_square_quantile(_ALIKE_PROBABILITY, 1)
        own = [fit for fit in alike if fit.camera == camera and fit.gain > most - chance]
        first = min(own, key=lambda fit: (len(_parameters(0, fit.kind)), -fit.gain))
        return first, [fit for fit in alike if fit is not first]

    def _significant(self, camera: int, taken: Sequence[int]) -> Iterator[_Fit]:
        before = self._gain(list(taken))
        for kind in Kind:
            own = _parameters(camera, kind)
            columns = [*taken, *own]
            values, covariance = self._solve(columns)
            mine, spread = values[-len(own) :], covariance[-len(own) :, -len(own) :]
            squared = float(mine @ symmetric_inverse(spread) @ mine)
            if squared <= chi_square_quantile(_WEAK, len(own)):
                continue
            wrong = squared > chi_square_quantile(_WRONG, len(own))
            level, gain = Level.WRONG if wrong else Level.WEAK, self._gain(columns) - before
            yield _Fit(camera, kind, *_amount(kind, mine, spread), level, gain)

    def _gain(self, columns: Sequence[int]) -> float:
        """By how much these errors lower the sum of squares."""
        normal, right = self.normal.sum(axis=0), self.right.sum(axis=0)
        some = right[columns]
        return float(some @ symmetric_inverse(normal[np.ix_(columns, columns)]) @ some)

    def _solve(self, columns: Sequence[int]) -> tuple[Floats, Floats]:
        """Errors (k,), and their covariance (k, k): of noise, of biases, and between blocks."""
        at = np.ix_(columns, columns)
        normal, right = self.normal.sum(axis=0), self.right.sum(axis=0)
        inverse = symmetric_inverse(normal[at])
        values = inverse @ right[columns]
        off = []
        for its_normal, its_right in zip(self.normal, self.right, strict=True):
            less = symmetric_inverse((normal - its_normal)[at])
            off.append(less @ (right - its_right)[columns] - values)
        spread = np.array(off)
        jackknife = (len(off) - 1) / len(off) * spread.T @ spread
        biased = _BIAS_PX * self.by_bias[:, columns] @ inverse
        return values, self.scale * inverse + jackknife + biased.T @ biased


def _amount(kind: Kind, values: Floats, covariance: Floats) -> tuple[float, float]:
    """The error as one number and its standard deviation; of a turn the angle in deg."""
    if kind is not Kind.TURN:
        return float(values[0]), float(np.sqrt(covariance[0, 0]))
    angle = float(np.linalg.norm(values))
    axis = values / angle
    return float(np.degrees(angle)), float(np.degrees(np.sqrt(axis @ covariance @ axis)))


def _reduced(instant: Instant, cameras: Sequence[Camera]) -> Reduced:
    residuals, by_pose, flow, points = linearise(instant, np.zeros((len(cameras), 2)))
    by_error = np.zeros((len(points), 2, _SIZE * len(cameras) + 1))
    _fill_by_cameras(by_error, points, instant.cameras, flow, cameras)
    arms = points - instant.pose.translation
    by_error[:, :, -1] = np.einsum("nij,nj->ni", by_pose[:, :, :3], arms)
    return eliminate_pose(residuals, by_pose, by_error, instant.sightings.noise)


def _fill_by_cameras(
    out: Floats, points_world: Floats, views: Ints, flow: Floats, cameras: Sequence[Camera]
) -> None:
    """Fill in derivatives (n, 2, p) of the pixels of ball-views by the errors of their cameras."""
    for index, camera in enumerate(cameras):
        rows = np.nonzero(views == index)[0]
        pixels, _, by_pose, _ = camera.project_with_jacobians(points_world[rows])
        start = _SIZE * index
        out[rows, :, start] = flow[rows]
        out[rows, :, start + 1 : start + 3] = (
            by_pose[:, :, 3:] @ camera.world_from_camera.rotation[:, :2]
        )
        out[rows, :, start + 3] = pixels - camera.intrinsics.matrix[:2, 2]


def error_findings(errors: Sequence[CameraError]) -> list[Finding]:
    """One line for every camera whose calibration is off; clocks have lines of their own."""
    out = []
    for error in errors:
        text = (
            f"{error.camera}: its focal length is {100 * error.amount:+.2f} +- "
            f"{100 * error.sd:.2f} % off its calibration: was it focused or zoomed? calibrate it"
        )
        if error.kind is Kind.TURN:
            text = (
                f"{error.camera} points {error.amount:.2f} +- {error.sd:.2f} deg beside where its "
                "calibration says: was it touched? calibrate it"
            )
        if error.kind is not Kind.CLOCK:
            out.append(Finding(error.level, "calibration", text + rivals_text(error)))
    return out


def rivals_text(error: CameraError) -> str:
    """The end of a line on an error that others explain as well; empty if none does."""
    if not error.rivals:
        return ""
    others = ", ".join(f"the {kind} of {camera}" for camera, kind in error.rivals)
    return (
        f"; this motion cannot tell it from {others}: "
        "move the body to and fro, through the whole view"
    )
