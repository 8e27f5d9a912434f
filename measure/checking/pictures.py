"""Findings on the pictures of a camera: duplicates, dropped frames, uneven stamps, damage, light.

Overexposed balls spoil detection, for their edges shift outwards, and so do grey pictures.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Bools, Bytes, Floats, Ints
from measure.checking.causes import ALL, Cause, Word
from measure.checking.finding import Finding, Level
from measure.checking.search import SearchSample
from measure.limits import CLEAR_RATIO, GAP_PERIODS
from measure.measuring.image_faults import SHARP_CAMERAS, DuplicateImages
from measure.model import Detection, Doubt, FrameSet
from measure.model.observations import FULL
from measure.reading import listed
from measure.session.timestamps import StampErrors

_NOTE_SHARE, _WEAK_SHARE = 0.02, 0.5
"""Largest shares of duplicates that are only noted, and that only weaken the results."""
_MAX_DROPPED_SHARE = 0.02


class DuplicateCount:
    """Counts duplicates among decoded images, for recordings whose files do not show them.

    Attributes:
        compared: frame numbers by camera.
        repeated: those of images that are the same as the one before, by camera.
        shared: those of the first of two cameras where both show the same exposure.
    """

    def __init__(self) -> None:
        self._duplicates = DuplicateImages()
        self.compared: dict[str, set[int]] = {}
        self.repeated: dict[str, set[int]] = {}
        self.shared: dict[tuple[str, str], set[int]] = {}

    def add(self, frame_set: FrameSet) -> None:
        """Compare each camera's picture with its last one."""
        for name, image in frame_set.images.items():
            self.compared.setdefault(name, set()).add(image.frame)
        found = self._duplicates.of(frame_set)
        for name in found.repeated:
            self.repeated.setdefault(name, set()).add(frame_set.images[name].frame)
        for pair in found.shared:
            self.shared.setdefault(pair, set()).add(frame_set.images[pair[0]].frame)

    def leave_out(self, frame_set: FrameSet, repeated: Sequence[str]) -> None:
        """Count images of a frame set that are known to repeat the ones before."""
        for name in repeated:
            self.repeated.setdefault(name, set()).add(frame_set.images[name].frame)

    def copying(self, searched: Sequence[SearchSample]) -> set[str]:
        """Of each two cameras that often show the same, the one whose balls agree less."""
        agreeing = Counter(ball.camera for sample in searched for ball in sample.agreeing)
        often = [p for p, same in self.shared.items() if len(same) > len(searched) / 4]
        return {min(reversed(pair), key=lambda name: agreeing[name]) for pair in often}

    def causes(self) -> list[Cause]:
        """Each two cameras that show the same pictures."""
        return [
            same_pictures_cause(a, b, f"{len(same)} of {len(self.compared[a])} compared")
            for (a, b), same in self.shared.items()
        ]


def same_pictures_cause(a: str, b: str, how_many: str) -> Cause:
    """Two cameras show the same pictures."""
    text = f"{a} and {b} hold the same pictures ({how_many})"
    remedy = (
        "one device under two names, or a wrong input of a video switch; give each camera an "
        "address of its own, and record anew"
    )
    return Cause(Word.SAME_PICTURES, f"{a}, {b}", text, remedy, Level.WRONG)


def repeated_causes(
    camera: str, repeated: Ints, compared: int, times_s: Floats, frames: Ints
) -> list[Cause]:
    """The cause if images are the same as the one before.

    Args:
        repeated: (k,) positions of the duplicates, increasing.
        compared: number of images compared with the one before.
        times_s: (n,) stamps of all images.
        frames: (n,) frame numbers of all images.
    """
    if not len(repeated):
        return []
    share = len(repeated) / max(compared, 1)
    runs = np.split(repeated, np.nonzero(np.diff(repeated) > 1)[0] + 1)
    longest = max(runs, key=len)
    level = Level.WRONG if share > _WEAK_SHARE else Level.WEAK
    level = Level.NOTE if share <= _NOTE_SHARE else level
    text = (
        f"{camera}: {len(repeated)} of {compared} pictures repeat the one before "
        f"({100 * share:.1f} %), at most {len(longest)} in a row, from frame "
        f"{frames[longest[0]]} at {times_s[longest[0]]:.3f} s: the camera or its driver stalled; "
        "they are not measured"
    )
    remedy = "record at a lower rate, or mend its cable or power"
    return [Cause(Word.REPEATED, camera, text, remedy, level)]


