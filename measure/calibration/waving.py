"""A board that is waved: which pictures are worth keeping, and whether they are enough."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import combinations
from typing import TypeVar

import numpy as np

from measure.arrays import Bytes, Floats, rms_length
from measure.calibration.board_views import LENS_MODELS, board_pose, fit_lens, start_intrinsics
from measure.calibration.boards import Board, Corners
from measure.calibration.common_views import fit_common_views
from measure.calibration.findings import workspace_of
from measure.calibration.intrinsics import LensCalibration
from measure.calibration.other_boards import OtherBoard, other_board
from measure.calibration.views import ALL_VIEWS, BLURRED_SHARE, choose_views, outline
from measure.errors import CalibrationError, DegenerateGeometryError
from measure.estimation.expected_accuracy import body_pose_sd
from measure.geometry import RigidTransform
from measure.model import Body, Camera, Intrinsics
from measure.model.camera import USUAL_FOCAL

_NEW_SHARE = 0.06  # Share of the diagonal by which a view differs from those that are kept
_SLIP_PX = 0.5  # How far the board may move between the pictures of one instant
_FAR_PX = 12.0  # Corners nearer to each other than this are found seldom, and badly
_SLOW_S = 1.0  # A computer that looks less often than this is reported: hands wait for it
_CLOSER_LOOKS = 10  # In succession without the board, after which another one is looked for
_UNSEEN_LOOKS = 30  # In succession, before it is asked whether the board is the one that was chosen
_FIT_EVERY = 4  # Instants after which the cameras are fitted again
_FEWEST, _COMMON = 8, 4  # Views of a camera, and of two neighbours, from which the fit may decide
TILTED_DEG = 20.0  # From which on a view counts as tilted
_TILTS, _DISTANCES = 4, 1.3
_ROWS, _COLUMNS = ("upper", "middle", "lower"), ("left", "middle", "right")


class Now(Enum):
    """What one picture shows of a board that is waved."""

    NOTHING = "no board"
    MIRRORED = "the board, mirrored"
    MOVING = "the board, moving"
    BLURRED = "the board, blurred"
    FAR = "the board, too far away"
    SEEN = "the board"


@dataclass(frozen=True, eq=False)
class CameraWave:
    """What one camera has seen of the board."""

    views: int  # kept
    cells: Floats  # (3, 3) corners in each part of the picture, from the upper left
    tilts: int  # views in which the board was tilted clearly
    distances: float  # farthest over nearest; NaN without views
    sharpness: float  # of the last view; NaN without one
    now: Now  # what it saw when it was looked at last


@dataclass(frozen=True, eq=False)
class WaveState:
    """How far the pictures of a waved board suffice."""

    cameras: Mapping[str, CameraWave]
    pairs: Mapping[tuple[str, str], int]  # instants at which both cameras saw the board
    # expected error of the body's position (3-D, one standard deviation, RMS over the workspace)
    # from the calibration; NaN while nothing can be said.
    position_sd_mm: float
    goal_mm: float
    advice: tuple[str, ...]  # what to do next, the most useful first; none when it is enough
    other: OtherBoard | None = None  # the board that is seen instead of the chosen one

    @property
    def enough(self) -> bool:
        """Whether lenses and rig are as good as was asked for."""
        return self.position_sd_mm <= self.goal_mm

    def sentence(self) -> str:
        """How good it is, for people."""
        if np.isnan(self.position_sd_mm):
            return "too few views to say how good the calibration will be"
        judged = "good enough" if self.enough else "not good enough yet"
        return f"expected error at the body {self.position_sd_mm:.3f} mm, {judged}"


@dataclass
class BoardWave:
    """Takes what cameras see of a board at instants, and keeps what adds something."""

    board: Board
    sizes_wh: dict[str, tuple[int, int]]  # of the pictures, by camera
    body: Body  # that will be measured
    goal_mm: float = 0.2  # expected error of the body's position that is good enough
    kept: list[dict[str, Corners]] = field(default_factory=list)
    _outlines: list[dict[str, Floats]] = field(default_factory=list)  # Of what is kept
    _poses: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    _before: dict[str, tuple[float, Floats]] = field(default_factory=dict)  # At the last look
    _sd_mm: float = np.nan
    _last: dict[str, float] = field(default_factory=dict)
    _now: dict[str, Now] = field(default_factory=dict)
    _look_s: tuple[float, float] = (np.nan, np.nan)  # When it was looked last, and before
    _problem: str = ""  # Why the views do not fit each other
    _unseen_looks: int = 0  # Since the beginning or the last one at which a camera saw the board
    _other: OtherBoard | None = None  # What is seen instead

    def add(
        self,
        views: Mapping[str, Corners],
        times_s: Mapping[str, float],
        mirrored: Collection[str] = (),
    ) -> bool:
        """Take the views of one instant, by camera, and say whether some of them are kept.

        Those are that are not blurred, and in which the board hardly moved from the first of the
        pictures to the last, by how it moved since it was looked at before; if one is unlike all
        before it, or two cameras with few common views see the board as never before together.

        Args:
            views: of the cameras that see the board.
            times_s: of all cameras' pictures.
            mirrored: cameras whose pictures show the board mirrored.
        """
        outlines = {name: outline(self.board, view) for name, view in views.items()}
        seen_s = {name: times_s[name] for name in views}
        moving = [n for n, at in outlines.items() if self._slip_px(n, at, seen_s) > _SLIP_PX]
        blurred = [name for name, view in views.items() if self._is_blurred(name, view)]
        self._before = {name: (times_s[name], at) for name, at in outlines.items()}
        self._last |= {name: view.sharpness for name, view in views.items()}
        self._look_s = max(times_s.values(), default=np.nan), self._look_s[0]
        far = [name for name, view in views.items() if self._pitch_px(view) < _FAR_PX]
        if views or mirrored:
            self._unseen_looks, self._other = 0, None
        else:
            self._unseen_looks += bool(times_s)
        self._now = dict.fromkeys(views, Now.SEEN)
        for names, what in (
            (far, Now.FAR),
            (blurred, Now.BLURRED),
            (moving, Now.MOVING),
            (mirrored, Now.MIRRORED),
        ):
            self._now |= dict.fromkeys(names, what)
        good = {name: at for name, at in outlines.items() if name not in (*moving, *blurred)}
        if not is_new(good, self._outlines, self._apart_px, self.sizes_wh, _NEW_SHARE):
            return False
        self._keep({name: views[name] for name in good}, good)
        return True

    def _keep(self, views: Mapping[str, Corners], outlines: Mapping[str, Floats]) -> None:
        number = str(len(self.kept))  # by which views of one instant are known
        self.kept.append({name: replace(view, source=number) for name, view in views.items()})
        self._outlines.append({**outlines})
        for name in outlines:
            self._poses.setdefault(name, []).append(self._pose(name, views[name]))
        if len(self.kept) % _FIT_EVERY == 0:
            self._sd_mm, self._problem = self._fitted_mm()

    @property
    def wants_a_closer_look(self) -> bool:
        """Whether no camera has seen the board for so long that `look_closer` is worth its time."""
        rounds, rest = divmod(self._unseen_looks, _CLOSER_LOOKS)
        return rest == 0 and rounds.bit_count() == 1  # each time after twice as many looks

    def look_closer(self, grays: Sequence[Bytes]) -> None:
        """See whether pictures (h, w) of one instant show another board, which is then said.

        It takes a second a picture: a camera that sees a part of it may take that for a smaller
        one, and so all are looked at. What was seen holds till the chosen board is.
        """
        self._other = other_board(self.board, grays) or self._other

    def state(self) -> WaveState:
        """How far it is."""
        cameras = {name: self._camera(name) for name in self.sizes_wh}
        pairs = pairs_seen(self.sizes_wh, self.kept)
        state = WaveState(cameras, pairs, self._sd_mm, self.goal_mm, (), self._other)
        return state if state.enough else replace(state, advice=self._lacks(cameras, pairs))

    def _lacks(
        self, cameras: Mapping[str, CameraWave], pairs: Mapping[tuple[str, str], int]
    ) -> tuple[str, ...]:
        """What to do next, the most useful first."""
        lacks = advice_of(cameras, pairs)
        if not lacks:
            lacks = [self._problem or "every camera: show the board in other places and tilts"]
        if self._other:
            lacks.insert(0, self._other.text)
        elif self._unseen_looks >= _UNSEEN_LOOKS:
            lacks.insert(0, f"no {self.board.title} is found: is it this one? Show all of it")
        return (*_at_once(cameras, self._look_s[0] - self._look_s[1]), *lacks)

    def _slip_px(self, name: str, at: Floats, times_s: Mapping[str, float]) -> float:
        """How far the board moved in this camera while the instant lasted."""
        lasted_s = max(abs(times_s[name] - other) for other in times_s.values())
        if not lasted_s:
            return 0.0
        before_s, before = self._before.get(name, (np.nan, at))
        since_s = times_s[name] - before_s
        return lasted_s * self._apart_px(at, before) / since_s if since_s > 0 else np.inf

    def _apart_px(self, one: Floats, other: Floats) -> float:
        """How far outlines lie apart; of a board that looks the same turned, the nearest two."""
        turns = range(0, 4, 4 // len(self.board.turns))
        return min(rms_length(np.roll(one, turn, axis=0) - other) for turn in turns)

    def _pitch_px(self, view: Corners) -> float:
        """Mean distance of neighbouring corners in a picture."""
        points = self.board.points[view.ids]
        apart_mm = np.linalg.norm(self.board.points[1:] - self.board.points[0], axis=1).min()
        spread_mm = rms_length(points - points.mean(axis=0))
        return float(apart_mm * rms_length(view.pixels - view.pixels.mean(axis=0)) / spread_mm)

    def _is_blurred(self, name: str, view: Corners) -> bool:
        usual = [one[name].sharpness for one in self.kept if name in one]
        return bool(usual) and view.sharpness < BLURRED_SHARE * float(np.median(usual))

    def _camera(self, name: str) -> CameraWave:
        tilts, far = np.array(self._poses.get(name, np.zeros((0, 2)))).T
        return CameraWave(
            len(far),
            cells_seen(self.sizes_wh[name], [view.pixels for view in self._views(name)]),
            int(np.sum(tilts > TILTED_DEG)),
            float(np.nanmax(far) / np.nanmin(far)) if np.isfinite(far).any() else np.nan,
            self._last.get(name, np.nan),
            self._now.get(name, Now.NOTHING),
        )

    def _pose(self, name: str, view: Corners) -> tuple[float, float]:
        """Tilt in degrees and distance in mm of the board, by an ordinary lens; NaN if by none."""
        width, height = self.sizes_wh[name]
        matrix = np.diag([USUAL_FOCAL * max(width, height)] * 2 + [1.0])
        matrix[:2, 2] = width / 2, height / 2
        plain = Intrinsics((width, height), matrix, np.zeros(5))
        try:
            pose = board_pose(plain, self.board.points[view.ids], view.pixels)
        except CalibrationError:
            return np.nan, np.nan
        tilt = float(np.degrees(np.arccos(min(abs(pose.rotation[2, 2]), 1.0))))
        return tilt, float(np.linalg.norm(pose.translation))

    def _views(self, name: str) -> list[Corners]:
        return [one[name] for one in self.kept if name in one]

    def _fitted_mm(self) -> tuple[float, str]:
        """The expected error of the body, by the views' covariance; NaN, and why, without one."""
        lenses, points = {}, self.board.points
        try:
            for name, size_wh in self.sizes_wh.items():
                views = choose_views(self.board, self._views(name), size_wh, name, None, ALL_VIEWS)
                start = start_intrinsics(size_wh, points, views.views)
                # As free as a lens may be: a stiffer one would promise more than it can keep.
                model = LENS_MODELS[3]
                fit = fit_lens(start, points, views.views, model, huber=1.0)
                lenses[name] = LensCalibration(fit, model, {}, (), views)
            return expected_mm(self.body, *fit_common_views(self.board, lenses)), ""
        except (CalibrationError, DegenerateGeometryError) as problem:
            return float("nan"), str(problem)  # too few views, too much alike, or mirrored
        except ValueError:
            return float("nan"), ""


