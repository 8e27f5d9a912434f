"""Finding plugins: correct ones, and everything that can be wrong with one."""

from __future__ import annotations

import pytest

from measure.errors import PluginError
from measure.host import Broken, Detector, Loaded, Registry, discover
from tests.strangers import detector_source, strangers, the_broken


def test_a_stranger_is_found_with_its_distribution(install):
    install("acme-balls", detector_source("blob"), version="2.3")
    (item,) = strangers()
    assert isinstance(item, Loaded)
    assert (item.kind, item.name, str(item.distribution)) == ("detector", "blob", "acme-balls 2.3")
    assert issubclass(item.plugin, Detector)


def test_one_module_may_offer_several_kinds(install):
    install(
        "acme",
        detector_source()
        + """
from measure.host import Triangulator

class Middle(Triangulator):
    name = "middle"

    def triangulate(self, detections, cameras):
        return None

@hookimpl
def measure_triangulators():
    return [Middle]
""",
    )
    assert {(item.kind, item.name) for item in strangers()} == {
        ("detector", "blob"),
        ("triangulator", "middle"),
    }


BROKEN = {
    "import error": ("import no_such_library_anywhere", "ModuleNotFoundError"),
    "syntax error": ("def (:", "SyntaxError"),
    "error on import": ("raise ValueError('two\\nlines')", "ValueError: two lines"),
    "exit on import": ("import sys; sys.exit('bye')", "SystemExit: bye"),
    "no hook": ("x = 1", "implements none of the hooks measure_detectors"),
    "undecorated hook": ("def measure_detectors(): return []", "measure.host.hookimpl"),
    "misspelt hook": (
        detector_source().replace("def measure_detectors", "def measure_detektors"),
        "unknown hook 'measure_detektors'",
    ),
    "wrong hook argument": (
        detector_source().replace("measure_detectors()", "measure_detectors(config)"),
        "Argument(s) {'config'} are declared in the hookimpl",
    ),
    "hook fails": (
        detector_source().replace("return [Blob]", "raise RuntimeError('no licence')"),
        "RuntimeError: no licence",
    ),
    "hook exits": (
        detector_source().replace("return [Blob]", "raise SystemExit(3)"),
        "SystemExit: 3",
    ),
    "hook returns no list": (
        detector_source().replace("return [Blob]", "return Blob"),
        "must return a list of classes",
    ),
    "hook returns an object": (
        detector_source().replace("return [Blob]", "return [3]"),
        "returned 3, which is not a Detector class",
    ),
    "class of another kind": (
        detector_source().replace("measure_detectors", "measure_triangulators"),
        "is not a Triangulator class",
    ),
    "missing method": (detector_source().replace("def detect(", "def find("), "Blob lacks detect"),
    "no name": (detector_source().replace('name = "blob"', "pass"), "Blob has no name"),
    "name is no text": (detector_source().replace('"blob"', "7"), "Blob has no name"),
    "name of two words": (
        detector_source("big blob"),
        "Blob is called 'big blob': lower case, words",
    ),
    "name in capitals": (detector_source("BLOB"), "Blob is called 'BLOB': lower case"),
    "settings of another family": (
        detector_source().replace('name = "blob"', 'name = "blob"; Config = dict'),
        "Blob.Config is not a subclass of measure.host.Settings",
    ),
}


@pytest.mark.parametrize(("source", "reason"), BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_stranger_is_a_value_with_a_reason(install, source, reason):
    install("acme", source, entry_point="blob")
    broken = the_broken()
    assert reason in broken.error
    assert (broken.name, str(broken.distribution)) == ("blob", "acme 1.0")


@pytest.mark.parametrize(("source", "reason"), BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_stranger_stops_nobody_else(install, source, reason):
    """Whichever is looked at first; what failed is unregistered again and offers nothing."""
    install("before", detector_source("first", "First"))
    install("acme", source)
    install("after", detector_source("last", "Last"))
    found = strangers()
    assert {item.name for item in found if isinstance(item, Loaded)} == {"first", "last"}
    assert [item.name for item in found if isinstance(item, Broken)] == ["acme"]


def test_what_a_plugin_prints_is_no_result(install, capsys):
    talking = detector_source().replace("return [Blob]", "print('offered')\n    return [Blob]")
    built = "name = 'blob'\n    def __init__(self, *_, **given): print('built')"
    install("acme", "print('imported')\n" + talking.replace('name = "blob"', built))
    Registry.discover(disabled=["triball"]).build(Detector, "blob", {}, body=None, camera=None)
    assert capsys.readouterr() == ("", "imported\noffered\nbuilt\n")


def test_only_some_kinds_broken_is_broken_altogether(install):
    """Half a plugin would be a surprise."""
    install(
        "acme", detector_source() + "\n@hookimpl\ndef measure_estimators():\n    return [Blob]\n"
    )
    assert "is not a Estimator class" in the_broken().error


def test_a_missing_object_is_broken(install, tmp_path):
    install("acme", detector_source())
    points = next(tmp_path.glob("*/*.dist-info/entry_points.txt"))
    points.write_text("[measure]\nblob = acme_plugin:nothing_of_this_name\n")
    assert "nothing_of_this_name" in the_broken().error


@pytest.mark.parametrize("first", ["importlib.metadata", "importlib_metadata"])
def test_remains_of_an_installation_are_passed_over(install, tmp_path, first):
    """Also once the library of that name is loaded, as optuna does: it finds them otherwise."""
    pytest.importorskip(first)
    install("acme", detector_source())
    install("rest", detector_source("rest", "Rest"))
    next(tmp_path.glob("site-1/*.dist-info/METADATA")).unlink()
    assert [item.name for item in strangers()] == ["blob"]


def test_a_distribution_found_twice_on_the_path_counts_once(install):
    install("acme", detector_source("old"), version="1.0")
    install("Acme", detector_source("new"), version="2.0")
    assert [(item.name, str(item.distribution)) for item in strangers()] == [("new", "Acme 2.0")]


# -- --disable ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["acme-balls", "Acme_Balls", "blob-entry"])
def test_what_is_disabled_is_not_even_imported(install, name):
    install("acme-balls", "raise BaseException('imported')", entry_point="blob-entry")
    assert strangers(disabled=[name]) == []


def test_a_single_plugin_may_be_disabled(install):
    install("acme", detector_source() + detector_source("other", "Other"))
    assert [item.name for item in strangers()] == ["other"]
    assert strangers(disabled=["other"]) == []


def test_disabling_nobody_is_refused_with_near_names(install):
    install("acme", detector_source())
    with pytest.raises(PluginError, match=r"cannot disable 'acmee'.*did you mean 'acme'"):
        discover(disabled=["acmee"])
