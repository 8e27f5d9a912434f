"""A recording mended: what is off is taken out of copies of its calibration, body and stamps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from measure.api.check import Look, Looking
from measure.api.outputs import check_folder, new_folder
from measure.api.profiles import DEFAULT_PROFILE, load_profile
from measure.checking.causes import ALL, Cause, Word, in_words
from measure.checking.explaining import Explanation
from measure.checking.finding import Finding, Level
from measure.checking.hypotheses import Hypothesis
from measure.checking.mending import LATER, MENDS, Estimate, kept_out_residual, mended, sharper
from measure.errors import ConfigError, MeasureError
from measure.geometry import squared_mahalanobis
from measure.host import Registry
from measure.measuring import Profile
from measure.model import Camera
from measure.processes import Progress, quiet
from measure.session import CameraSource, Session, SessionParts, open_session, session_file

_MOST_MENDS, _MOST_RIVALS, _SHARPENED = 5, 2, 2
_SAMPLES, _CLOCK_SAMPLES = 24, 300
"""Frame sets, spread over the recording, in which all is searched, and those measured from its
start."""
_FEWEST = 9  # Instants; a third of them is kept out
_BETTER = 0.95
"""Times the residuals of before, in the RMS, from which kept-out instants count as improved."""
_AS_GOOD = 1.1  # Times the mean square that the best leaves, up to which a rival explains as much
_SETTLED = 0.3  # Standard deviations, below which a second estimate changes nothing
_LOST = 0.02  # Share of frame sets that may lose their pose by a mend that lets the rest fit better
_AS_MENDED = "measure again what was changed, when you can"
_OF_A_CAMERA = (Word.MOVED, Word.MOVED_AT, Word.ZOOM, Word.POINT)
_SCALES = (Word.SCALE, Word.SQUARE, Word.PLACE, Word.RADIUS)


@dataclass(frozen=True)
class Fitness:
    """How well a recording fits what it is measured with."""

    # RMS of residuals at the instants kept out of all estimates, in their stated standard
    # deviations; None if too little of the body is seen together.
    residual_sd: float | None
    pose_share: float  # of the frame sets measured, those with a pose

    @classmethod
    def of(cls, look: Look) -> Fitness:
        """By a look at the recording, its stamps as they are stated."""
        if look.ahead_s:
            if look.as_stamped is None:  # its cameras have no time in common
                return cls(None, 0.0)
            look = look.as_stamped
        evidence = look.evidence
        known = evidence is not None and len(evidence.times_s) >= _FEWEST
        residual = kept_out_residual(evidence) if evidence is not None and known else None
        posed = [m.pose is not None for m in look.measured]
        share = float(np.mean(posed)) if posed else look.posed / max(len(look.searched), 1)
        return cls(residual, share)

    def better_than(self, before: Fitness) -> bool:
        """Whether kept-out instants fit clearly better, and no fewer frame sets have a pose."""
        if self.residual_sd is None or self.pose_share < before.pose_share - _LOST:
            return False
        if before.residual_sd is None:
            return self.pose_share > 0
        return self.residual_sd < _BETTER * before.residual_sd


@dataclass(frozen=True)
class Change(Finding):
    """What was off, and what was changed for it."""

    changed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Mended:
    """What was changed, and how the recording fits before and after."""

    session: str
    changed: tuple[Change, ...]  # in the order in which they were mended
    before: Fitness
    after: Fitness
    refused: str = ""  # why nothing was written; empty if it was
    left: tuple[Finding, ...] = ()  # what is wrong still

    def lines(self) -> list[str]:
        """What was off, by how much, what was changed, what is better, and what else it may be."""
        if self.refused:
            return [f"not mended: {self.refused}"]
        lines = [f"{self.session}: nothing to mend"]
        if self.changed:
            rivals = [rival for change in self.changed for rival in change.rivals]
            parts = {
                "what was off": [change.text for change in self.changed],
                "by how much": [_sized(change) for change in self.changed],
                "changed": [text for change in self.changed for text in change.changed],
                "better": [_compared(self.before, self.after)],
                "what else could be meant": rivals or ["nothing else explains as much"],
            }
            lines = [f"{name}: {'; '.join(texts)}" for name, texts in parts.items()]
        return [*lines, *(f"wrong still: {finding.text}" for finding in self.left)]


def _sized(change: Change) -> str:
    amount = "(it is so, or not)"
    if change.estimate is not None:
        sd = "" if change.sd is None else f" +- {change.sd:.2g}"
        amount = f"{change.estimate:+.4g}{sd} {change.unit}".strip()
    return f"{change.code} of {change.subject} {amount}"


def _compared(before: Fitness, after: Fitness) -> str:
    shares = [f"{100 * one.pose_share:.0f}" for one in (before, after)]
    return (
        f"instants that were kept out miss by {_sds(after)} SD (RMS), before by {_sds(before)}; "
        f"{shares[1]} % of the frame sets have a pose, before {shares[0]} %"
    )


def mend(
    session: Path,
    out: Path,
    registry: Registry,
    profile: Profile | str = DEFAULT_PROFILE,
    overwrite: bool = False,
    progress: Progress = quiet,
) -> Mended:
    """Correct faults in a copy of a session's calibration, body and timestamps.

    It mends what `check` names, one cause after the other, by two thirds of the recording, and
    keeps a mend only if the other third fits better. The session and its pictures stay as they
    are: the new folder names the pictures by their paths.

    Nothing is written, and the command's exit code is 3, where two causes that need different mends
    explain the recording, where a mend makes it fit no better, or where only a person can mend it.

    Args:
        session: the session's folder; it is only read.
        out: the folder to write, a session that `measure run` measures.
        profile: `precise`, or the path of a profile of your own (.toml).

    Raises:
        MeasureError: the recording cannot be read, or `out` cannot be written.
    """
    check_folder(out, overwrite, _MARK)
    with TemporaryDirectory() as scratch:
        with open_session(session, clocks_apart=True) as opened:
            parts, name = SessionParts.of(opened), opened.name
            _refuse_pictures_in(out, opened)
        mending = _Mending(registry, load_profile(profile), progress, Path(scratch))
        first = mending.looked_at(parts)
        last, changes, refused = mending.mended(first)
        wrong = tuple(c.finding for c in last.look.causes if c.level is Level.WRONG)
        found = Mended(name, tuple(changes), first.fitness, last.fitness, refused, wrong)
        if not refused:
            origin = {"mended_from": str(session_file(session).absolute())}
            mended = {"mended": [text for change in changes for text in change.changed]}
            provenance = {**last.parts.provenance, **origin, **(mended if changes else {})}
            with new_folder(out, overwrite, _MARK):
                out.mkdir(parents=True, exist_ok=True)
                replace(last.parts, provenance=provenance).write(out)
        return found


_MARK = "session.toml"


def _refuse_pictures_in(out: Path, session: Session) -> None:
    """Refuse to replace a folder that the recording itself is in."""
    inside = out.resolve()
    files = [session.path, *(file for stream in session.streams.values() for file in stream.files)]
    if any(inside in file.resolve().parents for file in files):
        raise ConfigError(f"{out}: the recording to be read is in it: give another folder")


@dataclass(frozen=True, eq=False)
class _State:
    """What a recording is measured with, and what a look at it shows."""

    parts: SessionParts
    look: Look
    fitness: Fitness

    def left(self, beside: Sequence[Hypothesis] = ()) -> float:
        """The mean square of the residuals at instants kept out, all that is `beside` allowed for.

        Where that is of other cameras than there are now, it is not.
        """
        evidence = self.look.evidence
        if evidence is None:
            return 0.0
        some = [one for one in beside if len(one.basis) == evidence.size]
        return kept_out_residual(evidence, some) ** 2


@dataclass(eq=False)
class _Mending:
    """How a recording is looked at; the arguments of `mend`."""

    registry: Registry
    profile: Profile
    progress: Progress
    scratch: Path
    _number: count[int] = field(default_factory=count)

    def looked_at(self, parts: SessionParts) -> _State:
        """Write what it is measured with into a folder of its own, and look."""
        folder = self.scratch / str(next(self._number))
        folder.mkdir()
        parts.write(folder)
        with open_session(folder, clocks_apart=True) as session:
            look = Looking(
                session, self.registry, self.profile, _SAMPLES, _CLOCK_SAMPLES, self.progress
            ).with_clocks_set()
        return _State(parts, look, Fitness.of(look))

    def mended(self, state: _State) -> tuple[_State, list[Change], str]:
        """One cause after the other mended; and why nothing is, if that is refused."""
        changes = list[Change]()
        while len(changes) < _MOST_MENDS:
            cause = _likeliest(state.look)
            if cause is None:
                break
            if not cause.mendable:
                return state, changes, "" if changes else _by_hand(cause)
            tried = self._tried(state, cause)
            good = [(one, then) for one, then in tried if then.fitness.better_than(state.fitness)]
            if not good:
                refused = _not_better(cause, tried, state) if cause.level is Level.WRONG else ""
                return state, changes, "" if changes else refused
            beside = [one.hypothesis for one in _others(state.look, cause)]
            left = {id(then): then.left(beside) for _, then in good}
            (cause, then), *others = sorted(good, key=lambda pair: left[id(pair[1])])
            for rival, other in others:
                if left[id(other)] < _AS_GOOD * left[id(then)] and not _alike(
                    cause, rival, then, other
                ):
                    return state, changes, "" if changes else _either(cause, rival)
            changes.append(_change(cause, state, then))
            state = then
        return state, changes, ""

    def _tried(self, state: _State, cause: Cause) -> list[tuple[Cause, _State]]:
        """The cause, and what explains as much, each mended by itself."""
        out = []
        for one, hypotheses in _rivals(state.look, cause):
            try:
                then = self._without(state, one, hypotheses)
            except (MeasureError, np.linalg.LinAlgError):
                continue  # such stamps, or such a body, cannot be
            if then is not None:
                out.append((one, then))
        return out

    def _without(
        self, state: _State, cause: Cause, hypotheses: Sequence[Hypothesis]
    ) -> _State | None:
        """The state without a cause: as it was found, then estimated again until it settles."""
        evidence, found = state.look.evidence, None
        if hypotheses and evidence is not None:
            found = Estimate.of(evidence, hypotheses[-1], hypotheses[:-1])
        elif evidence is not None and cause.cause is Word.PLACE:
            hypothesis = sharper(evidence, cause)
            found = None if hypothesis is None else Estimate.of(evidence, hypothesis)
        parts = mended(state.parts, cause, found)
        if parts is None:
            return None
        then = self.looked_at(parts)
        for _ in range(_SHARPENED):
            evidence = then.look.evidence
            hypothesis = None if evidence is None else sharper(evidence, cause)
            if evidence is None or hypothesis is None or len(evidence.times_s) < _FEWEST:
                break
            beside = [one for one in hypotheses[:-1] if len(one.basis) == evidence.size]
            found = Estimate.of(evidence, hypothesis, beside)
            if found.deviations < _SETTLED:
                break
            finer = mended(then.parts, cause, found)
            if finer is None:
                break
            again = self.looked_at(finer)
            if again.left() > _AS_GOOD * then.left():
                break
            then = again
        return then


def _likeliest(look: Look) -> Cause | None:
    """The first cause that is beyond doubt, else the first that may be mended."""
    certain = [cause for cause in look.causes if cause.level is Level.WRONG]
    weak = [c for c in look.causes if c.level is Level.WEAK and c.mendable]
    return next(iter([*certain, *weak]), None)


def _rivals(look: Look, cause: Cause) -> list[tuple[Cause, Sequence[Hypothesis]]]:
    """A cause and the few that explain as much; each with its hypothesis behind what is beside."""
    others = _others(look, cause)
    found = next((one for one in look.diagnosis.found if one not in others), None)
    set_right = cause.cause is Word.CLOCK and cause.of in look.ahead_s
    if found is None or look.evidence is None or set_right:
        return [(cause, ())]
    beside = [one.hypothesis for one in others]
    out: list[tuple[Cause, Sequence[Hypothesis]]] = [(cause, (*beside, found.hypothesis))]
    for fit in found.rivals:
        last = fit.hypotheses[-1]
        since_s = None if last.since is None else float(look.evidence.times_s[last.since])
        named = f"{cause.cause} of {cause.of}"
        rival = Cause(
            last.word, last.of or ALL, in_words(last.word, last.of or ALL), _AS_MENDED, cause.level,
            unit="%" if last.drifts else "", rivals=(named,), since_s=since_s,
        )  # fmt: skip
        out.append((rival, fit.hypotheses))
    return [one for one in out if one[0].cause in MENDS][: 1 + _MOST_RIVALS]


def _others(look: Look, cause: Cause) -> list[Explanation]:
    """What explains the recording beside a cause."""
    word = Word.SCALE if cause.cause is Word.SQUARE else cause.cause
    name = word, "" if cause.of == ALL else cause.of
    every = look.diagnosis.found
    return [one for one in every if (one.hypothesis.word, one.hypothesis.of) != name]


def _alike(cause: Cause, rival: Cause, one: _State, other: _State) -> bool:
    """Whether it is all the same which of two is mended: both are of one camera, and so are poses.

    A camera that is turned shows what one does whose picture's middle lies elsewhere.
    """
    if cause.of != rival.of or not {cause.cause, rival.cause} <= {*_OF_A_CAMERA}:
        return False
    poses = {round(m.time_s, 4): m.pose for m in other.look.measured if m.pose is not None}
    apart = [
        np.sqrt(squared_mahalanobis(m.pose.world_from_body.difference(then), m.pose.covariance) / 6)
        for m in one.look.measured
        if m.pose is not None and (same := poses.get(round(m.time_s, 4))) is not None
        for then in [same.world_from_body]
    ]
    return bool(apart) and float(np.median(apart)) < 1.0


def _by_hand(cause: Cause) -> str:
    return f"{cause.text}: this can only be mended by hand: {cause.remedy}"


def _not_better(cause: Cause, tried: Sequence[tuple[Cause, _State]], before: _State) -> str:
    tests = [
        f"with {in_words(one.cause, one.of)} mended instants kept out miss by "
        f"{_sds(then.fitness)} SD, as it is by {_sds(before.fitness)} SD"
        for one, then in tried
    ]
    why = "; ".join(tests) or "no cameras, body or stamps can be so"
    return f"{cause.text}: mending this makes the recording fit no better ({why}): {cause.remedy}"


def _sds(fitness: Fitness) -> str:
    return "-" if fitness.residual_sd is None else f"{fitness.residual_sd:.2f}"


def _either(cause: Cause, rival: Cause) -> str:
    pair = {cause.cause, rival.cause}
    telling = "carry the body through more of the volume, nearer and further from each camera"
    if pair & {Word.CLOCK, Word.CLOCK_STEP, Word.ROLLING}:
        telling = "move the body faster, and to and fro"
    elif pair & {*_SCALES}:
        telling = "measure two balls' distance and their sizes with callipers, and put these in"
    one, other = (in_words(c.cause, c.of) for c in (cause, rival))
    return (
        f"{one}, or {other}: both were tried, both explain it, and they need different mends: "
        f"{telling}, and ask again"
    )


def _change(cause: Cause, before: _State, after: _State) -> Change:
    """A finding, with what was changed for it."""
    values = {one.name: getattr(cause.finding, one.name) for one in fields(Finding)}
    return Change(**values, changed=(*_differences(before.parts, after.parts),))


def _differences(before: SessionParts, after: SessionParts) -> Iterator[str]:
    """What differs between two sets of cameras, bodies and stamps, in words."""
    cameras = {camera.name: camera for camera in before.cameras}
    sources = {source.name: source for source in before.sources}
    factor = before.scale_sd != after.scale_sd
    if factor:
        ratio = np.linalg.norm(after.cameras[0].center) / np.linalg.norm(before.cameras[0].center)
        yield f"calibration.toml: all distances from the origin {ratio:.5f} times as large"
    for camera, source in zip(after.cameras, after.sources, strict=True):
        first = cameras.get(camera.name, cameras.get(camera.name.removesuffix(LATER)))
        old = sources.get(source.name, sources.get(source.name.removesuffix(LATER)))
        assert first is not None
        assert old is not None
        if camera.name not in cameras:
            at = source.times_s[np.searchsorted(source.frames, source.table["frames"][0])]
            yield f"session.toml: {old.name} is called {camera.name} from {at:.3f} s on"
        yield from () if factor else _camera_differences(camera, first)
        yield from _source_differences(source, old)
    for ball, was in zip(after.bodies[0].balls, before.bodies[0].balls, strict=True):
        if not np.array_equal(ball.center_mm, was.center_mm):
            x, y, z = ball.center_mm.tolist()
            yield f"body.toml: center_mm of {ball.name} is ({x:.2f}, {y:.2f}, {z:.2f})"
        if ball.radius_mm != was.radius_mm:
            yield f"body.toml: radius_mm of {ball.name} is {ball.radius_mm:.2f}"


def _camera_differences(camera: Camera, was: Camera) -> Iterator[str]:
    step = camera.world_from_camera.difference(was.world_from_camera)
    moved, turned = np.linalg.norm(step[:3]), np.degrees(np.linalg.norm(step[3:]))
    if moved > _SAME or turned > _SAME:
        yield f"calibration.toml: {camera.name} moved by {moved:.2f} mm, turned by {turned:.3f} deg"
    now, then = camera.intrinsics, was.intrinsics
    if abs(now.focal_px / then.focal_px - 1) > _SAME:
        percent = 100 * (now.focal_px / then.focal_px - 1)
        yield f"calibration.toml: focal length of {camera.name} {percent:+.3f} %"
    x, y = (now.matrix[:2, 2] - then.matrix[:2, 2]).tolist()
    if np.hypot(x, y) > _SAME:
        yield f"calibration.toml: principal point of {camera.name} ({x:+.2f}, {y:+.2f}) px"
    if camera.readout_s != was.readout_s:
        yield f"calibration.toml: readout_s of {camera.name} is {camera.readout_s:.4f}"


def _source_differences(source: CameraSource, was: CameraSource) -> Iterator[str]:
    def where(one: CameraSource) -> str:
        return str(one.table.get("images", one.table.get("video")))

    if where(source) != where(was):
        yield f"session.toml: pictures of {source.name} are {where(source)}"
    elif not np.allclose(source.times_s, was.times_s, rtol=0, atol=_SAME_STAMP_S):
        late_ms = 1e3 * (source.times_s - was.times_s)
        least, most = float(late_ms.min()), float(late_ms.max())
        amount = f"{most:+.2f}" if most - least < _SAME_STAMP_S else f"{least:+.2f} to {most:+.2f}"
        yield f"{source.name}.csv: {amount} ms added to its stamps"
    for key in ("mirrored", "red_blue_exchanged"):
        if source.table.get(key) != was.table.get(key):
            yield f"session.toml: {key} of {source.name} is {source.table.get(key)}"


_SAME, _SAME_STAMP_S = 1e-6, 1e-6