Look = TypeVar("Look")


def is_new(
    looks: Mapping[str, Look],
    kept: Sequence[Mapping[str, Look]],
    apart_px: Callable[[Look, Look], float],
    sizes_wh: Mapping[str, tuple[int, int]],
    share: float,
) -> bool:
    """Whether a camera sees what is waved where it never did, or two that hardly shared a view.

    Args:
        looks: what cameras see at one instant.
        kept: the same at the instants that are kept.
        apart_px: how far two looks of a camera lie apart.
        sizes_wh: of the pictures.
        share: of their diagonal by which looks that differ lie apart.
    """
    least = {name: share * float(np.hypot(*sizes_wh[name])) for name in looks}

    def is_unlike(*names: str) -> bool:
        """Whether one of them is unlike at each instant that all of them shared."""
        return all(
            any(apart_px(looks[name], one[name]) > least[name] for name in names)
            for one in kept
            if {*names} <= {*one}
        )

    few = [pair for pair, count in pairs_seen(looks, kept).items() if count < _COMMON]
    return any(is_unlike(name) for name in looks) or any(is_unlike(*pair) for pair in few)


def pairs_seen(names: Iterable[str], kept: Sequence[Collection[str]]) -> dict[tuple[str, str], int]:
    """At how many instants two cameras saw at once what is waved, of all pairs."""
    return {pair: sum({*pair} <= {*one} for one in kept) for pair in combinations(names, 2)}