def stamp_findings(camera: str, times_s: Floats, frames: Ints) -> list[Finding]:
    """Dropped frames, uneven stamps (n,), which increase, and wrong units of one camera."""
    if len(times_s) < 3:
        return [
            Finding(Level.WEAK, "frames", Doubt("few-frames", camera=camera, count=len(times_s)))
        ]
    steps = np.diff(times_s)
    period = float(np.median(steps))
    gaps = np.nonzero(steps > GAP_PERIODS * period)[0]
    lost = int(np.sum(np.rint(steps[gaps] / period) - 1))
    notes = StampErrors.of(times_s).notes
    if burst_causes({camera: times_s}):
        return []
    out = [Finding(Level.WEAK, "clock", f"{camera}: {note}", code="stamps") for note in notes]
    if lost:
        worst = int(gaps[np.argmax(steps[gaps])])
        share = lost / (len(times_s) + lost)
        text = Doubt(
            "dropped-frames",
            camera=camera,
            lost=lost,
            percent=100 * share,
            gap_s=steps[worst],
            frame=str(frames[worst]),
            at=f"{times_s[worst]:.3f}",
        )
        level = Level.WEAK if share > _MAX_DROPPED_SHARE else Level.NOTE
        out.append(Finding(level, "frames", text))
    return out


_LEAST_BURSTS = 3  # From which on it is known that pictures come in bursts


def stamp_causes(times_s: Mapping[str, Floats]) -> list[Cause]:
    """Cameras of whose stamps it is known what they are, by the stamps alone."""
    return [*burst_causes(times_s), *rate_causes(times_s), *step_causes(times_s)]


def burst_causes(times_s: Mapping[str, Floats]) -> list[Cause]:
    """Cameras whose pictures arrive several at once, with stamps of their arrival."""
    out = []
    for camera, own in times_s.items():
        steps = np.diff(own)
        gaps = np.nonzero(steps > GAP_PERIODS * np.median(steps))[0] if len(steps) else steps
        sizes = np.diff(gaps)
        usual = [
            float(np.mean(np.diff(t))) for n, t in times_s.items() if n != camera and len(t) > 1
        ]
        if len(gaps) < _LEAST_BURSTS or not _comes_at_once(steps, usual):
            continue
        size = int(np.median(sizes))
        if size < 2 or np.mean(np.abs(sizes - size) <= 1) < 0.8:
            continue
        every_ms = 1e3 * float(np.median(np.diff(np.cumsum(steps)[gaps])))
        text = (
            f"{camera}: pictures arrive in bursts of {size} every {every_ms:.0f} ms "
            f"({every_ms / size:.0f} ms a picture on average): the stamps are of their arrival, "
            "not of their exposure"
        )
        cure = "let the camera stamp them, or spread each burst evenly"
        out.append(Cause(Word.CLOCK, camera, text, cure, Level.WRONG))
    return out


def _comes_at_once(steps: Floats, usual: Sequence[float]) -> bool:
    """Whether pictures follow each other faster than they can be taken, by other cameras' steps."""
    mean, median = np.mean(steps), np.median(steps)
    as_many = usual and abs(mean / np.median(usual) - 1) < _SAME_RATE
    return bool(mean > (GAP_PERIODS if as_many else CLEAR_RATIO) * median)


_SAME_RATE = 0.1  # Share by which mean steps differ at most of cameras that take as many pictures
_RATE_SHARE, _COUNT_SHARE = 0.03, 0.02
"""By which a camera's duration differs from the others', where its number of pictures does not."""
_EVEN_SHARE = 0.02  # By which mean and median step differ where no picture is missing


