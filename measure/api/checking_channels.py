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
_SEES_FEW, _SEES = 0.45, 0.6
"""Shares of the balls that a camera finds of a body whose pose is known, with the channels wrong,
and with them put back."""


def channel_causes(
    session: Session,
    detectors: Mapping[str, Detector],
    searched: Sequence[SearchSample],
    chosen: Sequence[int],
) -> list[Cause]:
    """Cameras that find the balls only once red and blue are exchanged.

    Args:
        searched: what was seen in the frame sets `chosen`.
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
    put_back = {n: _PutBack(d) if n in suspects else d for n, d in detectors.items()}
    shares = []
    wanted = [chosen[k] for k in tried]
    for frame_set, (again,) in search_frame_sets(session, [put_back], wanted):
        sample = search_sample(again, session.body, session.cameras, frame_set.time_s)
        shares.append([_agreeing(sample, name) / balls for name in suspects])
    right = [n for n, share in zip(suspects, np.mean(shares, axis=0), strict=True) if share > _SEES]
    if not right:
        return []
    of = ALL if len(right) == len(names) else ", ".join(right)
    text = (
        f"red and blue are exchanged in the pictures of {', '.join(right)}: the balls are found "
        f"with the two put back (in {len(tried)} frame sets tried)"
    )
    cure = "exchange the channels (BGR and RGB) where the pictures are written, and record again"
    return [Cause(Word.EXCHANGED_CHANNELS, of, text, cure, Level.WRONG)]


def _agreeing(sample: SearchSample, camera: str) -> int:
    return sum(detection.camera == camera for detection in sample.agreeing)


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
