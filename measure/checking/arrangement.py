"""Pictures filed under the wrong camera, mirrored or upside down: what makes the cameras agree.

Balls found in whole pictures are associated as they are, and as each such mistake would have them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from measure.checking.finding import Finding, Level
from measure.measuring.association import associate
from measure.measuring.tracking.predictive.pose_checks import disagreeing_cameras
from measure.model import Body, Camera, Detection

_FEWEST, _TRIED = 3, 6  # Frame sets
_AGREES, _BELIEVED = 0.5, 0.8
"""Shares of them from which all cameras agree as they are, and with a mistake undone."""
_FEW = 4  # Cameras up to which every order is tried; of more, exchanges of two
_TURNS = {"mirrored": (-1, 1), "upside down": (-1, -1), "mirrored top to bottom": (1, -1)}
"""By what is wrong with a picture, the signs of its coordinates about its middle."""

Seen = Mapping[str, Sequence[Detection]]
"""Balls found in whole pictures of one frame set, by camera name."""


@dataclass(frozen=True)
class _Mistake:
    """What may have happened to the pictures: nothing, if both are empty."""

    source: Mapping[str, str]  # by camera, the other one whose pictures are under its name
    turned: tuple[str, ...] = ()  # cameras whose pictures are
    way: str = ""  # of `_TURNS`

    def undone(self, seen: Seen, cameras: Mapping[str, Camera]) -> Seen:
        """What would have been found without it."""
        under = {shown: name for name, shown in self.source.items()}
        return {
            name: [self._undone(d, cameras[name]) for d in seen.get(under.get(name, name), ())]
            for name in cameras
        }

    def _undone(self, detection: Detection, camera: Camera) -> Detection:
        if camera.name not in self.turned:
            return replace(detection, camera=camera.name)
        signs = np.array(_TURNS[self.way])
        middle = (np.array(camera.intrinsics.size_wh) - 1) / 2
        return replace(
            detection,
            center_px=middle + signs * (detection.center_px - middle),
            covariance_px=detection.covariance_px * np.outer(signs, signs),
            outline_px=None,
            outline_sd_px=None,
        )

    def __str__(self) -> str:
        if self.turned:
            return f"the pictures of {', '.join(self.turned)} are {self.way}"
        pairs = (f"under {name} are those of {shown}" for name, shown in self.source.items())
        return f"the pictures of cameras are exchanged: {', '.join(pairs)}"

    @property
    def cure(self) -> str:
        """What to do."""
        if self.turned:
            return "turn that off in the camera or its driver, and record again"
        return "exchange them in session.toml, and where the cameras' addresses are given"


def arrangement_findings(
    seen: Sequence[Seen], body: Body, cameras: Sequence[Camera]
) -> list[Finding]:
    """A line if cameras contradict each other, but agree once one such mistake is undone.

    Where several mistakes explain it, the one that concerns the fewest cameras is named; none, if
    two of those do. Frame sets in which no two cameras see two balls tell nothing.
    """
    shown = [one for one in seen if sum(len({d.ball for d in f}) > 1 for f in one.values()) > 1]
    some = shown[:: max(1, -(-len(shown) // _TRIED))]
    by_name = {camera.name: camera for camera in cameras}
    as_it_is = _agreeing(some, body, cameras)
    if len(some) < _FEWEST or as_it_is >= _AGREES * len(some):
        return []
    found: list[tuple[int, int, _Mistake]] = []
    for mistake in _mistakes(by_name):
        undone = [mistake.undone(one, by_name) for one in some]
        if (agreeing := _agreeing(undone, body, cameras)) >= _BELIEVED * len(some):
            found.append((len(mistake.source) + len(mistake.turned), agreeing, mistake))
    fewest = [row for row in found if row[0] == min(concerned for concerned, *_ in found)]
    if len(fewest) != 1:
        return []
    ((_, agreeing, mistake),) = fewest
    text = (
        f"{mistake}; with that undone all cameras agree in {agreeing} of {len(some)} frame sets, "
        f"as it is in {as_it_is}: {mistake.cure}; nothing else is judged before"
    )
    return [Finding(Level.WRONG, "cameras", text)]


def _mistakes(cameras: Mapping[str, Camera]) -> Iterator[_Mistake]:
    names = list(cameras)
    orders = (
        [dict(zip(names, order, strict=True)) for order in permutations(names)]
        if len(names) <= _FEW
        else [{a: b, b: a} for a, b in combinations(names, 2)]
    )
    for order in orders:
        moved = {name: shown for name, shown in order.items() if name != shown}
        if moved and all(
            cameras[name].intrinsics.size_wh == cameras[shown].intrinsics.size_wh
            for name, shown in moved.items()
        ):
            yield _Mistake(moved)
    for way in _TURNS:
        for turned in (*((name,) for name in names), tuple(names)):
            yield _Mistake({}, turned, way)


def _agreeing(some: Sequence[Seen], body: Body, cameras: Sequence[Camera]) -> int:
    """In how many frame sets the body is found, and no camera sees balls elsewhere."""
    found = [associate(body, cameras, seen) for seen in some]
    return sum(
        one.world_from_body is not None and not disagreeing_cameras(one, body, cameras, seen)
        for one, seen in zip(found, some, strict=True)
    )
