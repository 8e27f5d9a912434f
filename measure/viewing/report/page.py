"""The page: sections of words, tables and figures in one self-contained HTML file."""

from __future__ import annotations

import base64
import gzip
import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import plotly.graph_objects as go
import plotly.io as pio
from plotly.offline import get_plotlyjs

_CSS = """
:root { color-scheme: light dark; --ink:#1d2733; --soft:#5d6b7a; --paper:#fbfcfd; --card:#fff;
  --line:#dde3ea; --good:#2f7d3b; --doubtful:#9a6a10; --bad:#b03535; }
@media (prefers-color-scheme: dark) { :root { --ink:#e6ebf0; --soft:#9aa7b4; --paper:#12171d;
  --card:#1a2129; --line:#2c3641; --good:#6fce7e; --doubtful:#e6b455; --bad:#f08a8a; } }
* { box-sizing: border-box; }
body { margin:0; background:var(--paper); color:var(--ink);
  font:15px/1.5 system-ui,"Segoe UI",Roboto,"Noto Sans",sans-serif; }
main { max-width:1120px; margin:0 auto; padding:20px 16px 60px; }
h1 { font-size:1.5rem; margin:.2em 0; overflow-wrap:anywhere; }
h2 { font-size:1.1rem; margin:0 0 .5em; }
.verdict { font-size:1.15rem; margin:.4em 0 1em; padding:.7em 1em;
  border-left:4px solid var(--soft); white-space:pre-line;
  background:var(--card); border-radius:0 8px 8px 0; }
.good { border-color:var(--good); } .doubtful { border-color:var(--doubtful); }
.bad { border-color:var(--bad); }
section { background:var(--card); border:1px solid var(--line); border-radius:10px;
  padding:14px 16px; margin:14px 0; overflow:hidden; }
p { margin:.3em 0 .7em; color:var(--soft); max-width:75ch; }
.facts { display:grid; grid-template-columns:repeat(auto-fit,minmax(138px,1fr)); gap:10px; }
.facts div { border:1px solid var(--line); border-radius:8px; padding:8px 10px; }
.facts b { display:block; font-size:1.15rem; overflow-wrap:anywhere; }
.facts span { color:var(--soft); font-size:.85rem; }
.scroll { overflow-x:auto; } table { border-collapse:collapse; font-variant-numeric:tabular-nums; }
th,td { text-align:right; padding:3px 12px 3px 0; border-bottom:1px solid var(--line);
  white-space:nowrap; } th:first-child,td:first-child { text-align:left; }
th.words,td.words { text-align:left; white-space:normal; min-width:16em; }
pre { white-space:pre-wrap; overflow-wrap:anywhere; background:var(--paper); padding:10px;
  border-radius:8px; font-size:.85rem; }
.pair { display:grid; gap:10px;
  grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr)); }
.pair > * { min-width:0; } .pair > :last-child:nth-child(odd) { grid-column:1/-1; }
img { max-width:100%; height:auto; display:block; }
footer { color:var(--soft); font-size:.85rem; margin-top:24px; }
"""


# Drawn once the page is laid out: a figure takes the width of its place, which is not known before.
_DRAW = """
const packed = document.getElementById("plotly").textContent;
const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
new Response(unpacked).text().then((code) => {
  const library = document.createElement("script");
  library.textContent = code;
  document.head.append(library);
  document.querySelectorAll("script.spec").forEach((spec) => {
    const figure = JSON.parse(spec.textContent);
    Plotly.newPlot(spec.dataset.for, figure.data, figure.layout,
      {responsive: true, displaylogo: false, displayModeBar: false});
  });
});
"""

_LONG = 40  # A column with longer texts is set as words: flush left, broken into lines


@dataclass
class Page:
    """Gathers sections, then renders."""

    title: str
    verdict: str
    tone: str  # "good", "doubtful" or "bad"
    about: str = ""  # stands before the headings of the sections that follow
    _parts: list[str] = field(default_factory=list)
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
        """A section of one or more figures side by side."""
        drawn = "".join(f"<div>{self._draw(figure)}</div>" for figure in figures)
        body = f'<div class="pair">{drawn}</div>' if len(figures) > 1 else drawn
        self._section(heading, words, body)

    def picture(self, heading: str, words: str, jpeg: bytes) -> None:
        """A section with one picture."""
        packed = base64.b64encode(jpeg).decode()
        self._section(heading, words, f'<img alt="" src="data:image/jpeg;base64,{packed}">')

    def table(
        self, heading: str, words: str, columns: Sequence[str], rows: Iterable[Sequence[object]]
    ) -> None:
        """A section with one table; floats get four significant digits."""
        kept = [list(row) for row in rows]
        texts = [any(_is_long(row[n]) for row in kept) for n in range(len(columns))]
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
        library = ""
        if self._figures:
            # Without a time stamp, so that equal pages are equal to the byte.
            packed = base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()
            library = f'<script type="text/plain" id="plotly">{packed}</script>'
        draw = f"<script>{_DRAW}</script>" if self._figures else ""
        return (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f"<title>{html.escape(self.title)}</title><style>{_CSS}</style>{library}</head>"
            f"<body><main><h1>{html.escape(self.title)}</h1>"
            f'<div class="verdict {self.tone}">{html.escape(self.verdict)}</div>'
            f"{''.join(self._parts)}<footer>{html.escape(footer)}</footer></main>"
            f"{draw}</body></html>"
        )

    def _section(self, heading: str, words: str, body: str) -> None:
        explained = f"<p>{html.escape(words)}</p>" if words else ""
        heading = html.escape(self.about + heading)
        self._parts.append(f"<section><h2>{heading}</h2>{explained}{body}</section>")

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


def _cell(value: object, is_text: bool) -> str:
    if isinstance(value, float):
        return f"<td>{'–' if value != value else f'{value:.4g}'}</td>"
    return f"<td{_words(is_text)}>{html.escape(str(value))}</td>"


def _is_long(value: object) -> bool:
    return isinstance(value, str) and len(value) > _LONG


def _words(is_text: bool) -> str:
    return ' class="words"' if is_text else ""