def rate_causes(times_s: Mapping[str, Floats]) -> list[Cause]:
    """Cameras whose stamps run at another rate: as many pictures last longer, or less long."""
    counts = {name: len(t) for name, t in times_s.items()}
    even = {n: t for n, t in times_s.items() if len(t) > 1 and _even(np.diff(t))}
    lasts_s = {name: float(t[-1] - t[0]) for name, t in even.items()}
    out = []
    for name, last_s in lasts_s.items():
        others = [n for n in lasts_s if n != name]
        if len(others) < 2:
            continue
        count = np.median([counts[n] for n in others])
        other_s = float(np.median([lasts_s[n] for n in others]))
        scatter = np.ptp([lasts_s[n] for n in others]) / max(other_s, 1e-9)
        ratio = last_s / max(other_s, 1e-9)
        same = abs(counts[name] / count - 1) < _COUNT_SHARE
        if same and scatter < _COUNT_SHARE and abs(ratio - 1) > _RATE_SHARE:
            text = (
                f"{name}: its {counts[name]} pictures last {last_s:.3f} s by its stamps, as many "
                f"of the others {other_s:.3f} s: the stamps run {ratio:.3f} times as fast as they "
                "should"
            )
            cure = "state the rate at which it was recorded, or give it stamps of its own"
            of_rate = 100 * (ratio - 1)
            out.append(Cause(Word.CLOCK, name, text, cure, Level.WRONG, of_rate, None, "%"))
    return out


def step_causes(times_s: Mapping[str, Floats]) -> list[Cause]:
    """Cameras whose clock was set while they recorded: a gap in their stamps, and no picture lost.

    They have as many pictures as the others, which last as long without the gap.
    """
    out = []
    for name, gaps in gaps_alone(times_s).items():
        own = times_s[name]
        others = [t for n, t in times_s.items() if n != name and len(t) > 1]
        if not len(gaps) or not others:
            continue
        at_s, gap_s = gaps[np.argmax(gaps[:, 1])].tolist()
        period_s = float(np.median(np.diff(own)))
        lasts_s = float(np.median([t[-1] - t[0] for t in others]))
        lost = abs(len(own) - float(np.median([len(t) for t in others])))
        without_s = own[-1] - own[0] - gap_s
        longer = (
            gap_s > _STEP_PERIODS * period_s and abs(without_s - lasts_s) < GAP_PERIODS * period_s
        )
        if longer and lost <= max(1.0, _COUNT_SHARE * len(own)):
            sd_s = float(np.std(np.diff(own)[np.diff(own) < GAP_PERIODS * period_s])) + _STAMP_S
            text = (
                f"{name}: the clock steps by {1e3 * gap_s:+.0f} +- {1e3 * sd_s:.0f} ms at about "
                f"{at_s:.2f} s: no picture was lost there"
            )
            cure = (
                f"add {-gap_s:+.4f} s to its stamps from there on; a clock that was set does this"
            )
            step_ms, sd_ms = 1e3 * gap_s, 1e3 * sd_s
            step = Cause(Word.CLOCK_STEP, name, text, cure, Level.WRONG, step_ms, sd_ms, "ms")
            out.append(replace(step, since_s=at_s))
    return out


_STEP_PERIODS = 3.0  # Shorter steps are left to the motion, which tells them from lost pictures
_STAMP_S = 0.001  # Of what stamps are known to at best


def without_step(times_s: Floats, cause: Cause) -> Floats:
    """Stamps as they were but for a step that `step_causes` found."""
    after = np.nonzero(np.diff(times_s) * 1e3 > (cause.estimate or 0.0))[0]
    out = times_s.copy()
    out[after[0] + 1 :] -= 1e-3 * (cause.estimate or 0.0)
    return out


def _even(steps: Floats) -> bool:
    return bool(abs(np.mean(steps) / np.median(steps) - 1) < _EVEN_SHARE)


def gaps_alone(times_s: Mapping[str, Floats]) -> dict[str, Floats]:
    """By camera (k, 2) when its stamps have a gap in which others have pictures of their own.

    And by how much it is longer than a step.
    """
    out = dict[str, Floats]()
    for name, own in times_s.items():
        others = np.sort(np.concatenate([t for n, t in times_s.items() if n != name] or [own]))
        steps = np.diff(own)
        period = float(np.median(steps)) if len(steps) else 0.0
        wide = steps > GAP_PERIODS * period
        first, last = own[:-1][wide], own[1:][wide]
        inside = np.searchsorted(others, last) - np.searchsorted(others, first, side="right")
        out[name] = np.stack([first, last - first - period], axis=1)[inside > 0]
    return out


