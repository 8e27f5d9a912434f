"""Pictures filed under the wrong camera, mirrored or upside down: what makes the cameras agree.

Balls found in whole pictures are associated as they are, and as each such mistake would have them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import ClassVar

import numpy as np

from measure.checking.causes import ALL, Cause, Word
from measure.checking.finding import Level
from measure.checking.search import SearchSample, search_sample
from measure.model import Body, Camera, Detection

_FEWEST, _TRIED = 3, 6  # Frame sets
_AGREES, _BELIEVED = 0.5, 0.8
"""Shares of them from which all cameras agree as they are, and with a mistake undone."""
_FEW = 4  # Cameras up to which every order is tried; of more, exchanges of two
_TURNS = {"left to right": (-1, 1), "upside down": (-1, -1), "top to bottom": (1, -1)}
"""By how a picture is stored, the signs of its coordinates about its middle."""

Seen = Mapping[str, Sequence[Detection]]
"""Balls found in whole pictures of one frame set, by camera name."""


@dataclass(frozen=True)
class _Exchanged:
    """Pictures that are under the names of other cameras."""

    source: Mapping[str, str]  # by camera, the one whose pictures are under its name
    word: ClassVar[Word] = Word.EXCHANGED_CAMERAS
    cure: ClassVar[str] = (
        "exchange them in session.toml, and where the cameras' addresses are given"
    )

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras concerned."""
        return tuple(self.source)

    @property
    def instead(self) -> Mapping[str, str]:
        """By camera the one whose pictures are under its name."""
        return self.source

    def undone(self, seen: Seen, cameras: Mapping[str, Camera]) -> Seen:
        """What would have been found without it."""
        under = {shown: name for name, shown in self.source.items()}
        return {
            name: [replace(d, camera=name) for d in seen.get(under.get(name, name), ())]
            for name in cameras
        }

    def __str__(self) -> str:
        pairs = (f"under {name} are those of {shown}" for name, shown in self.source.items())
        return f"the pictures of cameras are exchanged: {', '.join(pairs)}"


@dataclass(frozen=True)
class _TurnedOver:
    """Pictures of some cameras that are mirrored or upside down."""

    names: tuple[str, ...]
    way: str  # of `_TURNS`
    word: ClassVar[Word] = Word.MIRRORED
    cure: ClassVar[str] = "turn that off in the camera or its driver, and record again"

    def undone(self, seen: Seen, cameras: Mapping[str, Camera]) -> Seen:
        """What would have been found without it."""
        return {
            **seen,
            **{name: self._back(seen.get(name, ()), cameras[name]) for name in self.names},
        }

    def _back(self, detections: Sequence[Detection], camera: Camera) -> list[Detection]:
        signs = np.array(_TURNS[self.way])
        middle = (np.array(camera.intrinsics.size_wh) - 1) / 2
        return [
            replace(
                d,
                center_px=middle + signs * (d.center_px - middle),
                covariance_px=d.covariance_px * np.outer(signs, signs),
                outline_px=None,
                outline_sd_px=None,
            )
            for d in detections
        ]

    def __str__(self) -> str:
        how = {"left to right": "mirrored", "top to bottom": "mirrored top to bottom"}
        return f"the pictures of {', '.join(self.names)} are {how.get(self.way, self.way)}"

    @property
    def instead(self) -> Mapping[str, str]:
        """By camera how its pictures are stored."""
        return dict.fromkeys(self.names, self.way)


def arrangement_causes(
    seen: Sequence[Seen], searched: Sequence[SearchSample], body: Body, cameras: Sequence[Camera]
) -> list[Cause]:
    """The mistake without which all cameras agree, if they contradict each other as they are.

    Where several mistakes explain it, the one that concerns the fewest cameras is named; none, if
    two of those do. Frame sets in which no two cameras see two balls tell nothing.

    Args:
        searched: what was found in `seen`, frame set by frame set.
    """
    pairs = [(one, s) for one, s in zip(seen, searched, strict=True) if _tells(one)]
    some = pairs[:: max(1, -(-len(pairs) // _TRIED))]
    as_it_is = _agreeing(sample for _, sample in some)
    if len(some) < _FEWEST or as_it_is >= _AGREES * len(some):
        return []
    by_name = {camera.name: camera for camera in cameras}
    found: list[tuple[int, _Exchanged | _TurnedOver]] = []
    for mistake in _mistakes(by_name):
        undone = (mistake.undone(one, by_name) for one, _ in some)
        again = (search_sample(one, body, cameras, 0.0) for one in undone)
        agreeing = _agreeing(sample for sample in again if _shown_by(mistake.names, sample))
        if agreeing >= _BELIEVED * len(some):
            found.append((agreeing, mistake))
    least = min((len(mistake.names) for _, mistake in found), default=0)
    fewest = [row for row in found if len(row[1].names) == least]
    if len(fewest) != 1:
        return []
    ((agreeing, mistake),) = fewest
    text = (
        f"{mistake}; with that undone all cameras agree in {agreeing} of {len(some)} frame sets, "
        f"as it is in {as_it_is}"
    )
    remedy = f"{mistake.cure}; nothing else is judged before"
    of = ALL if len(mistake.names) == len(cameras) else ", ".join(mistake.names)
    return [Cause(mistake.word, of, text, remedy, Level.WRONG, instead=mistake.instead)]


def _mistakes(cameras: Mapping[str, Camera]) -> Iterator[_Exchanged | _TurnedOver]:
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
            yield _Exchanged(moved)
    for way in _TURNS:
        for turned in (*((name,) for name in names), tuple(names)):
            yield _TurnedOver(turned, way)


def _tells(seen: Seen) -> bool:
    return sum(len({d.ball for d in found}) > 1 for found in seen.values()) > 1


def _agreeing(searched: Iterable[SearchSample]) -> int:
    """In how many frame sets the body was found, and no camera sees balls elsewhere."""
    return sum(s.world_from_body is not None and not s.disagreeing_cameras for s in searched)


def _shown_by(names: Sequence[str], sample: SearchSample) -> bool:
    """Whether cameras show the body that was found: one ball alone may lie there by chance."""
    count = Counter(detection.camera for detection in sample.agreeing)
    return all(count[name] > 1 for name in names)