def cells_seen(size_wh: tuple[int, int], views: Sequence[Floats]) -> Floats:
    """How many pixels of views (k, 2) lie in each part (3, 3) of a picture."""
    width, height = size_wh
    pixels, ends = np.concatenate([np.zeros((0, 2)), *views]), ((0, height), (0, width))
    return np.histogram2d(pixels[:, 1], pixels[:, 0], bins=3, range=ends)[0]


def expected_mm(body: Body, cameras: tuple[Camera, ...], around: Floats, joint: Floats) -> float:
    """The expected error of a body's position by cameras and their joint covariance.

    3-D, one standard deviation, RMS over the workspace about places (n, 3) mm.
    """
    places = workspace_of(cameras, around).grid()
    poses = [RigidTransform(np.eye(3), place) for place in places]
    return rms_length(body_pose_sd(cameras, body, poses, joint)[0][:, None])


_MENDED = {
    Now.MIRRORED: "mirrored picture: switch off mirror mode in {}",
    Now.MOVING: "seen in {}: hold it still",
    Now.BLURRED: "blurred in {}: hold it still, or give more light",
    Now.FAR: "too far away in {}: come nearer",
}


def _at_once(cameras: Mapping[str, CameraWave], period_s: float) -> list[str]:
    """What keeps the board that is seen now from being taken, and how often it is looked for."""
    out = []
    for what, words in _MENDED.items():
        if names := [name for name, camera in cameras.items() if camera.now is what]:
            out.append(words.format(" and ".join(names)))
    if Now.MOVING in [camera.now for camera in cameras.values()] and period_s > _SLOW_S:
        out.append(f"this computer looks every {period_s:.1f} s: hold it still for so long")
    return out


