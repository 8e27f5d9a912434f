"""`python -m benchmarks`: what can be asked for, and the page it makes."""

from __future__ import annotations

import sys

import pytest

from benchmarks.__main__ import main
from benchmarks.recordings import UNUSUAL, rendered_scenes
from measure.simulation import scene_catalogue, unusual_scenes


def typed(monkeypatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmarks", *words])
    main()


def test_every_scene_is_a_recording() -> None:
    names = list(rendered_scenes())
    assert [f"own {name}" for name in scene_catalogue()] == names[: len(scene_catalogue())]
    assert [UNUSUAL + name for name in unusual_scenes()] == names[len(scene_catalogue()) :]


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
