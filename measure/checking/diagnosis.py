"""The causes of what a recording shows, in words: what is off, how much, and what mends it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.checking.causes import ALL, Cause, Word, significant
from measure.checking.clocks import CameraClock
from measure.checking.evidence import SEARCHED_PX, TRACKED_PX, Evidence
from measure.checking.explaining import Explanation, broadly_left, explain, fitted, wanders_px
from measure.checking.finding import Level
from measure.checking.hypotheses import Hypothesis, of_camera
from measure.checking.search import SearchSample
from measure.checking.sightings import evidence_of
from measure.measuring.measurement import Measurement
from measure.model import Body, Camera, Detection

_EXPLAINED = 0.5
"""Share that a cause explains, below which nothing that is known is named first."""
_UNEXPLAINED = {TRACKED_PX: 1.0, SEARCHED_PX: 2.0}
"""Mean square of residuals, in their stated variances, that no healthy recording leaves, by how
its balls were found: 0.1 to 0.4, and up to 0.6."""
_WELL_EXPLAINED = 0.4
"""And of balls that were followed, below which their causes need no second look: 0.1 to 0.25 where
nothing else is off."""
_CLOCK_WRONG_S, _CLOCK_NAMED_S = 0.002, 0.0005
_DRIFT_NAMED_PX = 0.5  # Over the recording
_RADIUS_WRONG = 0.05  # Share of a radius that no outline's bias is: less is measured with


@dataclass(frozen=True)
class Diagnosis:
    """What the ball-views of a recording say of its rig."""

    causes: tuple[Cause, ...] = ()  # the likeliest first
    # mean squares of the residuals in their stated variances: as the rig is stated, and with the
    # causes allowed for.
    misfit: float = 0.0
    left: float = 0.0
    evidence: Evidence | None = None  # what it explains
    found: tuple[Explanation, ...] = ()  # what of it was fitted

    @property
    def fits(self) -> bool:
        """Whether all that was seen agrees with the rig as it is stated."""
        return 0 < self.misfit < _UNEXPLAINED[TRACKED_PX]

    @property
    def wrong(self) -> bool:
        """Whether the likeliest cause is beyond doubt."""
        return any(cause.level is Level.WRONG for cause in self.causes[:1])

    @property
    def share(self) -> float:
        """What the likeliest cause explains of all."""
        return self.causes[0].explains if self.causes else 0.0

    @property
    def unexplained(self) -> bool:
        """Whether more is left than any healthy recording leaves."""
        return self.left > _UNEXPLAINED[SEARCHED_PX]

    @property
    def doubtful(self) -> bool:
        """Whether balls that were followed show more than its causes, all uncertain."""
        return bool(self.causes) and not self.wrong and self.left > _WELL_EXPLAINED


def diagnose(evidence: Evidence | None, squares: bool = False) -> Diagnosis:
    """Explain the evidence; `squares`: whether the calibration's scale is that of a board."""
    if evidence is None:
        return Diagnosis()
    found, misfit, fit = explain(evidence)
    reported = _without_consequences([one for one in found if _matters(evidence, one)])
    causes = significant(_cause(evidence, one, squares) for one in reported)
    seen_by = [evidence.cameras[k].name for k in np.unique(evidence.views)]
    if len(seen_by) == 2:
        causes = _of_two(evidence, causes)
    left = 0.0 if fit is None else fit.left
    most = _UNEXPLAINED[evidence.systematic_px]
    if fit and left > (_WELL_EXPLAINED if found else most):
        broadly, camera = broadly_left(evidence, fit)
        suspect = found[0].hypothesis.of if found else camera or ""
        if size_px := wanders_px(evidence, fit, suspect):
            who = seen_by if len(seen_by) == 2 else [suspect]
            causes = [c for c in causes if c.of not in (suspect, ", ".join(who))]
            causes.insert(0, _wandering(who, size_px, not found or found[0].wrong))
        elif broadly > most and sum(one.explains for one in found[:1]) < _EXPLAINED:
            causes.insert(0, _unknown(camera if len(seen_by) > 2 else None, causes))
    return Diagnosis(tuple(causes), misfit, left, evidence, tuple(found))


_EITHER = (Word.MOVED, Word.MOVED_AT, Word.ZOOM, Word.POINT)
"""What may be of the one or the other of two cameras."""