def damage_findings(camera: str, frames: Sequence[int], count: int) -> list[Finding]:
    """One line if images, of `count` examined, are damaged: `frames` are their numbers."""
    if not frames:
        return []
    named = listed([str(frame) for frame in frames])
    which = "frames" if len(frames) > 1 else "frame"
    which, damaged = f"{which} {named}", len(frames)
    text = Doubt("damaged-pictures", camera=camera, damaged=damaged, looked=count, which=which)
    return [Finding(Level.WRONG, "frames", text)]


_MAX_SATURATED_SHARE = 0.1  # Of a ball's pixels: highlights of lamps and windows have less
_MIN_FRAME_SHARE = 0.5
_ROW_STEP, _BRIGHT_QUANTILE, _DARK_LEVEL = 4, 0.999, 75.0
"""Every so many rows are looked at; what is brightest in them, without single pixels; and the level
that it reaches in any picture with balls in it: 160 to 240, and 110 in 0.7 times the light."""
_PIXEL_STEP = 8
_MAX_CHANNEL_DIFFERENCE = 3
"""Levels between channels of a grey image, by rounding in JPEG; in colour, noise exceeds it."""


class ExposureCount:
    """Counts overexposed balls, and dark pictures."""

    def __init__(self) -> None:
        self._seen = Counter[tuple[str, str]]()
        self._overexposed = Counter[tuple[str, str]]()
        self._brightest: dict[str, list[float]] = {}

    def add(self, frame_set: FrameSet, balls: Sequence[Detection]) -> None:
        """Count the balls found in a frame set, and look at its pictures."""
        for name, image in frame_set.images.items():
            some = np.asarray(image.pixels)[::_ROW_STEP].max(axis=2)
            self._brightest.setdefault(name, []).append(float(np.quantile(some, _BRIGHT_QUANTILE)))
        for ball in balls:
            key = ball.camera, ball.ball
            full = _saturated(frame_set.images[ball.camera].pixels, ball)
            self._seen[key] += 1
            self._overexposed[key] += full.size > 0 and full.mean() > _MAX_SATURATED_SHARE

    def causes(self) -> list[Cause]:
        """Each camera with a ball overexposed in half of its images or more, or dark pictures."""
        bright: dict[str, list[str]] = {}
        for (camera, ball), count in self._overexposed.items():
            if count >= _MIN_FRAME_SHARE * self._seen[camera, ball]:
                bright.setdefault(camera, []).append(
                    f"{ball} in {count} of {self._seen[camera, ball]}"
                )
        shifted = "their edges show up to half a pixel further out, and lights look like balls"
        out = [
            _exposure(c, f"balls are overexposed ({', '.join(b)} pictures): {shifted}", "less time")
            for c, b in bright.items()
        ]
        dark = {c: np.median(levels) for c, levels in self._brightest.items()}
        dim = "its pictures are dark (99.9 % of pixels are below level {:.0f} of 255)".format
        return out + [
            _exposure(c, dim(level), "longer, or add light")
            for c, level in dark.items()
            if level < _DARK_LEVEL
        ]


def _exposure(camera: str, text: str, how: str) -> Cause:
    text = f"{camera}: {text}"
    return Cause(Word.EXPOSURE, camera, text, f"expose for {how}", Level.WEAK)


def _saturated(pixels: Bytes, ball: Detection) -> Bools:
    """Whether a channel is saturated (n,) in each pixel inside a ball's outline."""
    (x, y), r = ball.center_px.tolist(), ball.radius_px
    top, left = max(math.floor(y - r), 0), max(math.floor(x - r), 0)
    part = pixels[top : math.ceil(y + r) + 1, left : math.ceil(x + r) + 1]
    rows, columns = np.ogrid[: part.shape[0], : part.shape[1]]
    inside = (rows + top - y) ** 2 + (columns + left - x) ** 2 < r**2
    return np.asarray(part.max(axis=2) >= FULL)[inside]


