"""The documentation's pages and the blocks in them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(
    r"(?:<!-- (?P<mark>[^\n]*?) -->\n)?^```(?P<language>\w*)[^\n]*\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)


@dataclass(frozen=True)
class Block:
    """One fenced block."""

    page: Path  # the file
    line: int  # where it starts
    language: str  # after the fence
    text: str  # between the fences
    mark: str  # the comment right above it ("file: NAME", "skip: REASON"), or ""

    def marked(self, key: str) -> str:
        """The value of the mark `key: value`, or ""."""
        return self.mark.removeprefix(f"{key}: ") if self.mark.startswith(f"{key}: ") else ""

    @property
    def listing(self) -> str:
        """The file of the repository that the site shows in its place, or ""."""
        found = re.fullmatch(r'--8<-- "(.+)"\n', self.text)
        return found[1] if found else ""


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [
        Block(
            page,
            text.count("\n", 0, match.start()) + 1,
            match["language"],
            match["text"],
            match["mark"] or "",
        )
        for match in _BLOCK.finditer(text)
    ]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))