def _of_two(evidence: Evidence, causes: Sequence[Cause]) -> list[Cause]:
    """Of two cameras that contradict each other it is open which is off, and how."""
    either = [cause for cause in causes if cause.cause in _EITHER]
    if not either:
        return list(causes)
    index = np.unique(evidence.views).tolist()
    first, other = (evidence.cameras[k].name for k in index)
    fits = [
        (fitted(evidence, (one,)), evidence.cameras[k].intrinsics.focal_px)
        for k, name in zip(index, (first, other), strict=True)
        for one in of_camera(evidence, k, name)
        if one.word is Word.MOVED
    ]
    fit, focal_px = min(fits, key=lambda pair: pair[0].cost)
    size_px, sd_px = focal_px * fit.amount.size, focal_px * fit.amount.sd
    text = (
        f"{first} and {other} contradict each other by {size_px:.0f} +- {sd_px:.0f} px: one of "
        "them was moved"
    )
    remedy = "two cameras cannot tell: calibrate both again, or add a third camera"
    blamed = [rival for c in either for rival in (f"{c.cause} of {c.of}", *c.rivals)]
    rivals = [r for r in dict.fromkeys(blamed) if not r.startswith(f"{Word.MOVED} of ")]
    whole = Cause(
        Word.MOVED, f"{first}, {other}", text, remedy, either[0].level, size_px, sd_px, "px",
        explains=either[0].explains, rivals=tuple(rivals), since_s=either[0].since_s,
    )  # fmt: skip
    return significant(whole if c is either[0] else c for c in causes if c not in either[1:])


def diagnose_recording(
    searched: tuple[Sequence[SearchSample], Sequence[Mapping[str, Sequence[Detection]]]],
    measured: Sequence[Measurement],
    body: Body,
    cameras: Sequence[Camera],
    gaps_s: Mapping[str, Floats],
    squares: bool,
) -> Diagnosis:
    """Explain what was searched and measured; the arguments of `evidence_of` and `diagnose`."""
    both = evidence_of(*searched, measured, body, cameras, gaps_s)
    followed = diagnose(both, squares)
    if not measured or followed.left < _WELL_EXPLAINED:
        return followed
    if followed.unexplained:  # In light of another colour a search finds other things than balls
        alone = evidence_of((), (), measured, body, cameras, gaps_s)
        if alone is not None and not alone.hardly_seen():
            tracked = diagnose(alone, squares)
            if tracked.misfit < _WELL_EXPLAINED:
                return tracked
    # What is followed lies near where it was expected: whole pictures tell more, if they agree.
    whole = diagnose(evidence_of(*searched, (), body, cameras, gaps_s), squares)
    if whole.causes and (whole.wrong, whole.share) >= (followed.wrong, followed.share):
        return whole
    # What no camera alone contradicts, and all do not in whole pictures, is not unknown.
    known = tuple(c for c in followed.causes if (c.cause, c.of) != (Word.UNKNOWN, ALL))
    return replace(followed, causes=known) if known and whole.fits else followed


def _wandering(who: Sequence[str], size_px: float, sure: bool) -> Cause:
    """A picture that wanders: of one camera, or of either of two, which cannot tell."""
    wanders = "its picture wanders against the others'"
    if len(who) == 2:
        wanders = "the picture of one of them wanders against the other's"
    return Cause(
        Word.UNKNOWN,
        ", ".join(who),
        f"{' and '.join(who)}: {wanders}, by {size_px:.1f} px RMS",
        "switch image stabilisation off, and fix the camera; else its frames are not where their "
        "stamps say",
        Level.WRONG if sure else Level.WEAK,
    )


def _unknown(camera: str | None, others: Sequence[Cause]) -> Cause:
    who = "the cameras contradict each other" if camera is None else f"{camera} contradicts others"
    return Cause(
        Word.UNKNOWN,
        camera or ALL,
        f"{who}, and no error of a clock, a camera, the body or the scale explains most of it",
        "look at the pictures: a picture that is stabilised, another body, frames that are not "
        "where their stamps say",
        Level.WRONG,
        explains=0.0,
        rivals=tuple(f"{cause.cause} of {cause.of}" for cause in others[:1]),
    )


def _matters(evidence: Evidence, one: Explanation) -> bool:
    """Whether it is large enough to be reported."""
    if one.hypothesis.word is Word.DRIFT:
        names = [camera.name for camera in evidence.cameras]
        lens = evidence.cameras[names.index(one.hypothesis.of)].intrinsics
        way = one.fit.amount.size * float(np.ptp(evidence.times_s))
        return lens.focal_px * way >= _DRIFT_NAMED_PX
    return one.hypothesis.word is not Word.CLOCK or _off_s(evidence, one) >= _CLOCK_NAMED_S


def _off_s(evidence: Evidence, one: Explanation) -> float:
    """By how much a clock is off at most."""
    off = one.hypothesis.profile(evidence.times_s) @ one.fit.last()[0]
    return float(np.max(np.abs(off)))