def woven_causes(names: Sequence[str], count: int) -> list[Cause]:
    """Cameras, of so many, with many combed pictures."""
    if not names:
        return []
    text = f"pictures of {', '.join(names)} are woven of two instants (edges look like combs)"
    cure = "interlaced: switch the camera to progressive pictures, and record again"
    of = ALL if len(names) == count else ", ".join(names)
    return [Cause(Word.INTERLACED, of, text, cure, Level.WRONG)]


def smear_causes(smear: Doubt | None, count: int) -> list[Cause]:
    """Cameras, of so many, whose pictures are blurred along one direction."""
    if smear is None:
        return []
    text = f"{smear}, whichever way the balls move (by the widths of their edges)"
    cure = "fix the cameras to what does not shake, and their focus; expose for less time"
    names = smear.names("cameras")
    sharp = count - len(names)
    level = Level.WRONG if sharp < SHARP_CAMERAS else Level.WEAK
    of = ", ".join(names) if sharp else ALL
    return [Cause(Word.BLURRED, of, text, cure, level, smear.values["width_px"], None, "px")]


def seen_causes(doubts: Sequence[Doubt], count: int) -> list[Cause]:
    """Woven and blurred pictures that measurements name, at last, of so many cameras."""
    found = {one.code: one for one in doubts}
    woven = found.get(Word.INTERLACED)
    names = () if woven is None else woven.names("cameras")
    return woven_causes(names, count) + smear_causes(found.get(Word.BLURRED), count)


_MAX_TINT = 0.15
"""Logarithm of how much blue or red may change against green: balls are searched with as much."""
_DARKEST, _BRIGHTEST, _LEAST_SHARE = 10, 245, 0.1
"""Levels between which colours are compared, if so large a part of the picture is."""


class ColorCount:
    """Counts images without colour, and follows the colours of what does not move."""

    def __init__(self) -> None:
        self._seen, self._colorless = Counter[str](), Counter[str]()
        self._first, self._change = dict[str, Bytes](), dict[str, Floats]()

    def add(self, frame_set: FrameSet) -> None:
        """Compare the channels of each camera's picture, and with those of its first one."""
        for name, image in frame_set.images.items():
            some = np.asarray(image.pixels)[::_PIXEL_STEP, ::_PIXEL_STEP]
            self._seen[name] += 1
            self._colorless[name] += bool(np.ptp(some, axis=2).max() <= _MAX_CHANNEL_DIFFERENCE)
            both = np.stack([self._first.setdefault(name, some), some])
            clear = np.all((both > _DARKEST) & (both < _BRIGHTEST), axis=(0, 3))
            if clear.mean() > _LEAST_SHARE:
                first, now = np.log(both[:, clear], dtype=np.float32)
                change = np.median(now - first, axis=0)  # What moves covers less than half of it
                both_changes = self._change.get(name, 0 * change), change - change[1]
                self._change[name] = max(both_changes, key=_largest)

    def findings(self) -> list[Finding]:
        """One line for each camera whose pictures have no colour."""
        grey = {name: count for name, count in self._colorless.items() if count}
        texts = [
            Doubt("grey-pictures", camera=name, grey=count, looked=self._seen[name])
            for name, count in grey.items()
        ]
        return [Finding(Level.WRONG, "colour", text) for text in texts]

    def causes(self) -> list[Cause]:
        """The cameras whose colours drift, with the largest change."""
        drifting = {n: one for n, one in self._change.items() if _largest(one) > _MAX_TINT}
        if not drifting:
            return []
        blue, _, red = 100 * np.expm1(max(drifting.values(), key=_largest))
        names = ", ".join(drifting)
        text = f"{names}: against green, blue drifts by {blue:+.0f} % and red by {red:+.0f} %"
        cure = "lock the white balance; light that changes colour (dusk, a cold lamp) looks alike"
        return [Cause(Word.EXPOSURE, names, text, cure, Level.WEAK)]


def _largest(change: Floats) -> float:
    return float(np.abs(change).max())
