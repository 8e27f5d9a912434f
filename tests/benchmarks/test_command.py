"""`python -m benchmarks`: what can be asked for, and the page it makes."""

from __future__ import annotations

import sys

import pytest

from benchmarks.__main__ import main
from benchmarks.recordings import RELIT, UNUSUAL, rendered_scenes
from benchmarks.tables import typical
from tests.simulated.catalogue import relit_scenes, scene_catalogue
from tests.simulated.unusual import unusual_scenes


def typed(monkeypatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmarks", *words])
    main()


def test_every_scene_is_a_recording() -> None:
    own = [f"own {name}" for name in scene_catalogue()]
    relit = [RELIT + name for name in relit_scenes()]
    unusual = [UNUSUAL + name for name in unusual_scenes()]
    assert list(rendered_scenes()) == own + relit + unusual


def test_unusual_scenes_make_one_table_of_the_default_method(monkeypatch, capsys, tmp_path) -> None:
    page, cache = tmp_path / "page.md", tmp_path / "cache"
    asked = ("--only", "unusual two", "--frames", "2", "--cache", cache, "--out", page)
    typed(monkeypatch, *map(str, asked))
    shown = capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert shown.strip() in text
    assert text.count("\n## ") == 1
    rows = [line for line in shown.splitlines() if line.startswith("| two-cameras |")]
    assert len(rows) == 1
    cells = [cell.strip() for cell in rows[0].strip("|").split("|")]
    assert cells[1] == "precise profile"
    assert 0 < float(cells[3]) < 0.5  # position, mm
    assert [path.name for path in cache.iterdir()] == ["unusual-two-cameras-2"]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--only", "nonsense"), "no recording is called so; there are "),
        (("--only", "nonsense"), "unusual desk-lamp"),
        (("--methods", "nonsense"), "no method is called so; there are paper profile"),
        (("--frames", "1"), "at least 2 are needed"),
    ],
)
def test_what_does_not_exist_is_refused(monkeypatch, capsys, words, complaint) -> None:
    with pytest.raises(SystemExit) as end:
        typed(monkeypatch, *words)
    assert end.value.code == 2
    assert complaint in capsys.readouterr().err


def test_a_session_that_is_not_there_is_one_line(monkeypatch, capsys, tmp_path) -> None:
    from benchmarks.acquisition import main as acquire
    from benchmarks.command import run_command

    monkeypatch.setattr(sys, "argv", ["benchmarks.acquisition", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit) as end:
        run_command(acquire)
    assert end.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith("benchmarks: ")
    assert "nowhere: no such file" in err
    assert err.count("\n") == 1


def test_typical_rows_are_geometric_means_and_mean_shares() -> None:
    figures = ("0.100", "0.010", "0.040", "40", "0", "0", "10", "100", "5.0", "2.0")
    other = ("0.400", "0.040", "0.010", "10", "0", "50", "0", "50", "5.0", "8.0")
    paper = ("0.900", "0.900", "0.900", "90", "0", "0", "0", "0", "9.0", "9.0")
    rows = [("a", "ours", *figures), ("a", "paper", *paper), ("b", "ours", *other)]
    assert typical(rows) == [
        (
            "typical of 2",
            "ours",
            "0.200",
            "0.020",
            "0.020",
            "20",
            "0",
            "25",
            "5",
            "75",
            "5.0",
            "4.0",
        ),
        ("typical of 1", "paper", *paper),
    ]
