"""`measure mend`: what is off taken out of a copy of the calibration, the body and the stamps."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.api.mend import Fitness, Mended
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import InjectedRegistry


def mend(
    session: Path,
    /,
    *,
    out: OutFile,
    profile: str = "precise",
    overwrite: Overwrite = False,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> int:
    """Take what is off out of a copy of a session's calibration, body and stamps.

    It mends what `measure check` names, one cause after the other, by two thirds of the recording,
    and keeps a mend only if the other third fits better. The session and its pictures stay as they
    are: the new folder names the pictures by their paths.

    The exit code is 3, and nothing is written, where two causes that need different mends explain
    the recording, where a mend makes it fit no better, or where only a person can mend it.

    Args:
        session: the session's folder; it is only read.
        out: the folder to write, a session that `measure run` measures.
        profile: `precise`, or the path of a profile of your own (.toml).
    """
    how = api.load_profile(profile)
    with console.progress("looking") as report:
        found = api.mend(session, out, registry, how, overwrite=overwrite, progress=report)
    if json:
        console.print_json({"output": None if found.refused else out, **vars(found)})
    elif found.refused:
        console.print_text(f"not mended: {found.refused}")
    else:
        _print(found, out)
    return console.UNBELIEVABLE if found.refused else 0


def _print(found: Mended, out: Path) -> None:
    changes, left = found.changed, [finding.text for finding in found.left]
    if changes:
        sizes = [f"{c.code} of {c.subject} {_amount(c)}" for c in changes]
        rivals = [rival for change in changes for rival in change.rivals]
        lines = {
            "what was off": [change.text for change in changes],
            "by how much": sizes,
            "changed": [text for change in changes for text in change.changed],
            "better": [_better(found.before, found.after)],
            "what else could be meant": rivals or ["nothing else explains as much"],
        }
        for name, texts in lines.items():
            console.print_text(f"{name}: {'; '.join(texts)}")
    else:
        console.print_text(f"{found.session}: nothing to mend")
    for text in left:
        console.print_text(f"wrong still: {text}")
    console.print_text(f"wrote {out}")


def _amount(change: api.Finding) -> str:
    if change.estimate is None:
        return "(it is so, or not)"
    sd = "" if change.sd is None else f" +- {change.sd:.2g}"
    return f"{change.estimate:+.4g}{sd} {change.unit}".strip()


def _better(before: Fitness, after: Fitness) -> str:
    residuals = [
        "-" if one.residual_sd is None else f"{one.residual_sd:.2f}" for one in (before, after)
    ]
    shares = [f"{100 * one.pose_share:.0f}" for one in (before, after)]
    return (
        f"instants that were kept out miss by {residuals[1]} SD (RMS), before by {residuals[0]}; "
        f"{shares[1]} % of the frame sets have a pose, before {shares[0]} %"
    )
