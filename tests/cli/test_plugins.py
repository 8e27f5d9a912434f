"""`measure plugins`: what a user sees of plugins, whole, broken and clashing."""

from __future__ import annotations

import json

import pytest

from measure.cli import main
from tests.strangers import detector_source

WITH_SETTINGS = detector_source().replace(
    'name = "blob"', 'name = "blob"\n    Config = BlobConfig'
).replace(
    "class Blob(",
    '''from measure.host import Settings, setting

class BlobConfig(Settings):
    area_px: float = setting(30.0, "Least area [of a blob].", unit="px²", gt=0)

class Blob(''',
)  # fmt: skip


def run(capsys, *tokens: str) -> str:
    assert main(["plugins", *tokens]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out


@pytest.mark.parametrize("tokens", [[], ["list"]])
def test_the_list_shows_kind_name_distribution_and_what_it_does(install, capsys, tokens):
    install("acme-balls", detector_source(), version="2.3")
    (line,) = [line for line in run(capsys, *tokens).splitlines() if "acme-balls" in line]
    assert line.split() == ["detector", "blob", "acme-balls", "2.3", "Finds", "nothing."]


def test_a_broken_one_is_listed_with_the_reason(install, capsys):
    install("acme", "raise ValueError('[no] licence')", entry_point="blob")
    assert "broken: blob of acme 1.0: ValueError: [no] licence" in run(capsys)


def test_a_clash_names_both_distributions(install, capsys):
    install("acme", detector_source())
    install("zeta", detector_source())
    out = run(capsys)
    assert "clash: detector 'blob' is offered by " in out
    assert "acme 1.0" in out.splitlines()[-1]
    assert "zeta 1.0" in out.splitlines()[-1]


def test_show_describes_every_setting(install, capsys):
    install("acme", WITH_SETTINGS)
    out = run(capsys, "show", "blob")
    assert "detector 'blob' of acme 1.0" in out
    assert "Finds nothing." in out
    (row,) = [line for line in out.splitlines() if "area_px" in line]
    for cell in ("30.0", "px²", "float", "Least area [of a blob]."):
        assert cell in row


def test_show_says_why_a_plugin_is_broken(install, capsys):
    install("acme", "raise ValueError('no licence')", entry_point="blob")
    assert "blob of acme 1.0 is broken: ValueError: no licence" in run(capsys, "show", "blob")


def test_show_of_nobody_suggests_and_exits_with_2(install, capsys):
    install("acme", detector_source())
    assert main(["plugins", "show", "blop"]) == 2
    assert "no plugin is called 'blop'; did you mean 'blob'" in capsys.readouterr().err


def test_json_is_one_object_with_everything(install, capsys):
    install("acme", WITH_SETTINGS)
    install("zeta", detector_source())
    install("wreck", "raise ValueError('no licence')")
    data = json.loads(run(capsys, "list", "--json"))
    blobs = [p for p in data["plugins"] if p["name"] == "blob"]
    assert {p["distribution"]["name"] for p in blobs} == {"acme", "zeta"}
    assert data["broken"] == [
        {
            "name": "wreck",
            "distribution": {"name": "wreck", "version": "1.0"},
            "error": "ValueError: no licence",
        }
    ]
    assert [clash["name"] for clash in data["clashes"]] == ["blob"]
    shown = json.loads(run(capsys, "show", "blob", "--json", "--disable", "zeta"))["plugins"]
    assert shown[0]["settings"] == [
        {
            "name": "area_px",
            "type": "float",
            "default": "30.0",
            "unit": "px²",
            "description": "Least area [of a blob].",
        }
    ]


@pytest.mark.parametrize(
    "tokens", [["--disable", "acme", "plugins"], ["plugins", "list", "--disable", "acme"]]
)
def test_disable_is_global(install, capsys, tokens):
    install("acme", "raise BaseException('imported')")
    assert main(tokens) == 0
    assert "acme" not in capsys.readouterr().out


def test_disabling_nobody_is_a_mistake(capsys):
    assert main(["--disable", "nobody-at-all", "plugins"]) == 2
    assert "cannot disable 'nobody-at-all'" in capsys.readouterr().err