def advice_of(
    cameras: Mapping[str, CameraWave], pairs: Mapping[tuple[str, str], int], what: str = "board"
) -> list[str]:
    """What each camera lacks, the one with the fewest views first; then what connects them."""
    out = []
    for name, seen in sorted(cameras.items(), key=lambda item: item[1].views):
        row, column = np.unravel_index(int(np.argmin(seen.cells)), seen.cells.shape)
        if not seen.views:
            out += [f"{name}: show the {what} to this camera"] if seen.now is Now.NOTHING else []
        elif not seen.cells[row, column]:
            out.append(f"{name}: show the {what} at the {_ROWS[row]} {_COLUMNS[column]}")
        elif seen.tilts < _TILTS:
            out.append(f"{name}: tilt the {what} more")
        elif seen.distances < _DISTANCES:
            out.append(f"{name}: hold the {what} nearer and farther away")
        elif seen.views < _FEWEST:
            out.append(f"{name}: show the {what} in more places")
    return out + [
        f"{' and '.join(pair)}: show the {what} to both at once"
        for pair in _unconnected(list(cameras), pairs)
    ]


def _unconnected(
    names: Sequence[str], pairs: Mapping[tuple[str, str], int]
) -> list[tuple[str, str]]:
    """The pairs that share too few views, by which cameras come to those that hang together."""
    reached, waiting, out = {*names[:1]}, {*names[1:]}, []
    while waiting:
        bridges = [pair for pair in pairs if len(reached & {*pair}) == 1]
        best = max(bridges, key=lambda pair: pairs[pair])
        if pairs[best] < _COMMON:
            out.append(best)
        reached |= {*best}
        waiting -= reached
    return out