def _without_consequences(found: Sequence[Explanation]) -> list[Explanation]:
    """All but where a zoomed camera points, and one whose clock steps from then on.

    It zooms about another point than the principal one; and it sees what moves elsewhere.
    """
    said, out = set[tuple[Word, str]](), []
    for one in found:
        word, of = one.hypothesis.word, one.hypothesis.of
        said.add((word, of))
        zoomed = said & {(Word.ZOOM, of), (Word.ZOOM, "")}
        stepped = word is Word.MOVED_AT and (Word.CLOCK_STEP, of) in said
        if not (stepped or (word in (Word.MOVED, Word.POINT) and zoomed)):
            out.append(one)
    return out


def _cause(evidence: Evidence, one: Explanation, squares: bool) -> Cause:
    """In words."""
    hypothesis = one.hypothesis
    values, (what, size, sd) = one.fit.last()[0], one.fit.amount
    part = _Search(evidence, hypothesis, values, what, size, sd)
    level = Level.WRONG if one.wrong else Level.WEAK
    harmless = (
        hypothesis.word is Word.ROLLING
        or (hypothesis.word is Word.CLOCK and _off_s(evidence, one) <= _CLOCK_WRONG_S)
        or (hypothesis.word is Word.RADIUS and size <= _RADIUS_WRONG)
    )
    level = Level.WEAK if harmless else level
    estimate, sd, unit, text, remedy = _WORDING[hypothesis.word](part)
    names = [r.hypotheses[-1] for r in one.rivals]
    rivals = [f"{h.word} of {h.of or ALL}" for h in names]
    word = hypothesis.word
    if word is Word.SCALE:
        rivals.append(f"{Word.SCALE if squares else Word.SQUARE} of {ALL}")
        word = Word.SQUARE if squares else Word.SCALE
    nothing = 1.0 if unit == "times" else 0.0
    if unit == "mm" and hypothesis.word is Word.RADIUS:
        nothing = float(evidence.body.radii[evidence.body.index(hypothesis.of)])
    since_s = None if hypothesis.since is None else float(evidence.times_s[hypothesis.since])
    return Cause(
        word, hypothesis.of or ALL, text, remedy, level, estimate, sd, unit, nothing, one.explains,
        tuple(rivals), since_s,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Search:
    """A hypothesis with its parameters."""

    evidence: Evidence
    hypothesis: Hypothesis
    values: Floats  # (q,)
    what: str  # of an `Amount`
    size: float
    sd: float

    @property
    def since(self) -> str:
        """From when on, in words."""
        if self.hypothesis.since is None:
            return ""
        return f"{self.evidence.times_s[self.hypothesis.since]:.2f} s"

    @property
    def who(self) -> str:
        """Whose."""
        return self.hypothesis.of or "all cameras"

    def shifts_px(self) -> Floats:
        """How far (n, 2) the views concerned are moved in their pictures."""
        states = np.zeros(len(self.evidence), np.int64)
        rig = self.hypothesis.basis @ self.values
        poses = self.evidence.poses
        here = self.evidence.linearised(poses, np.zeros((1, len(rig))), states)
        there = self.evidence.linearised(poses, rig[None], states)
        white = here.residuals - there.residuals
        moved = np.linalg.solve(self.evidence.whitening, white[:, :, None])[:, :2, 0]
        index = [camera.name for camera in self.evidence.cameras].index(self.hypothesis.of)
        return np.asarray(moved[self.evidence.views == index])


_Told = tuple[float, float, str, str, str]
"""Estimate, its standard deviation and unit; what is off; and what mends it."""


def _clock(part: _Search) -> _Told:
    if part.hypothesis.drifts:
        return _rate_told(part)
    return _clock_told(part.who, float(part.values[0]), part.sd)


def _clock_told(camera: str, off_s: float, sd_s: float) -> _Told:
    text = f"{camera}: the clock is {1e3 * off_s:+.1f} +- {1e3 * sd_s:.1f} ms off the others"
    remedy = f"add {off_s:+.4f} to its time_offset_s in session.toml (`measure sync` does)"
    return 1e3 * off_s, 1e3 * sd_s, "ms", text, remedy


def _rate_told(part: _Search) -> _Told:
    """Of a clock that drifts: what is to be added to its stamps grows."""
    rate, times_s = float(part.values[-1]), part.evidence.times_s
    sd, fast = part.sd, "slow" if rate > 0 else "fast"
    text = (
        f"{part.who}: its stamps run {100 * abs(rate):.2f} +- {100 * sd:.2f} % {fast}, "
        f"{1e3 * abs(rate) * float(np.ptp(times_s)):.0f} ms in {float(np.ptp(times_s)):.1f} s"
    )
    remedy = (
        "was it recorded at another rate than is stated, have pictures been lost, or does its "
        f"clock drift? Give it stamps of its own, or take its rate {1 - rate:.5f} times as high"
    )
    return -100 * rate, 100 * sd, "%", text, remedy


def clock_cause(camera: str, ahead_s: float, rest: CameraClock | None) -> Cause:
    """A clock that was set right by so much, and what is left of it."""
    known = rest is not None and rest.offset_sd_s < np.inf
    off_s, sd_s = (rest.offset_s, rest.offset_sd_s) if known and rest else (0.0, _CLOCK_NAMED_S)
    estimate, sd, unit, text, remedy = _clock_told(camera, ahead_s + off_s, sd_s)
    return Cause(Word.CLOCK, camera, text, remedy, Level.WRONG, estimate, sd, unit)


def _clock_step(part: _Search) -> _Told:
    off_s, sd_s = float(part.values[0]), part.sd
    gap_s = part.evidence.gap_s(part.who, part.hypothesis.since or 0)
    if gap_s and abs(off_s + gap_s) < gap_s / 2:  # the stamps themselves say how much
        off_s, sd_s = -gap_s, 2 * _CLOCK_NAMED_S
    text = (
        f"{part.who}: the clock steps by {-1e3 * off_s:+.0f} +- {1e3 * sd_s:.0f} ms at about "
        f"{part.since}"
    )
    remedy = (
        f"add {off_s:+.4f} s to its stamps from there on; a dropped second, a reconnect or a clock "
        "that was set does this"
    )
    return -1e3 * off_s, 1e3 * sd_s, "ms", text, remedy


def _shift_px(part: _Search) -> float:
    return float(np.linalg.norm(np.median(part.shifts_px(), axis=0)))


def _moved(part: _Search) -> _Told:
    remedy = (
        "was it touched? calibrate it again (`measure calibrate`, or "
        f"`measure refine SESSION --only {part.hypothesis.of} -o calibration.toml`)"
    )
    deg, sd = float(np.degrees(part.size)), float(np.degrees(part.sd))
    if part.what == "shift":
        text = (
            f"{part.who} stands {part.size:.1f} +- {part.sd:.1f} mm from where its calibration says"
        )
        return part.size, part.sd, "mm", text, remedy
    if part.what == "roll":
        deg *= float(np.sign(part.values[5]))
        text = f"{part.who} is rolled by {deg:+.2f} +- {sd:.2f} deg about where it looks"
        return deg, sd, "deg", text, remedy
    text = (
        f"{part.who} points {deg:.2f} +- {sd:.2f} deg beside where its calibration says "
        f"({_shift_px(part):.1f} px)"
    )
    if part.what:
        text += f", or stands some {np.linalg.norm(part.values[:3]):.1f} mm from there"
    return deg, sd, "deg", text, remedy


def _moved_at(part: _Search) -> _Told:
    turn, sd = float(np.degrees(part.size)), float(np.degrees(part.sd))
    text = (
        f"{part.who} was moved by {_shift_px(part):.1f} px ({turn:.2f} deg) at about {part.since}"
    )
    return turn, sd, "deg", text, "measure up to there, or calibrate it again for the rest"


def _drift(part: _Search) -> _Told:
    rate, sd = (60 * float(np.degrees(x)) for x in (part.size, part.sd))
    text = f"{part.who} drifts by {rate:.2f} +- {sd:.2f} deg a minute"
    remedy = "does its stand sag, or does it warm up? let it run warm, fasten it, calibrate again"
    return rate, sd, "deg/min", text, remedy


def _zoom(part: _Search) -> _Told:
    estimate, sd = 100 * float(np.expm1(part.values[0])), 100 * part.sd
    amount = f"{estimate:+.2f} +- {sd:.2f} %"
    if part.since:
        text = f"{part.who}: its focal length is {amount} off its calibration from {part.since} on"
        return estimate, sd, "%", text, "switch auto-focus and zoom off, and record again"
    text = f"{part.who}: its focal length is {amount} off its calibration"
    remedy = "was it focused or zoomed, or is another resolution or crop set? calibrate "
    if not part.hypothesis.of:
        text = f"the focal lengths of all cameras are {amount} off their calibration"
        return estimate, sd, "%", text, f"{remedy}them again"
    remedy += f"it, or `measure refine SESSION --only {part.hypothesis.of} -o calibration.toml`"
    return estimate, sd, "%", text, remedy


def _point(part: _Search) -> _Told:
    x, y = part.values.tolist()
    whose = f"{part.who}: its principal point is"
    if not part.hypothesis.of:
        whose = "the principal points of all cameras are"
    text = f"{whose} ({x:+.1f}, {y:+.1f}) +- {part.sd:.1f} px off calibration"
    return part.size, part.sd, "px", text, "is another crop or resolution set? calibrate the lens"


def _scale(part: _Search) -> _Told:
    factor = float(np.exp(part.values[0]))
    text = (
        f"the balls are {factor:.4f} +- {part.sd:.4f} times as far apart as the body file says, "
        "and look as large as that: the scale of the calibration is off by this factor"
    )
    remedy = (
        "was the printed board's square measured? Calibrate again with a square_mm "
        f"{1 / factor:.4f} times as large; callipers on two balls tell whether the body file errs"
    )
    return factor, part.sd, "times", text, remedy


def _radius(part: _Search) -> _Told:
    share = float(np.expm1(part.values[0]))
    size = "larger" if share > 0 else "smaller"
    cure = "measure with callipers, or state a larger radius_tolerance_mm"
    sizes = f"by {abs(share):.1%} +- {part.sd:.1%}"
    if not part.hypothesis.of:
        text = f"all balls look {size} than the body file says, {sizes}"
        return 100 * share, 100 * part.sd, "%", text, cure
    ball = part.evidence.body.balls[part.evidence.body.index(part.hypothesis.of)]
    radius, sd = ball.radius_mm * (1 + share), ball.radius_mm * part.sd
    text = (
        f"ball {ball.name} has a radius of {radius:.1f} +- {sd:.1f} mm, the file says "
        f"{ball.radius_mm:.1f} mm"
    )
    return radius, sd, "mm", text, cure


def _place(part: _Search) -> _Told:
    if not part.hypothesis.of:
        factor = float(np.exp(part.values[0]))
        body = part.evidence.body
        arm = float(np.linalg.norm(body.centers[0]))
        text = (
            f"the balls are {factor:.4f} +- {part.sd:.4f} times as far apart as the body file "
            f"says, and look no larger ({body.names[0]} then lies {factor * arm:.2f} mm from the "
            f"origin, not {arm:.2f} mm)"
        )
        remedy = "correct the places in the body file (`measure body` finds them)"
        return factor, part.sd, "times", text, remedy
    text = (
        f"ball {part.hypothesis.of} is not where the body file says, but {part.size:.2f} +- "
        f"{part.sd:.2f} mm from there"
    )
    evidence, ball = part.evidence, part.evidence.body.index(part.hypothesis.of)
    moved = (part.hypothesis.basis @ part.values)[evidence.place(ball)]
    x, y, z = np.round(evidence.body.centers[ball] + moved, 2) + 0.0
    remedy = (
        "correct its place in the body file, or fix the ball (center_mm of "
        f"{part.hypothesis.of}: ({x:.2f}, {y:.2f}, {z:.2f}) +- {part.sd:.2f})"
    )
    return part.size, part.sd, "mm", text, remedy


def _exchanged(part: _Search) -> _Told:
    *others, last = part.hypothesis.of.split(", ")
    text = (
        f"the colours of {', '.join(others)} and {last} are exchanged in the body file: what is "
        "seen fits when they change places"
    )
    return part.size, part.sd, "", text, "exchange them in the body file"


def _mirrored(part: _Search) -> _Told:
    text = "the balls form the mirror image of the body file"
    return part.size, part.sd, "", text, "one coordinate has the wrong sign in it: correct it"


def _rolling(part: _Search) -> _Told:
    readout = 1e3 * float(part.values[0])
    whose = f"{part.who}: its shutter rolls" if part.hypothesis.of else "all shutters roll"
    text = f"{whose}, {readout:.1f} +- {1e3 * part.sd:.1f} ms from the first row to the last"
    return readout, 1e3 * part.sd, "ms", text, "state readout_s in the calibration"


_WORDING: dict[Word, Callable[[_Search], _Told]] = {
    Word.CLOCK: _clock,
    Word.CLOCK_STEP: _clock_step,
    Word.MOVED: _moved,
    Word.MOVED_AT: _moved_at,
    Word.DRIFT: _drift,
    Word.ZOOM: _zoom,
    Word.POINT: _point,
    Word.SCALE: _scale,
    Word.RADIUS: _radius,
    Word.PLACE: _place,
    Word.ROLLING: _rolling,
    Word.EXCHANGED_BALLS: _exchanged,
    Word.MIRRORED: _mirrored,
}
