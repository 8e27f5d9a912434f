"""`measure accept`: a run against known lengths."""

from __future__ import annotations

from pathlib import Path

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command
from measure_lab import api


@command(api.accept)
def accept(found: api.Accepted, run: Path, out: Path | None, json: JsonFlag = False) -> int:
    """Print the errors of the lengths, and which promises were held."""
    judged = found.judged
    rows = [
        (name, float(known), f"{error:+.3f}", f"{U:.3f}", f"{ratio:+.2f}")
        for name, known, error, U, ratio in zip(
            judged.names, judged.known_mm, judged.length_errors_mm, judged.expanded_mm,
            judged.ratios, strict=True,
        )
    ]  # fmt: skip
    code = console.UNBELIEVABLE if judged.contradictions else 0
    if json:
        keys = ("promise", "held", "figure")
        promises = [dict(zip(keys, promise, strict=True)) for promise in found.promises]
        wrong = {"contradictions": judged.contradictions, "passed": not judged.contradictions}
        known = {**vars(judged), "worst": judged.names[judged.worst], **wrong}
        console.print_json({"run": str(run), **known, "promises": promises})
        return code
    heads = ("from - to", "length_mm", "error_mm", "U_mm (k=2)", "error/U")
    console.print_table(heads, rows)
    console.print_text(judged.sentence)
    kept = [(("held" if held else "NOT held"), what, how) for what, held, how in found.promises]
    console.print_table(("", "promise", "here"), kept)
    for line in judged.contradictions:
        console.print_text(f"wrong: {line}")
    if out is not None:
        console.print_text(f"wrote {out}")
    return code
