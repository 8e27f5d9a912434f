"""The registry: one plugin of a kind and name, or an error that says why not."""

from __future__ import annotations

from typing import ClassVar

import pytest

from measure.errors import ConfigError, MeasureError, PluginError
from measure.host import (
    Broken,
    Detector,
    Distribution,
    Loaded,
    Registry,
    Settings,
    Triangulator,
    setting,
)
from tests.strangers import detector_source


class TallConfig(Settings):
    height_px: float = setting(3.0, "How tall.", unit="px", gt=0)


class Tall(Triangulator):
    """Needs a height."""

    name = "tall"
    Config: ClassVar[type[Settings]] = TallConfig

    def triangulate(self, detections, cameras):
        return None


class Failing(Tall):
    name = "failing"

    def __init__(self, config):
        super().__init__(config)
        raise OSError("no network")


class Refusing(Tall):
    name = "refusing"

    def __init__(self, config):
        raise ConfigError("heights differ")


ACME, OTHER = Distribution("acme", "1.0"), Distribution("other", "2.0")


def loaded(plugin=Tall, distribution=ACME) -> Loaded:
    return Loaded("triangulator", plugin.name, distribution, plugin)


def test_names_are_by_kind():
    registry = Registry([loaded(), loaded(Failing), Broken("x", ACME, "why")])
    assert registry.names("triangulator") == ["failing", "tall"]
    assert registry.names("detector") == []


def test_an_unknown_name_gets_near_names():
    with pytest.raises(PluginError, match="no triangulator is called 'tal'; did you mean 'tall'"):
        Registry([loaded()]).find("triangulator", "tal")


def test_an_unknown_name_gets_all_names_if_none_is_near():
    registry = Registry([loaded(), loaded(Failing)])
    with pytest.raises(PluginError, match="there is failing, tall"):
        registry.find("triangulator", "zzz")


def test_a_kind_with_no_plugin_says_so():
    with pytest.raises(PluginError, match="no detector is installed"):
        Registry([]).find("detector", "hough")


def test_a_broken_plugin_named_in_a_run_stops_with_its_reason():
    registry = Registry([Broken("blob", ACME, "ImportError: no torch")])
    with pytest.raises(PluginError, match=r"'blob' of acme 1\.0 is broken: ImportError: no torch"):
        registry.find("detector", "blob")


def test_two_distributions_with_one_name_are_refused_naming_both(install):
    install("acme", detector_source("blob"))
    install("zeta", detector_source("blob"), version="3.1")
    registry = Registry.discover(disabled=["triball"])
    with pytest.raises(PluginError, match=r"acme 1\.0 and zeta 3\.1|zeta 3\.1 and acme 1\.0"):
        registry.find("detector", "blob")
    ((one, two),) = registry.clashes()
    assert {one.distribution.name, two.distribution.name} == {"acme", "zeta"}
    mended = Registry.discover(disabled=["triball", "zeta"])
    assert mended.find("detector", "blob").distribution.name == "acme"
    assert mended.clashes() == []


def test_one_name_in_two_kinds_is_no_clash():
    registry = Registry([loaded(), Loaded("detector", "tall", OTHER, Detector)])
    assert registry.clashes() == []
    assert registry.find("triangulator", "tall").distribution == ACME


def test_create_validates_the_settings_and_builds():
    plugin = Registry([loaded()]).build(Triangulator, "tall", {"height_px": "4"})
    assert isinstance(plugin, Tall)
    assert plugin.config == TallConfig(height_px=4.0)


def test_create_says_whose_setting_is_wrong():
    with pytest.raises(ConfigError, match=r"triangulator 'tall': 'height_px': .*greater than 0"):
        Registry([loaded()]).build(Triangulator, "tall", {"height_px": -1})


def test_a_constructor_that_fails_is_named_and_keeps_its_cause():
    with pytest.raises(PluginError, match=r"'failing' of acme 1\.0 cannot be built: OSError: no"):
        Registry([loaded(Failing)]).build(Triangulator, "failing", {})


def test_a_constructor_that_explains_itself_is_not_wrapped():
    with pytest.raises(ConfigError, match=r"^heights differ$"):
        Registry([loaded(Refusing)]).build(Triangulator, "refusing", {})


def test_named_finds_every_kind_and_the_broken():
    items = [loaded(), Broken("tall", OTHER, "why"), loaded(Failing)]
    assert Registry(items).named("tall") == items[:2]
    with pytest.raises(MeasureError, match="no plugin is called 'taal'; did you mean 'tall'"):
        Registry(items).named("taal")
