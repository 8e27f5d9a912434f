"""What a recording's files show: damaged, missing and repeated pictures, and stamps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import count
from pathlib import Path

from measure import checking, session
from measure.checking.causes import Word
from measure.checking.pictures import stamp_causes, without_step
from measure.errors import SessionError
from measure.model import Doubt
from measure.processes import Progress


def check_files(
    path: Path, lacking: Sequence[str], progress: Progress
) -> tuple[str, int, tuple[checking.Finding, ...]]:
    """What shows without what is lacking: its name, the number of frame sets, and the findings."""
    with session.open_streams(path) as streams:
        total, done = max(map(len, streams.values())), count(1)
        notes = [note for stream in streams.values() for note in stream.notes]
        findings = file_findings(streams, notes, lambda: progress(next(done), total))
        if (apart := clocks_apart(streams)) is not None:
            findings.append(
                checking.Finding(checking.Level.WRONG, "clock", str(apart), code="clocks-apart")
            )
        for name, one in streams.items():
            again = one.repeated()
            if again is not None:
                said = checking.repeated_causes(name, again, len(one) - 1, one.times_s, one.frames)
                findings += [cause.finding for cause in said]
        needed = " and ".join(f"--{name} FILE" for name in lacking)
        text = Doubt("half-checked", needed=needed)
        findings.append(checking.Finding(checking.Level.NOTE, "body", text))
        pairs = len(session.pair_nearest([stream.times_s for stream in streams.values()]).times_s)
        return path.resolve().name, pairs, checking.worst_first(findings)


def file_findings(
    streams: Mapping[str, session.Stream], notes: Sequence[str], step: Callable[[], None]
) -> list[checking.Finding]:
    """Damaged pictures, what was noted on opening, clocks that do not pair, and stamps."""
    findings = []
    jpeg = [stream for stream in streams.values() if session.holds_jpeg(stream)]
    for name, frames in session.damaged_frames(jpeg, step).items():
        findings += checking.damage_findings(name, frames, len(streams[name]))
    findings += [
        checking.Finding(checking.Level.NOTE, "frames", note, code="opened") for note in notes
    ]
    pairing = session.pair_nearest([stream.times_s for stream in streams.values()])
    seldom = session.seldom_paired(list(streams), [len(one) for one in streams.values()], pairing)
    known = {cause.of: cause for cause in stamp_causes({n: s.times_s for n, s in streams.items()})}
    findings += [
        checking.Finding(checking.Level.WRONG, "clock", text, code="seldom-paired")
        for name, text in seldom.items()
        if name not in known
    ]
    for name, stream in streams.items():
        stepped = name in known and known[name].cause is Word.CLOCK_STEP
        if name not in known or stepped or known[name].unit:  # else they came in bursts
            times_s = without_step(stream.times_s, known[name]) if stepped else stream.times_s
            findings += checking.stamp_findings(name, times_s, stream.frames)
    return findings


def clocks_apart(streams: Mapping[str, session.Stream]) -> SessionError | None:
    """What contradicts that all stamps are of one clock, if anything does."""
    try:
        session.check_overlap(list(streams.values()))
    except SessionError as error:
        return error
    return None
