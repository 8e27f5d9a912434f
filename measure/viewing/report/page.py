"""The page: sections of words, tables and figures in one self-contained HTML file."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import plotly.io as pio
from plotly.offline import get_plotlyjs

_WORTH_CONTENTS = 5  # Sections; fewer are found by scrolling
_LONG = 40  # A column with longer texts is set as words: flush left, broken into lines


@dataclass
class Page:
    """Gathers sections, then renders."""

    title: str
    verdict: str
    tone: str  # "good", "doubtful" or "bad"
    about: str = ""  # stands before the headings of the sections that follow
    when: str = ""  # a line below the title
    _parts: list[str] = field(default_factory=list)
    _headings: list[str] = field(default_factory=list)
    _figures: int = 0

    def facts(self, facts: Iterable[tuple[str, str]]) -> None:
        """A row of (label, value) tiles."""
        tiles = "".join(
            f"<div><b>{html.escape(value)}</b><span>{html.escape(label)}</span></div>"
            for label, value in facts
        )
        about = f"<h2>{html.escape(self.about.strip(' :'))}</h2>" if self.about else ""
        self._parts.append(f'{about}<div class="facts">{tiles}</div>')

    def figures(self, heading: str, words: str, *figures: go.Figure) -> None:
        """A section of one or more figures side by side; those without a value are left out."""
        worth = [figure for figure in figures if _shows_a_value(figure)]
        drawn = "".join(f"<div>{self._draw(figure)}</div>" for figure in worth)
        if worth:
            self._section(
                heading, words, f'<div class="pair">{drawn}</div>' if len(worth) > 1 else drawn
            )

    def picture(self, heading: str, words: str, jpeg: bytes) -> None:
        """A section with one picture."""
        packed = base64.b64encode(jpeg).decode()
        self._section(heading, words, f'<img alt="" src="data:image/jpeg;base64,{packed}">')

    def table(
        self, heading: str, words: str, columns: Sequence[str], rows: Iterable[Sequence[object]]
    ) -> None:
        """A section with one table; floats get four significant digits."""
        kept = [list(row) for row in rows]
        texts = [
            any(isinstance(row[n], str) and len(str(row[n])) > _LONG for row in kept)
            for n in range(len(columns))
        ]
        head = "".join(
            f"<th{_words(long)}>{html.escape(column)}</th>"
            for column, long in zip(columns, texts, strict=True)
        )
        body = "".join("<tr>" + "".join(map(_cell, row, texts)) + "</tr>" for row in kept)
        table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        self._section(heading, words, f'<div class="scroll">{table}</div>')

    def text(self, heading: str, words: str, preformatted: str = "") -> None:
        """A section of words, and perhaps a block as typed."""
        block = f"<pre>{html.escape(preformatted)}</pre>" if preformatted else ""
        self._section(heading, words, block)

    def render(self, footer: str) -> str:
        """The whole page; plotly is embedded once, packed, and nothing is fetched."""
        library, code = "", [_beside("page.js"), get_plotlyjs()] if self._figures else []
        if self._figures:
            # Without a time stamp, so that equal pages are equal to the byte.
            packed = base64.b64encode(gzip.compress(code[1].encode(), mtime=0)).decode()
            library = f'<script type="text/plain" id="plotly">{packed}</script>'
        draw = f"<script>{code[0]}</script>" if self._figures else ""
        when = f'<p class="when">{html.escape(self.when)}</p>' if self.when else ""
        return (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            f'<meta http-equiv="Content-Security-Policy" content="{_policy(code)}">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f"<title>{html.escape(self.title)}</title><style>{_beside('page.css')}</style>"
            f"{library}</head><body><main><h1>{html.escape(self.title)}</h1>{when}"
            f'<div class="verdict {self.tone}">{_prose(self.verdict)}</div>'
            f"{self._contents()}{''.join(self._parts)}<footer>{html.escape(footer)}</footer></main>"
            f"{draw}</body></html>"
        )

    def _section(self, heading: str, words: str, body: str) -> None:
        explained = f"<p>{_prose(words)}</p>" if words else ""
        self._headings.append(html.escape(self.about + heading))
        place = f'id="section-{len(self._headings)}"'
        title = f"<h2>{self._headings[-1]}</h2>"
        self._parts.append(f"<section {place}>{title}{explained}{body}</section>")

    def _contents(self) -> str:
        """Links to the sections, where a page is too long to be seen whole."""
        if len(self._headings) < _WORTH_CONTENTS:
            return ""
        links = (
            f'<a href="#section-{n}">{heading}</a>' for n, heading in enumerate(self._headings, 1)
        )
        return f'<nav aria-label="Contents">{"".join(links)}</nav>'

    def _draw(self, figure: go.Figure) -> str:
        self._figures += 1
        name = f"figure-{self._figures}"
        # "</" would end the script in the middle of a label.
        spec = str(pio.to_json(figure, validate=False)).replace("</", "<\\/")
        height = int(figure.layout.height)
        return (
            f'<div id="{name}" class="figure" style="height:{height}px"></div>'
            f'<script type="application/json" class="spec" data-for="{name}">{spec}</script>'
        )


def _policy(scripts: Iterable[str]) -> str:
    """What the page may do: run these scripts and no others, and ask nobody for anything."""
    hashes = (base64.b64encode(hashlib.sha256(code.encode()).digest()) for code in scripts)
    allowed = " ".join(f"'sha256-{one.decode()}'" for one in hashes) or "'none'"
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


def _cell(value: object, is_text: bool) -> str:
    if isinstance(value, float):
        return f"<td>{'–' if value != value else f'{value:.4g}'}</td>"
    return f"<td{_words(is_text)}>{_prose(str(value))}</td>"


def _prose(text: str) -> str:
    """Words for a page; what stands between backticks is code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))


def _shows_a_value(figure: go.Figure) -> bool:
    """Whether any trace has a finite value, and any bar a height."""
    for trace in figure.data:
        drawn = trace.z if trace.type in ("heatmap", "scatter3d") else trace.y
        known = np.asarray([] if drawn is None else drawn)
        if known.dtype.kind not in "fiu":
            if any(value is not None for value in known.ravel()):
                return True
        elif np.any(known != 0 if trace.type == "bar" else np.isfinite(known)):
            return True
    return False


def _words(is_text: bool) -> str:
    return ' class="words"' if is_text else ""


def _beside(name: str) -> str:
    """The text of a file that stands beside this one."""
    return Path(__file__).with_name(name).read_text("utf-8")
