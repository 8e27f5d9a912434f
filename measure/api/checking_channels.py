"""Red and blue exchanged in pictures: balls are searched for with the two put back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.api.measuring import search_frame_sets
from measure.checking import Level, SearchSample, search_sample
from measure.checking.causes import ALL, Cause, Word
from measure.host import Detector
from measure.model import Detection, Expectation, Image
from measure.session import Session

_TRIED = 4  # Frame sets
_SEES_FEW, _SEES = 0.55, 0.6
"""Shares of the balls that a camera finds of a body whose pose is known, with the channels wrong
(blue and orange, of four, are then each other), and with them put back."""


def channel_causes(
    session: Session,
    detectors: Mapping[str, Detector],
    searched: Sequence[SearchSample],
    found: Sequence[Mapping[str, Sequence[Detection]]],
    chosen: Sequence[int],
) -> list[Cause]:
    """Cameras that find the balls, of colours as pure, only once red and blue are exchanged.

    Args:
        searched: what was seen in the frame sets `chosen`.
        found: all that looked like a ball there.
    """
    posed = [k for k, sample in enumerate(searched) if sample.world_from_body is not None]
    names, balls = list(session.streams), len(session.body.balls)
    if len(posed) < len(searched) / 2:
        suspects, some = names, list(range(len(searched)))
    else:
        seen = {n: np.mean([_agreeing(searched[k], n) for k in posed]) / balls for n in names}
        suspects, some = [n for n in names if seen[n] < _SEES_FEW], posed
    tried = [some[k] for k in np.unique(np.linspace(0, len(some) - 1, _TRIED).round().astype(int))]
    if not suspects or not some:
        return []
    before = {chosen[k]: found[k] for k in tried}
    right = _exchanged(session, detectors, suspects, before)
    if right and len(suspects) < len(names):  # of all, some may see enough by chance
        right = max(right, _exchanged(session, detectors, names, before), key=len)
    if not right:
        return []
    of = ALL if len(right) == len(names) else ", ".join(right)
    text = (
        f"red and blue are exchanged in the pictures of {', '.join(right)}: the balls are found "
        f"with the two put back (in {len(tried)} frame sets tried)"
    )
    cure = "exchange the channels (BGR and RGB) where the pictures are written, and record again"
    instead = dict.fromkeys(right, "blue")
    return [Cause(Word.EXCHANGED_CHANNELS, of, text, cure, Level.WRONG, instead=instead)]


def _exchanged(
    session: Session,
    detectors: Mapping[str, Detector],
    suspects: Sequence[str],
    before: Mapping[int, Mapping[str, Sequence[Detection]]],
) -> list[str]:
    """Of suspects, those that find the balls with the channels put back.

    Args:
        before: what all found in some frame sets without.
    """
    put_back = {n: _PutBack(d) if n in suspects else d for n, d in detectors.items()}
    shares, purer = [], []
    again = search_frame_sets(session, [put_back], list(before))
    for seen, (frame_set, (now,)) in zip(before.values(), again, strict=True):
        sample = search_sample(now, session.body, session.cameras, frame_set.time_s)
        shares.append([_agreeing(sample, name) / len(session.body.balls) for name in suspects])
        purer.append(
            [_purity(now.get(name, ())) - _purity(seen.get(name, ())) for name in suspects]
        )
    if np.mean(purer) < 0:  # two colours are exchanged in the body file
        return []
    share = dict(zip(suspects, np.mean(shares, axis=0), strict=True))
    return [name for name in suspects if share[name] > _SEES]


def _agreeing(sample: SearchSample, camera: str) -> int:
    return sum(detection.camera == camera for detection in sample.agreeing)


def _purity(seen: Sequence[Detection]) -> float:
    """How well the best candidates of all balls match their colours, added up."""
    best: dict[str, float] = {}
    for one in seen:
        best[one.ball] = max(best.get(one.ball, 0.0), float(np.nan_to_num(one.color_match)))
    return sum(best.values())


class _PutBack(Detector):
    """A detector that is shown pictures with red and blue exchanged."""

    def __init__(self, detector: Detector) -> None:
        super().__init__(detector.config, detector.body, detector.camera)
        self._detector = detector

    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """What it finds then."""
        pixels = np.ascontiguousarray(image.pixels[:, :, ::-1])
        return self._detector.detect(
            Image(image.camera, image.frame, image.time_s, lambda: pixels), expected
        )
